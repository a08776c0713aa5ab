"""Records, tables and charts of results, against closed forms and hand computation."""

import json
import math
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from helpers.strategies import quietly
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.colors import to_hex

from stmc.composing.sampling import Sampling
from stmc.evaluation.benchmarks.resampling import DRAWS, draw_metrics
from stmc.evaluation.results import (
    Result,
    ResultError,
    by_setting,
    comparison_table,
    estimate,
    read_results,
    sweep_table,
    write_results,
)
from stmc.evaluation.results.charts import bars, quality_against_cost, sweep
from stmc.evaluation.results.intervals import bootstrap

SETTINGS = {"steps": 100, "sampler": "ddpm", "overlap": 0.5, "guidance": 2.5}


def runs(
    method: str, recalls: list, distances: list | None = None, denoiser: str = "mdm_smpl", **settings
) -> list[Result]:
    """A run per seed."""
    distances = distances or [1.0] * len(recalls)
    sampling = Sampling(**(SETTINGS | settings))
    return [
        Result(method, seed, {"recall_3": recall, "transition": distance}, denoiser, sampling)
        for seed, (recall, distance) in enumerate(zip(recalls, distances, strict=True))
    ]


REAL = Result("ground_truth", 0, {"recall_3": 73.3, "transition": 1.5})


def cells(text: str, label: str) -> list[str]:
    """The numbers of the text's row that bears `label`."""
    line = next(line for line in text.splitlines() if label in line)
    return line.replace(" ± ", "±").split()


def test_the_interval_of_two_values_is_that_of_the_cauchy_distribution():
    """t(0.975, 1) = tan(0.475 π); s = √2 for 1 and 3, s/√2 = 1."""
    found = estimate([1.0, 3.0])
    assert found.mean == 2
    assert found.half == pytest.approx(math.tan(0.475 * math.pi))


def test_the_interval_of_three_values_has_the_closed_form_of_two_degrees_of_freedom():
    """t(p, 2) = (2p - 1) √(2 / (1 - (2p - 1)²)); s = 1 for 1, 2, 3."""
    assert estimate([1, 2, 3]).half == pytest.approx(0.95 * math.sqrt(2 / (1 - 0.95**2)) / math.sqrt(3))


def test_one_value_has_no_interval_and_none_no_mean():
    assert estimate([5.0]).half is None
    with pytest.raises(ValueError, match="no values"):
        estimate([])


def test_timelines_and_seeds_that_add_up_have_the_interval_of_both_variances():
    """x = a_timeline + b_seed, crossed: the mean's variance is var(a) / timelines + var(b) / seeds, each variance with
    its n below, as a bootstrap sees it."""
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=30), np.array([0.0, 0.5, 1.5])
    drawn = a[rng.integers(30, size=(40_000, 30))].mean(axis=1)
    found = bootstrap([a.mean() + each for each in b], [(drawn + each).tolist() for each in b])
    assert found.mean == pytest.approx(a.mean() + b.mean())
    assert found.half == pytest.approx(1.959964 * math.sqrt(a.var() / 30 + b.var() / 3), rel=0.03)
    alone = bootstrap([a.mean()], [drawn.tolist()])
    assert alone.half == pytest.approx(1.959964 * a.std() / math.sqrt(30), rel=0.03)
    with pytest.raises(ResultError, match="different resamples"):
        bootstrap([1, 2], [[1.0, 2.0], [1.0]])


def with_draws(results: list[Result], name: str = "recall_3") -> list[Result]:
    """The same with draws of one metric, 1 up and 1 down."""
    return [replace(each, resampled={name: [each.metrics[name] + sign for sign in (-1, 1)]}) for each in results]


