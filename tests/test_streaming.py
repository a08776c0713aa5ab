"""Streams: frames of a timeline that is edited while it plays, from a tiny network, and once from the bundled one."""

import dataclasses
import random

import pytest
import torch
from helpers.memory import peak
from helpers.tiny_model import tiny

import stmc
from stmc.diffusion import FrameNoise
from stmc.editing.stream_edits import apply_edit
from stmc.editing.streaming import BLOCK_SECONDS, LOOKAHEAD_SECONDS, MotionStream
from stmc.evaluation.metrics.smoothness import jerk
from stmc.motion.geometry import global_rotations
from stmc.settings.records import SettingError
from stmc.text import Remembered
from stmc.timeline import LiveTimeline, TimelineError

WALK = "walk # 0 # 6 # legs\nwave # 1 # 3 # right arm\nturn left # 6 # 9"


def stream(text: str = WALK, seed: int = 0, **settings) -> MotionStream:
    return tiny().stream(text, seed, **{"steps": 2, **settings})


def joints(frames: int, opened: MotionStream) -> torch.Tensor:
    return opened.take(frames).joints


@pytest.fixture(scope="module")
def tall() -> stmc.Motion:
    """Fifteen seconds without an edit."""
    return stream().take(300)


# ---- what a window is planned and drawn from ------------------------------------------------------------------------


def test_a_window_of_a_plan_has_the_crops_of_the_whole_timeline():
    timeline = stmc.Timeline.parse(f"{WALK}\nrun # 10 # 40")
    whole = stmc.plan(timeline, 20, 10, 100)
    assert stmc.plan(timeline, 20, 10, 100, window=(0, 800)) == whole
    part = stmc.plan(timeline, 20, 10, 100, window=(300, 500))
    inside = {(crop.text, crop.start, crop.end) for crop in whole.crops if crop.start >= 300 and crop.end <= 500}
    found = {(crop.text, crop.start + 300, crop.end + 300) for crop in part.crops}
    assert part.frames == 200 and inside and inside <= found


def test_a_window_may_lie_after_the_end_in_a_gap():
    plan = stmc.plan(stmc.Timeline.parse("walk # 0 # 2"), 20, 10, 100, window=(100, 180))
    assert {crop.text for crop in plan.crops} == {None}


@pytest.mark.parametrize("window", [(-1, 10), (20, 20)])
def test_a_window_that_is_none_is_refused(window):
    with pytest.raises(ValueError, match="window"):
        stmc.plan(stmc.Timeline.parse("walk # 0 # 2"), 20, 10, window=window)


def test_noise_belongs_to_frames():
    early, late = FrameNoise(3, [10], [30], 4), FrameNoise(3, [25, 30], [30, 10], 4)
    for _ in range(2):  # also that of later steps
        before, after = early(), late()
        assert torch.equal(before[0, 15:], after[0, :15]) and torch.equal(after[1, :10], after[0, 5:15])
        assert not after[1, 10:].any() and not torch.equal(before[0, 0], before[0, 1])
    assert not torch.equal(FrameNoise(4, [10], [30], 4)(), FrameNoise(3, [10], [30], 4)())


def test_an_encoder_that_remembers_encodes_the_latest_texts_once():
    model = tiny()
    remembered = Remembered(model.text_encoder, most=2)
    words, lengths = remembered(["walk on", "run", "walk on"])
    assert torch.equal(words, model.text_encoder.encode(["walk on", "run", "walk on"])[0]) and lengths.tolist() == [
        2,
        1,
        2,
    ]
    model.text_encoder.encoded.clear()
    remembered(["run"]), remembered(["jump"]), remembered(["run"])
    assert model.text_encoder.encoded == ["jump"]
    remembered(["walk on"])
    assert model.text_encoder.encoded == ["jump", "walk on"]


# ---- prompts ahead of the cursor ------------------------------------------------------------------------------------


