"""Recipes of backward jumps and sideways hops: recorded forward jumps, reversed or sheared."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from stmc.data.sources.edited.measuring import both_stand, degrees_turned, distance, flights, forward, leftward, rests
from stmc.data.sources.edited.recipe import Base, Bases, Draft, Recipe, Unusable
from stmc.data.sources.edited.script import ONSET
from stmc.data.sources.edited.standing import draw_standing
from stmc.editing.leg_posing import exact, reach_with_legs, select_legs, smooth
from stmc.editing.paths import change_pace, reverse, shift_sideways
from stmc.editing.resting import add_rest, follow
from stmc.motion.body import PARENTS
from stmc.motion.geometry import axis_angle_to_matrix, global_rotations, matrix_to_axis_angle
from stmc.motion.motion import Motion


def _draw(bases: Bases, rng: np.random.Generator, shortest: float, longest: float) -> Base:
    """Draw a recorded forward jump of a length (in metres) in a range, mirrored half of the time."""
    candidates = bases["jump-forward"]
    base = candidates[int(rng.integers(len(candidates)))]
    if not shortest < distance(base.motion) < longest:
        raise Unusable(f"{base.name} goes {distance(base.motion):.2f} m")
    return Base(base.name, base.recording, base.style, base.motion.mirrored() if rng.random() < 0.5 else base.motion)


def surround_with_rest(motion: Motion, bases: Bases, rng: np.random.Generator) -> Motion:
    """Add rest before and after a motion.

    Args:
        motion: The motion.
        bases: Recorded clips.
        rng: Random generator.
    """
    before, after = ONSET, rng.uniform(1.1, 2.3)
    return add_rest(motion, draw_standing(bases, rng, after + 0.2).motion, before, after)


def soften(motion: Motion, share: float) -> Motion:
    """Make the crouches before and after a jump less deep.

    While the feet stand, the pose moves by the fraction `share` towards that of the first or last frame.
    """
    body, skeleton = exact(motion)
    stands = torch.nn.functional.pad(both_stand(body).double()[None], (1, 0), mode="replicate")[0]
    weight = share * smooth(stands, 1.5)
    apex = int(body.translation[:, 2].argmax())
    late = torch.arange(body.frames) >= apex
    goal = torch.where(late[:, None, None, None], body.rotations[-1], body.rotations[0])
    position = torch.where(late[:, None], body.translation[-1], body.translation[0])
    rotations = body.rotations @ axis_angle_to_matrix(
        weight[:, None, None] * matrix_to_axis_angle(body.rotations.mT @ goal)
    )
    posed = Motion.posed(rotations, torch.lerp(body.translation, position, weight[:, None]), body.fps, skeleton)
    feet = select_legs(global_rotations(body.rotations, PARENTS), "ankle")
    return reach_with_legs(posed, select_legs(body.joints, "ankle"), feet, skeleton)


def jump_back(bases: Bases, rng: np.random.Generator) -> Draft:
    """Reverse and shorten a forward jump, and make its landing less deep than the original take-off."""
    base = _draw(bases, rng, 0.5, 1.3)
    stride = rng.uniform(0.4, 0.8) / distance(base.motion)
    motion = change_pace(reverse(base.motion), tempo=rng.uniform(0.95, 1.1), stride=min(1.0, stride))
    return Draft(surround_with_rest(soften(motion, rng.uniform(0.3, 0.6)), bases, rng), base.recording)


def _is_jump_back(motion: Motion) -> bool:
    straight = abs(degrees_turned(motion)).max() < 40
    return flights(motion) == 1 and -1.0 < forward(motion) < -0.3 and straight and rests(motion, 0.6)


def hop(bases: Bases, rng: np.random.Generator) -> Draft:
    """Shear a forward jump to the left, in a third of the draws two or three times."""
    base = _draw(bases, rng, 0.4, 1.3)
    times = int(rng.choice([1, 2, 3], p=[0.66, 0.22, 0.12]))
    offset = rng.uniform(0.18, 0.35) if rng.random() < 0.4 or times > 1 else rng.uniform(0.35, 0.7)
    motion = change_pace(_lively(base.motion) if times > 1 else base.motion, tempo=rng.uniform(0.95, 1.2))
    motion = soften(shift_sideways(motion, offset, forward=rng.uniform(0.0, 0.1)), rng.uniform(0.35, 0.65))
    hops = motion
    for _ in range(times - 1):
        hops = follow(hops, motion)
    return Draft(surround_with_rest(hops, bases, rng), base.recording)


def _lively(motion: Motion) -> Motion:
    """Cut the standing before and after: from the beginning of the crouch to the end of the rise."""
    height = motion.translation[:, 2]
    sinks = (height[0] - height > 0.02).nonzero()[:, 0]
    rises = (abs(height - height[-1]) > 0.02).nonzero()[:, 0]
    if not len(sinks) or not len(rises):
        raise Unusable("the jump has no crouch")
    return motion.trimmed(max(0, int(sinks[0]) - 2), min(motion.frames, int(rises[-1]) + 3))


def _is_hop(motion: Motion) -> bool:
    aside, straight = leftward(motion), abs(degrees_turned(motion)).max() < 40
    side = aside > 0.12 and abs(forward(motion)) < 0.5 * aside
    return 1 <= flights(motion) <= 3 and side and straight and rests(motion, 0.6)


@dataclass(frozen=True)
class Rested:
    """The `make` of an unedited recorded jump with rest before and after it."""

    action: str

    def __call__(self, bases: Bases, rng: np.random.Generator) -> Draft:
        """Draw a jump."""
        candidates = bases[self.action]
        base = candidates[int(rng.integers(len(candidates)))]
        return Draft(
            surround_with_rest(base.motion.mirrored() if rng.random() < 0.5 else base.motion, bases, rng),
            base.recording,
        )


def _lands(motion: Motion) -> bool:
    return flights(motion) == 1 and abs(degrees_turned(motion)).max() < 40 and rests(motion, 0.6)


RECIPES = (
    Recipe("jump-back", "edited", jump_back, _is_jump_back, clips=80),
    Recipe("hop-left", "edited", hop, _is_hop, clips=100),
    Recipe("jump-forward", "edited", Rested("jump-forward"), _lands, clips=40),
    Recipe("jump-up", "edited", Rested("jump-up"), _lands, clips=40),
)
"""Recipes in the order of the data set."""