def test_the_table_says_what_is_by_bootstrap_and_what_is_not():
    one = with_draws(runs("stmc", [50]))
    text = comparison_table(one).text()
    half = 1.959964 * math.sqrt(2)
    assert f"50.0±{half:.1f}" in cells(text, "STMC (cross-faded)")
    assert "one seed each ± 95% confidence intervals (bootstrap over timelines; Transition distance: none)." in text
    text = comparison_table([REAL, *with_draws([*runs("stmc", [50, 52]), *runs("sinc", [49, 51])])]).text()
    assert "(bootstrap over timelines and seeds; Transition distance: over seeds alone, t distribution)." in text
    mixed = comparison_table([*with_draws(runs("stmc", [50, 52])), *runs("sinc", [49, 51])]).text()
    assert "Transition distance: over seeds alone, t distribution; R@3: some rows over seeds alone)." in mixed


def test_few_timelines_have_neither_an_interval_nor_a_best_row():
    """One or two units that are drawn anew are nearly always themselves: ± 0.0 said that chance plays no part."""
    few = [replace(each, resampled={"recall_3": []}) for each in [*runs("stmc", [50, 52]), *runs("sinc", [49, 51])]]
    table = comparison_table(few)
    assert cells(table.text(), "STMC (cross-faded)")[-2] == "51.0" and cells(table.text(), "SINC")[-2] == "50.0"
    assert "means over 2 seeds, of too few timelines for intervals or ranks." in table.text()
    assert r"$51.0$" in table.latex()


@pytest.mark.parametrize(("count", "draws"), [(1, 0), (4, 0), (5, DRAWS)])
def test_fewer_than_five_units_are_not_drawn_anew(count, draws):
    values = np.arange(count, dtype=float)
    assert len(draw_metrics(count, lambda units: {"fid": values[units].mean()})["fid"]) == draws


def test_action_success_is_headed_by_what_it_is_by_chance():
    results = [
        Result("stmc", 0, {"shown": 90.0, "shown_chance": 20.6}, "mdm"),
        Result("sinc", 0, {"shown": 80.0}, "mdm"),
    ]
    assert "Action success rate (%; by chance 21) ↑" in comparison_table(results).text()
    assert r"Action success rate (\%; by chance 21) $\uparrow$" in comparison_table(results).latex()
    assert "Action success rate (%) ↑" in comparison_table(results[1:]).text()


def test_the_best_of_each_column_is_marked_in_its_direction_and_never_the_ground_truth():
    text = comparison_table(
        [REAL, *runs("stmc", [50, 52], [0.8, 1.0]), *runs("sinc", [49, 51], [4.0, 4.4]), *runs("one_text", [20, 21])]
    ).text()
    half = math.tan(0.475 * math.pi)
    assert cells(text, "STMC (cross-faded)")[-2:] == [f"51.0±{half:.1f}*", f"0.9±{0.1 * half:.1f}*"]
    assert cells(text, "SINC w/o Lerp")[-2:] == [f"50.0±{half:.1f}", f"4.2±{0.2 * half:.1f}"]
    assert cells(text, "Ground truth")[-2:] == ["73.3", "1.5"]


def test_means_that_look_the_same_are_both_the_best():
    text = comparison_table([*runs("stmc", [50.01]), *runs("sinc", [50.04]), *runs("one_text", [50.06])]).text()
    assert [cells(text, name)[-2] for name in ("STMC", "SINC w/o Lerp", "One text")] == ["50.0", "50.0", "50.1*"]
    assert "one seed each" in text


def test_rows_stand_in_the_paper_s_order_and_each_denoiser_has_its_own_best():
    results = [*runs("stmc", [40]), *runs("one_text", [10]), *runs("stmc", [30], denoiser="mdm"), REAL]
    results += runs("sinc", [20], denoiser="mdm")
    table = comparison_table(results)
    assert [[row.labels[:2] for row in block] for block in table.blocks] == [
        [("–", "Ground truth")],
        [("mdm_smpl", "One text"), ("mdm_smpl", "STMC (cross-faded)")],
        [("mdm", "SINC w/o Lerp"), ("mdm", "STMC (cross-faded)")],
    ]
    assert table.text().count("40.0*") == table.text().count("30.0*") == 1