def test_what_is_out_does_not_change():
    live = LiveTimeline(20, stmc.Timeline.parse(WALK).prompts)
    live.cursor = 80
    refused = {
        "'jump' cannot start at 3.9 s: changes are possible from 4.00 s on": lambda: live.add(
            stmc.Prompt("jump", 3.9, 6)
        ),
        "prompt 1 has been removed or has ended": lambda: live.remove(1),
        "'walk' has begun at 0 s; only its end can move": lambda: live.move(0, 1, 8),
        "'walk' cannot end at 3 s: changes": lambda: live.move(0, 0, 3),
        "'turn left' cannot start at 2 s": lambda: live.move(2, 2, 9),
        "there is no prompt 3: they have the numbers 0 to 2": lambda: live.remove(3),
    }
    before = dict(live.prompts)
    for sentence, edit in refused.items():
        with pytest.raises(TimelineError, match=sentence.replace("(", r"\(")):
            edit()
    assert live.prompts == before


def test_prompts_change_from_the_cursor_on():
    live = LiveTimeline(20, stmc.Timeline.parse(WALK).prompts)
    live.cursor = 90
    assert live.add(stmc.Prompt("jump", 4.5, 6)) == 3
    live.move(0, 0, 4.5)
    live.move(2, 7, 8)
    live.remove(3)
    assert 3 not in live.prompts and (live.prompts[0].end, live.prompts[2].start) == (4.5, 7)
    live.cursor = 150
    live.remove(2)
    assert live.prompts[2].end == 7.5


@pytest.mark.parametrize("fps", [20, 29.97, 30, 12.5, 120])
def test_now_is_the_cursor_at_any_frame_rate(fps):
    live = LiveTimeline(fps)
    for live.cursor in range(1, 3000):
        assert int(fps * live.now) == live.cursor


def test_prompts_of_long_ago_are_forgotten_but_for_the_last_that_ended():
    live = LiveTimeline(20, [stmc.Prompt("walk", number, number + 1) for number in range(50)], memory=40)
    live.cursor = 2000
    number = live.add(stmc.Prompt("run", 100, 101))
    assert set(live.prompts) == {49, number} and live.timeline.prompts[0].text == "walk"
    with pytest.raises(TimelineError, match="prompt 3 has been removed or has ended"):
        live.remove(3)


def test_a_timeline_may_begin_without_prompts_and_lose_the_last():
    live = LiveTimeline(20)
    assert live.timeline is None
    live.remove(live.add(stmc.Prompt("walk", 0, 1)))
    assert live.timeline is None
    with pytest.raises(TimelineError, match="have the numbers 0 to 0"):
        live.remove(4)


# ---- frames ---------------------------------------------------------------------------------------------------------


def test_the_same_seed_gives_the_same_frames_however_they_are_taken(tall):
    again, frames = stream(), []
    for count in (1, 39, 41, 7, 212):
        frames.append(joints(count, again))
    assert torch.equal(torch.cat(frames), tall.joints)
    assert not torch.equal(joints(40, stream(seed=1)), tall.joints[:40])


def edited(opened: MotionStream) -> MotionStream:
    opened.take(57)
    opened.add(stmc.Prompt("jump", 3.5, 5, ["legs"]))
    opened.take(30)
    opened.move(2, 7, 8)
    opened.remove(0)
    return opened


def test_the_same_edits_give_the_same_frames_and_others_from_the_next_frame_on(tall):
    first, second = edited(stream()), edited(stream())
    assert torch.equal(joints(100, first), joints(100, second))
    opened = stream()
    before = joints(57, opened)
    opened.remove(0)
    after = joints(60, opened)
    assert torch.equal(before, tall.joints[:57])
    assert not torch.equal(after[0], tall.joints[57])


def test_an_edit_of_what_no_frame_needs_yet_leaves_the_block_as_it_is(tall):
    opened = stream()
    opened.take(3)
    opened.add(stmc.Prompt("jump", 12, 14))
    block = int(BLOCK_SECONDS * 20)
    assert torch.equal(joints(block - 3, opened), tall.joints[3:block])


def test_a_model_of_few_steps_streams_in_its_own():
    few = dataclasses.replace(tiny(), sampling=stmc.Sampling(steps=2, sampler="ddim"))
    assert torch.equal(joints(50, few.stream(WALK)), joints(50, stream(steps=2, sampler="ddim")))
    assert torch.equal(joints(50, tiny().stream(WALK)), joints(50, stream(steps=10, sampler="ddim")))


def test_frames_are_numbered_and_a_motion_holds_their_poses():
    opened, same = stream(), stream()
    frames = [next(opened) for _ in range(45)]
    assert [frame.number for frame in frames] == list(range(45)) and frames[-1].seconds == 44 / 20
    motion = same.take(45)
    assert torch.equal(motion.rotations, torch.stack([frame.rotations for frame in frames]))
    assert torch.equal(motion.translation, torch.stack([frame.translation for frame in frames]))


