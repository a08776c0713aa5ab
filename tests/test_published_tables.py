"""The papers' rows beside ours, the field's intervals, and the baselines as files."""

import numpy as np
import pytest
from conftest import data_file
from helpers.scripts import ROOT, configured, run
from hydra.utils import instantiate

import stmc
from stmc.composing.sampling import Sampling
from stmc.evaluation.results import (
    Result,
    ResultError,
    published_results,
    single_text_table,
    sweep_table,
    with_published,
)
from stmc.evaluation.results.paper_results import normal_estimate

TIMELINES = """\
walk # 0.0 # 4.0 # legs
turn # 4.0 # 11.5 # legs
wave # 1.0 # 6.0 # right arm

bow # 0.0 # 3.0 # spine
sit # 3.0 # 5.0 # legs
"""


def ours(method: str, denoiser: str = "MDM-SMPL", seeds: int = 2, **settings) -> list[Result]:
    metrics = {"recall_1": 20.0, "fid_plus": 0.5, "transition": 1.0}
    return [
        Result(method, seed, {name: value + seed for name, value in metrics.items()}, denoiser, Sampling(**settings))
        for seed in range(seeds)
    ]


def printed(name: str, results: list[Result]) -> list[str]:
    return instantiate(configured("evaluate", f"experiment={name}").experiment.table)(results).text().splitlines()


def test_table_1_has_our_rows_and_then_the_paper_s_sixteen():
    lines = printed("table_1", [*ours("ground_truth", ""), *ours("stmc_paper", steps=100), *ours("sinc", steps=100)])
    mine, theirs = ([line for line in lines if line.startswith(source)] for source in ("ours", "published"))
    assert len(mine) == 3 and "20.5" in mine[1]
    rows = [line for line in theirs if "independent" not in line.lower()]
    assert [sum(name in line.split() for line in rows) for name in ("MotionDiffuse", "MDM", "MDM-SMPL")] == [5, 5, 5]
    [row] = [line for line in theirs if "MDM-SMPL" in line and "30.5" in line]
    assert all(number in row for number in ("30.5", "50.9", "0.675", "0.665", "0.459", "0.9"))
    assert lines[0].startswith("Comparison with baselines: means over 2 seeds")
    assert "without its intervals" in lines[0]


def test_the_paper_s_rows_are_those_of_its_table():
    rows = {(each.denoiser, each.method): each.metrics for each in published_results("stmc_table_1")}
    assert rows["", "ground_truth"]["recall_1"] == 55.0 and rows["", "ground_truth"]["fid_plus"] == 0
    assert rows["MDM", "sinc"]["transition"] == 10.2 and rows["MotionDiffuse", "single_track"]["fid_plus"] == 0.532
    assert rows["MDM-SMPL", "one_text"] == {
        "recall_1": 12.1, "recall_3": 23.5, "m2t": 0.573, "m2m": 0.578, "fid_plus": 0.484, "transition": 1.8
    }  # fmt: skip
    for denoiser in ("MDM", "MotionDiffuse", "MDM-SMPL"):
        best = max(metrics["m2t"] for (name, _), metrics in rows.items() if name == denoiser and "m2t" in metrics)
        assert rows[denoiser, "stmc_paper"]["m2t"] >= best - 0.004


def test_table_a1_has_all_seven_overlaps_of_either():
    results = [result for overlap in (0.5, 1.25) for result in ours("stmc_paper", overlap=overlap, steps=100)]
    lines = printed("table_a1", results)
    assert [line.split()[1] for line in lines if line.startswith("ours")] == ["0.5", "1.25"]
    theirs = [line.split() for line in lines if line.startswith("published")]
    assert [row[1] for row in theirs] == ["0.25", "0.4", "0.5", "0.6", "0.75", "1", "1.25"]
    assert configured("evaluate", "experiment=table_a1").experiment.settings.overlap == [
        float(row[1]) for row in theirs
    ]


def test_flowmdm_s_table_has_teach_without_slerp_and_with_it():
    metrics = {"r_precision": 0.9, "peak_jerk": 0.1}
    results = [Result(name, 0, metrics, "MDM-SMPL", Sampling(steps=25)) for name in ("sinc_slerp", "teach_b", "teach")]
    lines = printed("flowmdm_table_1", results)
    assert [line.split()[:3] for line in lines if line.startswith("ours")][1:] == [
        ["ours", "MDM-SMPL", "TEACH_B"], ["ours", "MDM-SMPL", "TEACH"]
    ]  # fmt: skip
    theirs = [line.split() for line in lines if line.startswith("published")]
    assert len(theirs) == 8
    page = (ROOT / "docs" / "reproducing.md").read_text("utf-8")
    for name in ("TEACH_B", "TEACH"):
        [told] = [line for line in page.splitlines() if line.startswith(f"| {name} | 0")]
        [row] = [row for row in theirs if row[2] == name]
        assert [float(cell.strip("*")) for cell in row[4:]] == [float(cell) for cell in told.split("|")[2:-1]]


