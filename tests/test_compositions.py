"""Compositions in time: a data set of still poses and jumps whose scores are known in closed form, and the figures."""

import functools
import json
import math
from collections import Counter
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import pytest
import torch
from helpers.bandai_files import about, posed, skeleton
from helpers.pose_evaluator import Oracle
from helpers.scripts import configured, loaded
from helpers.tiny_model import tiny
from omegaconf import OmegaConf
from torch import Tensor

import stmc
from stmc.composing.sampling import Sampling
from stmc.data.cache import Cache, CacheError, Clip
from stmc.evaluation.benchmarks import Benchmark, Compositions, resampling
from stmc.evaluation.metrics.matching_metrics import matching_score, r_precision
from stmc.evaluation.results import Result, ResultError, comparison_table, sweep_table
from stmc.evaluation.results.composition_charts import jerk_curves, trade_off
from stmc.evaluation.results.length_charts import length_chart
from stmc.motion.motion import Motion
from stmc.motion.representation import SmplRepresentation

FPS, WINDOW = 30.0, 60
REPRESENTATION = SmplRepresentation()
POSES = {"left": ("left_shoulder", 1.2), "right": ("right_shoulder", -1.2), "both": ("spine1", 0.4)}
SHORTER = {"count": 2, "segments": 20, "min_clips": 1}


@functools.cache
def still(content: str, frames: int = 90, heading: float = 0.0) -> Motion:
    """A pose that names the content, held where it is."""
    joint, angle = POSES[content]
    pelvis = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64).repeat(frames, 1)
    return posed({joint: about("z", torch.full((frames,), angle, dtype=torch.float64))}, pelvis, pelvis[:, 0] + heading)


def data(
    contents: dict[str, int], frames: int = 90, cyclic: Sequence[str] = tuple(POSES), split: str = "test"
) -> Cache:
    """So many clips of each content, and of each a mirrored one."""
    clips, features, start = [], [], 0
    for content, count in contents.items():
        rows = REPRESENTATION.encode(still(content, frames)).float()
        for number in range(2 * count):
            name, mirrored = f"{content}-{number}", number >= count
            clips.append(
                Clip(name, content, "", content, (), content in cyclic, mirrored, split, start, start + len(rows))
            )
            features.append(rows)
            start += len(rows)
    texts = {content: ((content, 0.5), (f"a {content}", 0.5)) for content in contents}
    return Cache(FPS, "smpl", torch.cat(features), tuple(clips), texts)


ORACLE = Oracle(FPS, lambda text: still(text.split()[-1], 9))
"""A text's last word names its pose."""


def benchmark(contents: dict[str, int] | None = None, **settings) -> Compositions:
    return Compositions(data(contents or {"left": 3, "right": 3}), REPRESENTATION, ORACLE, **(SHORTER | settings))


@pytest.fixture(scope="module")
def two() -> Compositions:
    return benchmark()


def shown(timeline: stmc.Timeline, other: dict[str, str] | None = None) -> Motion:
    """Each prompt's pose during its span, or another one's."""
    names = [prompt.text.split()[-1] for prompt in timeline.prompts]
    rotations = [
        still((other or {}).get(name, name), end - start).rotations
        for name, (start, end) in zip(names, timeline.spans(FPS), strict=True)
    ]
    pelvis = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64).repeat(timeline.frames(FPS), 1)
    return Motion.posed(torch.cat(rotations), pelvis, FPS, skeleton())


def moved(timeline: stmc.Timeline, path: Tensor, heading: float = 0.0) -> Motion:
    """One pose that faces `heading` and is carried along it, by `path` metres from the start in each frame."""
    motion = still("left", timeline.frames(FPS), heading)
    way = path[:, None] * motion.facing
    return Motion(motion.rotations, motion.translation + way, motion.joints + way[:, None], FPS)


@pytest.fixture(autouse=True)
def few_draws(monkeypatch) -> None:
    """Of the bootstrap: what it measures is what is tested."""
    monkeypatch.setattr(resampling, "DRAWS", 6)


def test_motions_that_show_what_is_asked_match_their_texts_and_the_real_clips(two):
    scores = two.measured("stmc", [shown(timeline) for timeline in two.timelines("stmc")], seed=0)
    assert isinstance(two, Benchmark)
    assert scores.metrics["r_precision"] == 1
    assert scores.metrics["mm_dist"] == pytest.approx(0, abs=1e-3)
    assert scores.metrics["subsequence_fid"] == pytest.approx(0, abs=1e-6)
    assert two.real(0).metrics["r_precision"] == 1