def test_the_body_goes_on_where_it_was(tall):
    """Neither place nor heading jumps where a window begins."""
    edges = [edge - 1 for edge in range(40, 290, 1)]
    steps = tall.translation.diff(dim=0).norm(dim=-1)
    turns = global_rotations(tall.rotations, stmc.motion.body.PARENTS)[:, 0]
    angles = (turns[1:] @ turns[:-1].mT).diagonal(dim1=-2, dim2=-1).sum(dim=-1)
    assert float(steps[edges].max()) < 3 * float(steps[:39].max())
    assert float(angles[edges].min()) > float(angles[:39].min()) - 0.1
    bones = tall.joints[:, 1] - tall.joints[:, 0]
    assert torch.allclose(bones.norm(dim=-1), bones[0].norm())


def test_without_prompts_the_stream_goes_on():
    opened = stream(stmc.editing.streaming.EMPTY)
    assert opened.prompts == {} and opened.take(50).frames == 50
    opened.add(stmc.Prompt("walk", opened.now, 4))
    assert opened.take(100).frames == 100


@pytest.mark.parametrize("method", ["stmc_paper", "multi_diffusion"])
def test_other_methods_that_compose_at_every_step_stream_too(method):
    opened = stream(method=method, sampler="ddpm", clean_feet=False)
    assert opened.take(60).frames == 60


def test_standing_feet_stay_without_changing_what_is_out():
    cleaned, raw = stream().take(60), stream(clean_feet=False).take(60)
    assert not torch.equal(cleaned.joints, raw.joints)
    block = int(20 * BLOCK_SECONDS)  # later ones go on from cleaned poses
    assert torch.equal(cleaned.translation[:block, :2], raw.translation[:block, :2])


def test_what_a_stream_cannot_do_is_refused(tall):
    model = tiny()
    refused = {
        "keep": {"keep": tall},
        "composes at every step": {"method": "sinc"},
        "did you mean steps": {"stepz": 3},
        "at most 100": {"steps": 101},
    }
    for words, settings in refused.items():
        with pytest.raises(SettingError, match=words):
            model.stream(**settings)
    other = dataclasses.replace(model, representation=stmc.motion.representation.HumanML3DRepresentation())
    with pytest.raises((SettingError, ValueError), match="forward kinematics"):
        other.stream()


# ---- many edits, and a long time ------------------------------------------------------------------------------------


def random_edit(opened: MotionStream, draw: random.Random) -> None:
    kind = draw.choice(["add", "add", "move", "remove"])
    if kind == "add" or not opened.prompts:
        start = opened.now + draw.uniform(-0.3, 3)
        parts = draw.choice([[], ["legs"], ["right arm"], ["left arm", "head"]])
        opened.add(
            stmc.Prompt(
                draw.choice(["walk", "run", "wave", "jump"]), max(0, start), start + draw.uniform(0.5, 3), parts
            )
        )
        return
    number = draw.choice(list(opened.prompts))
    if kind == "move":
        prompt, by = opened.prompts[number], draw.uniform(-1, 1)
        opened.move(number, max(0, prompt.start + by * (draw.random() < 0.5)), prompt.end + by)
    else:
        opened.remove(number)


@pytest.mark.parametrize("edits", [50, pytest.param(200, marks=pytest.mark.slow)])
def test_random_edits_lose_nothing(edits):
    """Every frame is sampled with the prompts that hold there in the end, though others were in its way."""
    opened, draw = stream(steps=1, clean_feet=False), random.Random(0)
    history, sampled, accepted = dict(opened.prompts), [], 0
    while accepted < edits:
        for _ in range(draw.choice([0] * 15 + [6, 12])):
            try:
                random_edit(opened, draw)
                accepted += 1
            except TimelineError:
                continue
            taken_back = {key for key in history if key not in opened.prompts and history[key].start >= opened.now}
            history = {key: prompt for key, prompt in (history | opened.prompts).items() if key not in taken_back}
        frame = next(opened)
        assert frame.number == len(sampled) and torch.isfinite(frame.joints).all()
        sampled.append(holding(opened._timeline.prompts, frame.number))
    assert sampled == [holding(history.values(), frame) for frame in range(len(sampled))]


