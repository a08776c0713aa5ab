"""Loops: what repeats is found, its ends meet, and the way that the body goes is kept."""

import math

import pytest
import torch
from helpers.motions import walk, walking

from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import rotation_z
from stmc.motion.loops import looped
from stmc.motion.motion import Motion

CYCLE = 1 / 0.9
"""Seconds of two steps of `walking`."""


def local(motion: Motion) -> torch.Tensor:
    """Joints beside the pelvis, at heading zero."""
    return (motion.joints - motion.translation[:, None]) @ rotation_z(motion.heading)


def steps(motion: Motion) -> tuple[float, float]:
    """The largest step of a joint from the last frame to the first, and from any frame to the next."""
    poses = local(motion)
    return tuple(float(step.norm(dim=-1).max()) for step in (poses[0] - poses[-1], poses.diff(dim=0)))


def test_the_cycle_of_a_walk_is_found():
    loop = looped(walking(seconds=6.0, turn=0.0).trimmed(0, 40))  # the arm rises later
    assert loop.duration / CYCLE == pytest.approx(round(loop.duration / CYCLE), abs=0.06)


@pytest.mark.parametrize("motion", [walking(seconds=4.0), walk(frames=80, seed=1)], ids=["walking", "wandering"])
def test_the_seam_is_no_larger_than_the_steps_of_the_loop(motion):
    seam, own = steps(looped(motion))
    assert seam < 1.3 * own


def test_a_loop_of_so_many_seconds_lasts_as_long():
    assert looped(walking(seconds=4.0), seconds=1.5).frames == 30


def test_the_way_and_the_turn_of_the_body_are_the_motion_s():
    motion = walking(seconds=4.0, turn=0.3)
    loop = looped(motion, seconds=2)
    ways = motion.translation.diff(dim=0)[:, :2].norm(dim=-1).mean()
    assert loop.translation.diff(dim=0)[:, :2].norm(dim=-1).mean() == pytest.approx(float(ways), rel=1e-3)
    assert float(loop.heading.diff().mean()) == pytest.approx(0.3 / 20, rel=0.2)


def test_bones_keep_their_lengths():
    loop = looped(walk(frames=60))
    posed = Skeleton.default().pose(loop.rotations, loop.translation)
    assert (posed - loop.joints).abs().max() < 1e-5


def test_a_motion_that_is_a_loop_already_is_hardly_changed():
    motion = walking(seconds=3.9, fps=18.0, turn=0.0, speed=0.9)  # a cycle is 20 frames
    loop = looped(motion.trimmed(0, 24), seconds=20 / 18)
    nearest = torch.cdist(local(loop).flatten(1), local(motion).flatten(1)).amin(dim=1)
    assert nearest.max() < 0.2 and math.isclose(loop.fps, 18.0)


def test_a_motion_that_is_too_short_is_refused():
    with pytest.raises(ValueError, match="20 frames are too short for a loop of 20"):
        looped(walking(seconds=1.0), seconds=1)
    assert looped(walking(seconds=1.0)).frames >= 16