def test_draws_of_compositions_average_what_each_has_by_itself(two, monkeypatch):
    monkeypatch.setattr(resampling, "FEWEST", 2)
    first, *others = two.timelines("stmc")
    motions = [shown(first, {"left": "right", "right": "left"}), *map(shown, others)]
    scores = two.measured("stmc", motions, seed=0)
    found = two._measure_motions(motions)
    each = len(first.prompts)
    rows = [slice(each * number, each * (number + 1)) for number in range(len(motions))]
    alone = [matching_score(found.texts[row], found.subsequences[row]) for row in rows]
    draws = np.random.default_rng(0).integers(len(motions), size=(resampling.DRAWS, len(motions)))
    assert max(alone) > min(alone) + 0.1
    assert scores.resampled["mm_dist"] == pytest.approx(
        [np.mean([alone[unit] for unit in draw]) for draw in draws], 1e-4
    )
    assert set(scores.resampled) == set(scores.metrics)


def test_motions_of_another_frame_rate_are_measured_at_the_judge_s(two):
    slower = [shown(timeline).resampled(20) for timeline in two.timelines("stmc")]
    metrics, curves, _ = two.measured("stmc", slower, seed=0)
    assert metrics["r_precision"] == 1
    assert len(curves["jerk"]) == WINDOW - 3


def test_motions_that_show_something_else_match_no_text(two):
    wrong = [shown(timeline, {"left": "right", "right": "left"}) for timeline in two.timelines("stmc")]
    assert two.measured("stmc", wrong, seed=0).metrics["r_precision"] == 0


def test_fid_of_what_is_always_the_same_has_its_closed_form_and_no_diversity(two):
    """A share p of the real clips differs by d: the means by p d, and the real ones' variance is p (1 - p) d²."""
    asked = two.timelines("stmc")
    one = two.measured("stmc", [shown(timeline, {"right": "left"}) for timeline in asked], seed=0).metrics
    names = [prompt.text.split()[-1] for timeline in asked for prompt in timeline.prompts]
    share, count = names.count("right") / len(names), len(names)
    left, right = torch.nn.functional.normalize(ORACLE.texts(["left", "right"]), dim=-1)
    apart = float((left - right).square().sum())
    wanted = apart * (share**2 + share * (1 - share) * count / (count - 1))
    assert one["subsequence_fid"] == pytest.approx(wanted, rel=1e-3)
    assert one["subsequence_diversity"] == one["transition_diversity"] == pytest.approx(0, abs=1e-3)
    real = two.real(0).metrics
    assert real["subsequence_fid"] == pytest.approx(0, abs=1e-6)
    assert real["transition_fid"] == pytest.approx(0, abs=1e-6)
    assert 0 < real["subsequence_diversity"] < apart**0.5


def test_a_jump_of_d_metres_at_every_boundary_has_the_jerk_d_2d_d_in_the_middle_of_the_window(two):
    """The third differences of a step; real motion is still here, so the area is their sum."""
    distance, motions = 0.25, []
    for timeline in two.timelines("stmc"):
        path = torch.zeros(timeline.frames(FPS), dtype=torch.float64)
        for start, _ in timeline.spans(FPS)[1:]:
            path[start:] += distance
        motions.append(moved(timeline, path, heading=0.7))
    metrics, curves, _ = two.measured("stmc", motions, seed=0)
    wanted = [0.0] * (WINDOW - 3)
    wanted[27:30] = distance, 2 * distance, distance
    assert curves["jerk"] == pytest.approx(wanted, abs=1e-4)
    assert metrics["peak_jerk"] == pytest.approx(2 * distance, abs=1e-4)
    assert metrics["area_under_jerk"] == pytest.approx(4 * distance, abs=1e-2)


@pytest.mark.parametrize("heading", [0.0, 0.7])
def test_a_motion_of_constant_jerk_has_a_flat_curve_whichever_way_it_faces(two, heading):
    """x = c n³ / 6 metres after n frames, along the heading: the sum over the axes is c only where the window begins
    with heading zero."""
    strength = 1e-4
    motions = [
        moved(timeline, strength * torch.arange(timeline.frames(FPS), dtype=torch.float64) ** 3 / 6, heading)
        for timeline in two.timelines("stmc")
    ]
    metrics, curves, _ = two.measured("stmc", motions, seed=0)
    assert curves["jerk"] == pytest.approx([strength] * (WINDOW - 3), rel=1e-3)
    assert metrics["area_under_jerk"] == pytest.approx((WINDOW - 3) * strength, rel=2e-2)