def holding(prompts, frame: int) -> list[tuple]:
    return sorted(
        (prompt.text, sorted(prompt.parts), int(20 * prompt.start)) for prompt in prompts
        if int(20 * prompt.start) <= frame < int(20 * prompt.end)
    )  # fmt: skip


@pytest.mark.parametrize("minutes", [1, pytest.param(10, marks=pytest.mark.slow)])
def test_nothing_grows_with_time(minutes):
    """Frames and prompts of long ago are forgotten; ten minutes take no more memory than one."""
    opened, bound = (
        stream("walk # 0 # 1", steps=1, clean_feet=False),
        100 + int((BLOCK_SECONDS + LOOKAHEAD_SECONDS) * 20) + 200,
    )
    peaks = []
    for minute in range(minutes):
        opened.add(stmc.Prompt("run", 60 * minute + 2, 60 * minute + 4))
        opened.take(1200)
        assert len(opened._sheet.features) <= bound and len(opened.prompts) <= 3
        peaks.append(peak())
    assert opened.cursor == 1200 * minutes
    assert peaks[-1] - peaks[min(1, minutes - 1)] < 20 * 1024  # KiB


# ---- edits as JSON --------------------------------------------------------------------------------------------------


def test_edits_are_json_objects_and_are_answered():
    opened = stream("walk # 0 # 4")
    opened.take(21)
    assert apply_edit(opened, {"add": {"text": "wave", "seconds": 2, "body_parts": ["right arm"]}}) == {
        "added": 1, "start": 1.05, "end": 3.05,
    }  # fmt: skip
    assert apply_edit(opened, {"move": 1, "end": 5}) == {"moved": 1, "start": 1.05, "end": 5}
    assert apply_edit(opened, {"add": {"text": "run", "start": 4, "end": 6}})["added"] == 2
    assert apply_edit(opened, {"remove": 2}) == {"removed": 2}
    assert [prompt.text for prompt in opened.prompts.values()] == ["walk", "wave"]


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        ({}, "one of the keys add, move, remove"),
        ({"add": "walk"}, "add="),
        ({"add": {"text": "walk"}}, "its end or its seconds"),
        ({"add": {"text": "walk", "seconds": 1, "end": 2}}, "its end or its seconds"),
        ({"add": {"text": 3, "seconds": 1}}, "text=3: must be a text"),
        ({"add": {"text": "walk", "seconds": True}}, "seconds=true"),
        ({"add": {"text": "walk", "seconds": 1, "body_parts": "legs"}}, "body_parts"),
        ({"add": {"text": "walk", "secs": 1}}, "did you mean seconds"),
        ({"add": {"text": "walk", "seconds": -1}}, "seconds=-1: must be above 0"),
        ({"move": "0", "end": 3}, "whole number"),
        ({"move": 0, "to": 3}, "unknown key"),
        ({"remove": 9}, "no prompt 9"),
    ],
)
def test_edits_that_are_none_are_refused(edit, words):
    with pytest.raises((SettingError, TimelineError), match=words):
        apply_edit(stream("walk # 0 # 4"), edit)


# ---- the bundled network --------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_where_windows_meet_nothing_jumps_more_than_within_them():
    """Hand steps and jerk of the bundled fast model, with and without edits: at the edges no larger than between."""
    opened, edges = (
        stmc.load("mdm_smpl_wide_fast").stream("walk forwards # 0 # 8\nraise the right arm # 2 # 5 # right arm"),
        [],
    )
    sample = opened._sample_block
    opened._sample_block = lambda: edges.append(opened.cursor) or sample()
    frames = [opened.take(90)]
    opened.add(stmc.Prompt("wave with the left hand", opened.now, 7, ["left arm"]))
    frames.append(opened.take(60))
    opened.remove(0)
    opened.add(stmc.Prompt("jump", opened.now, 10))
    frames.append(opened.take(150))
    together = torch.cat([motion.joints for motion in frames])
    hands = (together[:, [20, 21]] - together[:, :1]).diff(dim=0).norm(dim=-1).amax(dim=-1)
    jerks, at_edge = jerk(together[:, :22]), torch.zeros(300, dtype=torch.bool)
    for edge in edges[1:]:
        at_edge[edge - 3 : edge + 1] = True
    for values in (hands, jerks):
        near = at_edge[: len(values)]
        assert float(values[near].max()) <= float(values[~near].max())