def test_latex_has_the_best_in_bold_and_escapes_what_latex_would_take_for_its_own():
    latex = comparison_table([*runs("stmc", [50, 52]), *runs("sinc", [49, 51]), *runs("my_way", [1, 2])]).latex()
    assert r"$\mathbf{51.0} \pm 12.7$" in latex
    assert r"$50.0 \pm 12.7$" in latex
    assert r"mdm\_smpl & my\_way & -- & -- &" in latex
    assert r"R@3 (\%) $\uparrow$ & Transition distance (cm) $\downarrow$ \\" in latex
    assert latex.count("&") % 5 == 0


def test_a_comparison_is_of_one_setting_each():
    with pytest.raises(ResultError, match="stmc of mdm_smpl has several settings, steps 100 and 50; choose one"):
        comparison_table([*runs("stmc", [50]), *runs("stmc", [50], steps=50)])


def test_the_overlap_table_has_a_row_per_overlap_in_order():
    results = [
        run for overlap, recall in ((1.0, 49.1), (0.25, 51.7)) for run in runs("stmc", [recall], overlap=overlap)
    ]
    table = sweep_table([REAL, *results], ["overlap"])
    assert [row.labels for row in table.blocks[0]] == [("0.25",), ("1",)]
    assert cells(table.text(), "0.25")[1] == "51.7*"
    with pytest.raises(ResultError, match="differ in more than overlap: method stmc and sinc"):
        sweep_table([*results, *runs("sinc", [1.0], overlap=2.0)], ["overlap"])


def test_a_seed_that_stands_twice_is_an_error():
    with pytest.raises(ResultError, match="seed 1 is duplicated"):
        by_setting([*runs("stmc", [1, 2]), runs("stmc", [1, 2])[1]])


numbers = st.floats(allow_nan=False, allow_infinity=False)
anything = st.builds(
    Result,
    method=st.text(),
    seed=st.integers(),
    metrics=st.dictionaries(st.text(), numbers),
    resampled=st.dictionaries(st.text(), st.lists(numbers, max_size=3)),
    denoiser=st.text(),
    sampling=st.builds(
        Sampling,
        steps=st.none() | st.integers(min_value=1),
        overlap=st.none() | st.floats(min_value=0, allow_infinity=False),
        noise_scale=st.sampled_from([None, "std", "variance"]),
        guidance=st.none() | st.floats(-999, 999),
    ),
)


@quietly
@given(st.lists(anything, max_size=4))
def test_records_are_read_as_they_were_written(tmp_path_factory, results):
    path = tmp_path_factory.mktemp("results") / "results.jsonl"
    write_results(results, path)
    assert read_results(path) == results
    assert len(path.read_text("utf-8").split("\n")) == len(results) + 1


def test_records_of_earlier_versions_have_todays_settings(tmp_path):
    old = {"method": "stmc", "seed": 0, "metrics": {"late": 1.0}, "spread": "std", "late": 0.2, "absolute": 0.1}
    path = tmp_path / "results.jsonl"
    path.write_text(json.dumps(old) + "\n" + json.dumps(old | {"stitch_from": 0.5}))
    first, second = read_results(path)
    assert first.sampling == Sampling(noise_scale="std", stitch_from=0.2, ape_steps=0.1)
    assert second.sampling.stitch_from == 0.5
    assert first.metrics == {"late": 1.0}