def test_real_motion_is_still_here_and_has_no_jerk(two):
    metrics, curves, _ = two.real(3)
    assert len(curves["jerk"]) == WINDOW - 3
    assert metrics["peak_jerk"] < 1e-5
    assert two.real(3).metrics == metrics


def test_what_is_asked_is_a_function_of_the_seed_the_same_for_every_method(two):
    asked = two.timelines("stmc")
    assert asked == two.timelines("flow_mdm") == benchmark().timelines("stmc")
    assert asked != benchmark(seed=1).timelines("stmc")
    assert [len(timeline.prompts) for timeline in asked] == [20, 20]
    for timeline in asked:
        assert set(timeline.rows) == {0}
        assert all(one.end == other.start for one, other in pairwise(timeline.prompts))
        assert all(prompt.claims == set(stmc.BodyPart) for prompt in timeline.prompts)


def test_a_segment_lasts_as_long_as_its_clip_within_bounds():
    for frames, settings, seconds in ((90, {}, 3.0), (30, {"window": 20}, 2.0), (90, {"longest": 2.5}, 2.5)):
        asked = Compositions(
            data({"left": 1, "right": 1}, frames), REPRESENTATION, ORACLE, **(SHORTER | settings)
        ).timelines("stmc")
        assert {round(prompt.end - prompt.start, 2) for each in asked for prompt in each.prompts} == {seconds}


def test_contents_are_drawn_alike_however_many_clips_they_have():
    asked = benchmark({"left": 12, "right": 2}, count=20).timelines("stmc")
    counts = Counter(prompt.text.split()[-1] for timeline in asked for prompt in timeline.prompts)
    assert abs(counts["left"] - 200) < 5 * math.sqrt(400 / 4)  # five standard deviations of 400 fair draws


def test_repeats_hold_an_action_for_as_many_segments_and_only_cyclic_ones():
    cache = data({"left": 2, "right": 2, "both": 2}, cyclic=("left", "right"))
    settings = {"count": 8, "segments": 8, "min_clips": 1}
    whole = Compositions(cache, REPRESENTATION, ORACLE, repeats=8, **settings)
    for timeline in whole.timelines("stmc"):
        assert len({prompt.text for prompt in timeline.prompts}) == 1
    said = {prompt.text.split()[-1] for each in whole.timelines("stmc") for prompt in each.prompts}
    assert said == {"left", "right"}
    pairs = Compositions(cache, REPRESENTATION, ORACLE, repeats=2, **settings).timelines("stmc")
    assert all(len({p.text for p in each.prompts[at : at + 2]}) == 1 for each in pairs for at in range(0, 8, 2))
    assert whole.measured("stmc", [shown(each) for each in whole.timelines("stmc")], 0).metrics["r_precision"] == 1


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        ({"count": 1}, "there must be 32 segments in all, not 20"),
        ({"repeats": 0}, "repeats 0"),
        ({"window": 200}, r"shortest 2.0 s must be half of the window \(200 frames at 30.0 a second\)"),
        ({"shortest": 9}, "at most longest, 8.0 s"),
    ],
)
def test_numbers_that_cannot_be_meant_are_named(settings, complaint):
    with pytest.raises(ValueError, match=complaint):
        benchmark(**settings)


def test_a_test_split_that_holds_too_little_says_what_it_has():
    def make(cache: Cache, **settings) -> Compositions:
        return Compositions(cache, REPRESENTATION, ORACLE, **(SHORTER | settings))

    with pytest.raises(
        CacheError, match=r"two actions with at least 5 unmirrored clips .* it has left \(3\), right \(8\)"
    ):
        make(data({"left": 3, "right": 8}), min_clips=5)
    with pytest.raises(CacheError, match=r"it has none"):
        make(data({"left": 3, "right": 8}, split="train"))
    with pytest.raises(CacheError, match=r"two cyclic actions .* it has left \(3\)"):
        make(data({"left": 3, "right": 8}, cyclic=("left",)), repeats=2)
    with pytest.raises(CacheError, match="no test clip is as long as a window of 60 frames; the longest has 40"):
        make(data({"left": 1, "right": 1}, frames=40))


