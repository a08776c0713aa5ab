"""Actions sampled one after the other, each with the last frames of those before it in view (Athanasiou et al. 2022).

Knows plans whose crops look back, see `planning.look_back`, and features made so far; knows no networks and no
samplers.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise, zip_longest
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from stmc.composing.inpainting import Known
from stmc.motion.body import BodyPart
from stmc.timeline.planning import Crop, Plan, Tile


class Action(NamedTuple):
    """A crop of a timeline and their numbers: the frames from `start` on are its own, those before it only sees."""

    timeline: int
    number: int
    crop: Crop
    start: int

    @property
    def plan(self) -> Plan:
        """The crop as a motion of its own."""
        frames = self.crop.frames
        tiles = tuple(Tile(0, part, 0, frames, 1) for part in BodyPart)
        return Plan(frames, (Crop(self.crop.text, 0, frames),), tiles)


def action_rounds(plans: Sequence[Plan]) -> list[list[Action]]:
    """The first action of every plan, then the second one of those that have two, and so on, in order of time.

    Raises `ValueError` for a plan whose crops make the same frames: one of several tracks.
    """
    sequences = [_in_time(i, plan) for i, plan in enumerate(plans)]
    return [[action for action in actions if action is not None] for actions in zip_longest(*sequences)]


def _in_time(timeline: int, plan: Plan) -> list[Action]:
    starts = dict.fromkeys(range(len(plan.crops)), plan.frames)
    for tile in plan.tiles:
        starts[tile.crop] = min(starts[tile.crop], tile.start)
    order = sorted(starts, key=starts.__getitem__)
    for before, after in pairwise(order):
        if plan.crops[before].end != starts[after]:
            texts = f"{plan.crops[before].text!r} and {plan.crops[after].text!r}"
            raise ValueError(f"{texts} hold at the same frames: actions follow each other, on one track")
    return [Action(timeline, number, plan.crops[number], starts[number]) for number in order]


def seen_before(
    actions: Sequence[Action], lengths: Sequence[int], made: Float[Tensor, "batch _ features"], known: Known | None
) -> Known:
    """What is known to actions of one round: of timelines that are `made` so far the frames that each looks back on,
    and of the others that a denoiser sees, as many in all as `lengths` say, what is `known` of the timelines anyway."""
    content = made.new_zeros(len(actions), max(lengths), made.shape[-1])
    weights = torch.zeros_like(content)
    for row, (action, length) in enumerate(zip(actions, lengths, strict=True)):
        start = action.crop.start
        for own, given in zip((content, weights), known or (), strict=False):
            piece = given[action.timeline, start : start + length]
            own[row, : len(piece)] = piece
        content[row, : action.start - start] = made[action.timeline, start : action.start]
        weights[row, : action.start - start] = 1
    return Known(content, weights)
