"""Clips for any duration: cycles go on as they would, rest follows where the body is near it, nothing else changes."""

import math

import pytest
import torch
from helpers.scripts import configured

from stmc.cli.training_data import read_training_data
from stmc.data.cache import Cache, Clip
from stmc.motion.representation.layout import SMPL_LAYOUT
from stmc.training.data.prolonging import NEAR, Prolonging

FPS = 20
PERIOD = 20  # frames


def features(frames: int, swing: float = 0.0, yaw: float = 0.0, away: float = 0.0) -> torch.Tensor:
    """A body whose joints all swing so many metres, `away` from where the others of its kind are."""
    moved = torch.zeros(frames, SMPL_LAYOUT.width)
    phase = torch.arange(frames) * 2 * math.pi / PERIOD
    positions = SMPL_LAYOUT["positions"]
    width = positions.stop - positions.start
    moved[:, positions] = torch.stack([phase.sin(), phase.cos(), torch.zeros(frames)], dim=1).repeat(1, width // 3)
    moved[:, positions] = moved[:, positions] * swing + away
    rotations = SMPL_LAYOUT["rotations"]
    moved[:, rotations] = torch.tensor([1.0, 0, 0, 0, 1, 0]).repeat((rotations.stop - rotations.start) // 6)
    moved[:, SMPL_LAYOUT["root_velocity"]] = 1.2 / FPS
    moved[:, SMPL_LAYOUT["yaw_velocity"]] = yaw
    return moved


def cache(*rows: tuple[str, bool, torch.Tensor]) -> Cache:
    clips, start = [], 0
    for number, (content, cyclic, moved) in enumerate(rows):
        name, end = f"{number}_{content}", start + len(moved)
        clips.append(Clip(name, content, "normal", content, ("legs",), cyclic, False, "train", start, end))
        start = end
    texts = {content: ((content, 1.0),) for content, _, _ in rows}
    return Cache(FPS, "smpl", torch.cat([moved for _, _, moved in rows]), tuple(clips), texts)


def clips(prolonged: Cache) -> dict[str, torch.Tensor]:
    return {clip.name: prolonged.features[clip.start : clip.end] for clip in prolonged.clips}


def test_a_cycle_goes_on_as_it_would_have():
    prolonged = clips(Prolonging(10)(cache(("run", True, features(65, swing=0.4))), SMPL_LAYOUT))
    torch.testing.assert_close(prolonged["0_run"], features(200, swing=0.4), atol=1e-5, rtol=0)


def test_who_walks_straight_on_the_whole_goes_on_straight():
    wavering = features(70, swing=0.4)
    wavering[:, SMPL_LAYOUT["yaw_velocity"]] = torch.linspace(-0.1, 0.1, 70)[:, None]
    straight = clips(Prolonging(30)(cache(("walk", True, wavering)), SMPL_LAYOUT))["0_walk"]
    turned = straight[70:, SMPL_LAYOUT["yaw_velocity"]].sum()
    assert len(straight) == 600
    assert abs(turned) < math.radians(30)  # uncorrected, the last cycles of the clip alone would go round in circles


def test_a_turn_goes_on_turning():
    turning = features(70, swing=0.4, yaw=0.05)
    prolonged = clips(Prolonging(10)(cache(("salsa", True, turning)), SMPL_LAYOUT))["0_salsa"]
    torch.testing.assert_close(prolonged[:, SMPL_LAYOUT["yaw_velocity"]], torch.full((200, 1), 0.05))


@pytest.mark.parametrize("frames", [15, 200, 260])
def test_what_is_too_short_or_long_enough_stays(frames):
    before = cache(("run", True, features(frames, swing=0.4)))
    torch.testing.assert_close(Prolonging(10)(before, SMPL_LAYOUT).features, before.features)


def test_what_never_comes_back_stays():
    drifting = features(60)
    drifting[:, SMPL_LAYOUT["positions"]] = torch.linspace(0, 4, 60)[:, None]
    before = cache(("fly", True, drifting))
    torch.testing.assert_close(Prolonging(10)(before, SMPL_LAYOUT).features, before.features)


def test_rest_follows_what_happens_once_and_the_clip_itself_stays():
    once = features(40)
    once[:20, SMPL_LAYOUT["positions"]] = 1.0  # up there, and back
    before = cache(("jump", False, once), ("stand", True, features(40, swing=0.02)))
    after = clips(Prolonging(10)(before, SMPL_LAYOUT))
    assert list(after) == ["0_jump", "0_jump/followed", "1_stand"]
    torch.testing.assert_close(after["0_jump"], once)
    rested = after["0_jump/followed"]
    assert 40 + 0.5 * FPS <= len(rested) <= 40 + 4 * FPS
    torch.testing.assert_close(rested[:32], once[:32])
    positions = rested[:, SMPL_LAYOUT["positions"]]
    assert positions[40:].abs().max() <= 0.0201  # as still as the one who stands
    assert positions[25:].diff(dim=0).abs().max() < 0.02  # nobody is beamed there
    lengths = rested[:, SMPL_LAYOUT["rotations"]].reshape(-1, 2, 3).norm(dim=-1)
    torch.testing.assert_close(lengths, torch.ones_like(lengths))


@pytest.mark.parametrize(("away", "rested"), [(0.5 * NEAR, True), (2 * NEAR, False)])
def test_rest_follows_only_where_the_body_is_near_it(away, rested):
    before = cache(("jump", False, features(40)), ("stand", True, features(200, away=away / math.sqrt(3))))
    assert ("0_jump/followed" in clips(Prolonging(10)(before, SMPL_LAYOUT))) == rested


def test_held_out_clips_and_clips_without_texts_lend_and_get_no_rest():
    before = cache(("jump", False, features(40)), ("stand", True, features(200)))
    held_out = [*before.clips[:1], Clip(**{**before.clips[1].__dict__, "split": "test"})]
    kept = Cache(FPS, "smpl", before.features, tuple(held_out), before.texts)
    silent = Cache(FPS, "smpl", before.features, before.clips, before.texts | {"jump": ()})
    for each in (kept, silent):
        assert "0_jump/followed" not in clips(Prolonging(10)(each, SMPL_LAYOUT))


@pytest.mark.parametrize("name", ["train", "train_tmr"])
def test_denoisers_and_evaluators_are_trained_on_prolonged_clips(name, tmp_path):
    cache(*[("run", True, features(65, swing=0.4))] * 5).write(tmp_path / "cache")
    places = (f"data.folder={tmp_path / 'cache'}", f"text_cache={tmp_path / 'texts'}", "run=none")
    prolonging = "data.prolonging={_target_: stmc.training.data.prolonging.Prolonging, seconds: 10}"
    for settings, frames in (((), 65), ((prolonging,), 200)):
        _, dataset = read_training_data(configured(name, *places, *settings), None, torch.device("cpu"))
        assert {clip.end - clip.start for clip in dataset.clips} == {frames}