def test_motions_that_are_not_those_of_the_timelines_are_refused(two):
    motions = [shown(timeline) for timeline in two.timelines("stmc")]
    with pytest.raises(ValueError, match="1 motions for 2 timelines"):
        two.measured("stmc", motions[:1], 0)
    with pytest.raises(ValueError, match=r"the motion of timeline 0001 has 100 frames instead of \d+"):
        two.measured("stmc", [motions[0], motions[1].trimmed(0, 100)], 0)


def test_what_a_text_is_true_of_too_neither_spoils_nor_saves_its_own_motion():
    """Four pairs of one content at distances 0, 1, 2, 3 from their common text; the others are far, each at its own."""
    texts = torch.zeros(32, 2)
    texts[4:, 0] = 100.0 * torch.arange(1, 29)
    motions = texts.clone()
    motions[:4, 1] = torch.arange(4.0)
    true = torch.eye(32, dtype=torch.bool)
    true[:4, :4] = True
    assert r_precision(texts, motions) == pytest.approx([29 / 32, 30 / 32, 31 / 32])
    assert r_precision(texts, motions, true) == (1, 1, 1)
    motions[3, 0] = 1000.0  # its own motion is wrong now, whatever its fellows show
    assert r_precision(texts, motions, true)[2] == 31 / 32


# Figures and tables ---------------------------------------------------------------------------------------------------