@pytest.mark.parametrize(
    ("line", "complaint"),
    [
        ("{", "not JSON"),
        ("[]", "a record must be an object"),
        ('{"method": "stmc", "seed": 0}', "missing metrics"),
        (
            '{"method": "stmc", "seed": 0, "metrics": {}, "stepps": 3}',
            "unknown key 'stepps'; choose from method",
        ),
        ('{"method": "stmc", "seed": true, "metrics": {}}', "seed: true is not int"),
        ('{"method": "stmc", "seed": 0, "metrics": {"fid": "low"}}', "metrics.fid: 'low' is not int or float"),
        ('{"method": "stmc", "seed": 0, "metrics": {"fid": NaN}}', "metrics.fid: nan is not a finite number"),
        ('{"method": "stmc", "seed": 0, "metrics": {}, "steps": 1.5}', "steps=1.5: must be a whole number or null"),
    ],
)
def test_a_record_that_cannot_be_meant_is_named_by_its_line(tmp_path, line, complaint):
    path = tmp_path / "results.jsonl"
    path.write_text(json.dumps({"method": "stmc", "seed": 0, "metrics": {}}) + f"\n{line}\n")
    with pytest.raises(ResultError, match=r"results\.jsonl, line 2: ") as caught:
        read_results(path)
    assert complaint in str(caught.value)


def test_bars_are_as_tall_as_the_means_and_their_whiskers_as_long_as_the_intervals():
    plot = bars([REAL, *runs("stmc", [50, 52]), *runs("sinc", [49, 51]), *runs("stmc", [30, 30], denoiser="mdm")])
    recall, distance = plot.axes
    assert [bar.get_height() for bar in recall.patches] == [50, 51, 30]
    assert len(distance.patches) == 3
    colours = [to_hex(bar.get_facecolor()) for bar in recall.patches]
    assert colours[1] == colours[2] != colours[0]
    low, high = recall.collections[0].get_segments()[0][:, 1]
    assert (high - low) / 2 == pytest.approx(math.tan(0.475 * math.pi))
    assert any(set(line.get_ydata()) == {73.3} for line in recall.lines)
    assert [text.get_text() for text in plot.legends[0].get_texts()].count("STMC (cross-faded)") == 1


def test_quality_is_drawn_against_steps_and_time_with_a_line_per_sampler():
    results = [
        Result("stmc", seed, metrics, "mdm", Sampling(steps, sampler))
        for steps, sampler, seed in product((10, 5, 100), ("ddpm", "ddim"), (0, 1))
        for metrics in [{"recall_3": 40.0 + steps, "fid": 1 / steps, "seconds": steps / 10}]
    ]
    recall, recall_by_time, fid, fid_by_time = quality_against_cost(results).axes
    assert [list(box.lines[0].get_xdata()) for box in recall.containers] == [[5, 10, 100]] * 2
    assert [box.get_label() for box in recall.containers] == ["DDIM", "DDPM"]
    assert list(recall_by_time.containers[0].lines[0].get_xdata()) == [0.5, 1, 10]
    assert list(fid.containers[0].lines[0].get_ydata()) == [1 / 5, 1 / 10, 1 / 100]
    assert recall.get_xscale() == fid_by_time.get_xscale() == "log"


def test_what_should_not_vary_is_named():
    results = [*runs("stmc", [50]), *runs("stmc", [50], guidance=3.0)]
    with pytest.raises(
        ResultError, match=r"differ in more than sampler, noise_scale, steps: guidance 2.5 and 3.0; choose one"
    ):
        quality_against_cost(results)
    with pytest.raises(ResultError, match=r"guidance 2.5 and 3.0"):
        sweep(results, "overlap")
    with pytest.raises(ResultError, match="no record has a metric to draw"):
        bars([Result("stmc", 0, {"beauty": 1.0})])


def test_the_sweep_has_a_panel_per_metric_and_a_point_per_overlap():
    results = [
        run for overlap in (1.0, 0.25, 0.5) for run in runs("stmc", [50 - overlap, 52 - overlap], overlap=overlap)
    ]
    recall, _ = sweep([REAL, *results], "overlap").axes
    line = recall.containers[0].lines[0]
    assert list(line.get_xdata()) == [0.25, 0.5, 1.0]
    assert list(line.get_ydata()) == [50.75, 50.5, 50.0]