def test_an_unknown_published_table_is_an_error_with_the_choices():
    with pytest.raises(
        ResultError, match=r"choose from flowmdm_table_1, .*, stmc_appendix_d, stmc_table_1, stmc_table_a1"
    ):
        with_published(ours("stmc", steps=100), lambda results: sweep_table(results, ["steps"]), "table_9")


@pytest.mark.parametrize("count", [2, 3, 20])
def test_the_field_s_interval_is_1_96_deviations_over_the_root_of_the_repetitions(count):
    values = np.random.default_rng(count).normal(5, 2, count)
    found = normal_estimate(values.tolist())
    assert found.mean == pytest.approx(values.mean())
    assert found.half == pytest.approx(1.96 * np.std(values) / np.sqrt(count))


def test_one_repetition_has_no_interval_and_none_no_mean():
    assert normal_estimate([3.0]).half is None
    with pytest.raises(ValueError, match="no values"):
        normal_estimate([])


def test_single_texts_have_real_motion_first_and_the_best_marked_among_denoisers():
    results = [
        *(Result("ground_truth", seed, {"motion_fid": 0.002, "diversity": 9.5}) for seed in range(3)),
        *(Result("stmc_paper", seed, {"motion_fid": 0.4, "diversity": 9.6}, "B") for seed in range(3)),
        *(Result("stmc_paper", seed, {"motion_fid": 0.3, "diversity": 9.1}, "A") for seed in range(3)),
    ]
    table = single_text_table(results)
    assert [row.labels[0] for block in table.blocks for row in block] == ["–", "A", "B"]
    lines = table.text().splitlines()
    assert "over 3 repetitions" in lines[0]
    assert ["*" in line for line in lines if line.startswith(("–", "A", "B"))] == [False, True, False]


def test_benchmarks_of_the_papers_bring_their_experiments_unless_another_is_asked_for():
    names = {
        (): "comparison",
        ("benchmark=mtt",): "table_1",
        ("benchmark=humanml3d",): "single_text",
        ("benchmark=mtt", "experiment=table_a1"): "table_a1",
        ("benchmark=compositions",): "comparison",
        ("benchmark=flow_mdm_babel",): "flowmdm_table_1",
        ("benchmark=flow_mdm_humanml3d", "experiment=ape_steps"): "ape_steps",
    }
    assert {given: configured("evaluate", *given).experiment.name for given in names} == names
    assert list(configured("evaluate", "benchmark=humanml3d", "seeds=[4]").seeds) == [4]


def test_baselines_are_files_that_read_as_the_baselines(tmp_path):
    (tmp_path / "few.txt").write_text(TIMELINES)
    run("baselines", "baselines", f"timelines={tmp_path / 'few.txt'}", f"output={tmp_path / 'out'}")
    timelines = stmc.Timeline.read_all(tmp_path / "few.txt")
    assert (tmp_path / "out" / "few_onetext.txt").read_text().splitlines()[0] == (
        "walk and then turn while wave # 0.0 # 9.8 # right arm # legs"
    )
    for name, expected in (
        ("onetext", [stmc.one_text(timeline, 9.8) for timeline in timelines]),
        ("singletrack", [stmc.single_track(timeline, 20) for timeline in timelines]),
    ):
        found = stmc.Timeline.read_all(tmp_path / "out" / f"few_{name}.txt")
        assert [timeline.prompts for timeline in found] == [timeline.prompts for timeline in expected]
    texts = [prompt.text for prompt in stmc.Timeline.read_all(tmp_path / "out" / "few_singletrack.txt")[0].prompts]
    assert texts == ["walk", "walk while wave", "turn while wave", "turn"]


@pytest.mark.slow
def test_baselines_of_the_published_timelines_are_500_each(tmp_path):
    published = data_file("mtt/MTT.txt")
    run("baselines", "baselines", f"timelines={published}", f"output={tmp_path}")
    one, single = (stmc.Timeline.read_all(tmp_path / f"MTT_{name}.txt") for name in ("onetext", "singletrack"))
    assert len(one) == len(single) == 500
    assert all(len(timeline.prompts) == 1 and timeline.duration <= 9.8 for timeline in one)