def record(name: str, seed: int, height: float, frames: int = 57, **settings) -> Result:
    curve = [height * abs(frame - frames // 2) for frame in range(frames)]
    numbers = {"r_precision": height, "transition_fid": 2 * height, "area_under_jerk": 3.0, "peak_jerk": 0.1}
    denoiser = settings.pop("denoiser", "")
    return Result(name, seed, numbers, denoiser, Sampling(**settings), {"jerk": curve})


REAL = record("ground_truth", 0, 0.5)


def test_jerk_curves_are_means_over_seeds_around_the_transition_and_real_motion_is_dashed():
    runs = [record("flow_mdm", seed, height, denoiser="flow") for seed, height in ((0, 1.0), (1, 3.0))]
    others = [record(name, 0, 4.0, denoiser="mdm") for name in ("stmc", "flow_mdm")]
    first, second = jerk_curves([REAL, *runs, *others]).axes
    assert (first.get_title(), second.get_title(), first.get_ylim()) == ("flow", "mdm", second.get_ylim())
    flow, mdm = ({line.get_label(): line for line in axes.lines} for axes in (first, second))
    line = flow["FlowMDM"]
    assert (line.get_xdata()[0], line.get_xdata()[28], line.get_xdata()[-1]) == (-28, 0, 28)
    assert line.get_ydata().tolist() == [2.0 * abs(frame - 28) for frame in range(57)]
    assert "STMC (cross-faded)" not in flow and mdm["STMC (cross-faded)"].get_ydata()[0] == 4.0 * 28
    assert mdm["FlowMDM"].get_color() == line.get_color() != mdm["STMC (cross-faded)"].get_color()
    for panel in (flow, mdm):
        assert panel["Ground truth"].get_linestyle() == "--"
        assert panel["Ground truth"].get_ydata()[0] == 0.5 * 28
    top = max(path[:, 1].max() for band in first.collections[:1] for path in [band.get_paths()[0].vertices])
    assert top == pytest.approx(28 * (2 + math.tan(0.475 * math.pi)))


def test_a_legend_is_no_wider_than_its_figure_and_has_every_name():
    methods = ("one_text", "single_track", "sinc", "sinc_lerp", "stmc", "flow_mdm")
    plot = jerk_curves([REAL, *(record(name, 0, 1.0, denoiser="a rather long name") for name in methods)])
    few = jerk_curves([REAL, record("stmc", 0, 1.0, denoiser="a rather long name")])
    for each in (plot, few):
        each.draw_without_rendering()
    [names] = plot.legends
    assert names.get_window_extent().width <= plot.bbox.width
    assert len(names.get_texts()) == 7
    heights = [each.axes[0].get_position().height * each.get_figheight() for each in (plot, few)]
    assert heights[0] == pytest.approx(heights[1], rel=0.1)  # the figure grows with its legend, panels do not shrink


def test_curves_that_cannot_be_compared_are_refused():
    with pytest.raises(ResultError, match="no record has a curve 'jerk'"):
        jerk_curves([Result("stmc", 0, {})])
    with pytest.raises(ResultError, match="of 27, 57 frames"):
        jerk_curves([REAL, record("stmc", 0, 1.0, frames=27)])
    with pytest.raises(ResultError, match="FlowMDM has several settings"):
        jerk_curves([record("flow_mdm", 0, 1.0, ape_steps=0.1), record("flow_mdm", 0, 1.0, ape_steps=0.5)])


def test_the_trade_off_shows_three_measures_against_the_share_of_absolute_steps():
    runs = [
        record("flow_mdm", seed, 0.1 + share + seed, ape_steps=share) for share in (0.5, 0.1, 1.0) for seed in (0, 2)
    ]
    precision, fid, area = trade_off([REAL, *runs, record("stmc", 0, 9.0)]).axes
    assert [axes.get_ylabel()[:3] for axes in (precision, fid, area)] == ["R-p", "FID", "AUJ"]
    [box] = precision.containers
    assert box.lines[0].get_xdata().tolist() == [0.1, 0.5, 1.0]
    assert box.lines[0].get_ydata().tolist() == pytest.approx([1.2, 1.6, 2.1])
    assert any(set(line.get_ydata()) == {0.5} for line in precision.lines)
    with pytest.raises(ResultError, match="no record has ape_steps"):
        trade_off([REAL])


def test_the_tables_of_all_benchmarks_serve_compositions():
    runs = [record("flow_mdm", seed, 1.0 + seed, ape_steps=0.1) for seed in (0, 1)]
    text = comparison_table([REAL, *runs, record("stmc", 0, 0.1)]).text()
    heads = next(line for line in text.splitlines() if "R-prec" in line)
    assert [heads.index(name) for name in ("R-prec", "FID (transitions)", "PJ", "AUJ")] == sorted(
        heads.index(name) for name in ("R-prec", "FID (transitions)", "PJ", "AUJ")
    )
    assert "1.500" in text
    shares = sweep_table([REAL, *runs, record("flow_mdm", 0, 2.0, ape_steps=0.5)], ["ape_steps"])
    assert [row.labels for row in shares.blocks[0]] == [("0.1",), ("0.5",)]


# Time and memory against length ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def script():
    return loaded("benchmark_length")


def test_the_timeline_of_a_length_is_one_track_of_prompts_the_last_one_shorter(script):
    asked = script.timeline(12, 5, ["walk", "run"])
    assert [(prompt.text, prompt.start, prompt.end) for prompt in asked.prompts] == [
        ("walk", 0, 5),
        ("run", 5, 10),
        ("walk", 10, 12),
    ]
    assert set(asked.rows) == {0}


def test_sampling_is_measured_with_the_settings_of_the_config(script, monkeypatch):
    monkeypatch.setattr(stmc, "load", lambda folder, device: tiny())
    settings = OmegaConf.to_container(configured("benchmark_length", "prompt=1", "steps=2"))
    measured = script.measure("stmc", None, 2, settings)
    assert measured.time > 0
    assert measured.peak >= measured.loaded > 2**20
    assert measured.device == "cpu"


def test_times_are_ratios_on_a_cpu_and_the_straight_lines_go_through_the_longest(script):
    found = {
        (name, None, length): script.Measured(0.3 * length * slow, 10**8, 10**8 + int(1e6 * length * slow), "cpu")
        for name, slow in (("flow_mdm", 1), ("stmc", 2))
        for length in (10, 60, 600)
    }
    rows = script.records(found)
    assert [row["relative_time"] for row in rows] == pytest.approx([1, 6, 60] * 2)
    assert not any("seconds" in row for row in rows)
    assert json.loads(json.dumps(rows)) == rows
    times, memory = length_chart(rows).axes
    flow, straight = times.lines[:2]
    assert np.allclose(flow.get_ydata(), straight.get_ydata())
    assert memory.lines[2].get_ydata()[-1] == pytest.approx(1200e6 / 2**20, rel=1e-6)
    [on_gpu] = script.records({("stmc", None, 10): script.Measured(2.5, 0, 9, "cuda:0")})
    assert on_gpu["seconds"] == 2.5
