"""Consecutive sampling of actions, each with the last frames of the previous actions as context.

See Athanasiou et al. (2022). Depends on plans whose crops look back (`planning.look_back`) and on finished features;
independent of networks and samplers.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise, zip_longest
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from stmc.composing.inpainting import Observed
from stmc.motion.body import BodyPart
from stmc.timeline.planning import Crop, Plan, Tile


class Action(NamedTuple):
    """A crop of a timeline with its indices: it owns the frames from `start` on; earlier frames are context."""

    timeline: int
    number: int
    crop: Crop
    start: int

    @property
    def plan(self) -> Plan:
        """The crop as a separate motion."""
        frames = self.crop.frames
        tiles = tuple(Tile(0, part, 0, frames, 1) for part in BodyPart)
        return Plan(frames, (Crop(self.crop.text, 0, frames),), tiles)


def action_rounds(plans: Sequence[Plan]) -> list[list[Action]]:
    """Group actions into rounds: the first action of every plan, then the second, and so on, in time order.

    Raises `ValueError` if crops of a plan own the same frames, that is, for several tracks.
    """
    sequences = [_actions_in_order(i, plan) for i, plan in enumerate(plans)]
    return [[action for action in actions if action is not None] for actions in zip_longest(*sequences)]


def _actions_in_order(timeline: int, plan: Plan) -> list[Action]:
    starts = dict.fromkeys(range(len(plan.crops)), plan.frames)
    for tile in plan.tiles:
        starts[tile.crop] = min(starts[tile.crop], tile.start)
    order = sorted(starts, key=starts.__getitem__)
    for earlier, later in pairwise(order):
        if plan.crops[earlier].end != starts[later]:
            texts = f"{plan.crops[earlier].text!r} and {plan.crops[later].text!r}"
            raise ValueError(f"{texts} hold at the same frames; this method needs consecutive actions on one track")
    return [Action(timeline, number, plan.crops[number], starts[number]) for number in order]


def observed_features(
    actions: Sequence[Action],
    lengths: Sequence[int],
    finished: Float[Tensor, "batch _ features"],
    observed: Observed | None,
) -> Observed:
    """Return the observed features of the actions of one round.

    These are the finished frames that each action looks back on; all other frames are observed as in the timelines.

    Args:
        actions: Actions of the round.
        lengths: Number of frames that the denoiser sees of each action.
        finished: Finished features of the timelines, [batch, frames, features].
        observed: Observed features of the timelines, or None.
    """
    content = finished.new_zeros(len(actions), max(lengths), finished.shape[-1])
    weights = torch.zeros_like(content)
    for row, (action, length) in enumerate(zip(actions, lengths, strict=True)):
        start = action.crop.start
        for target, source in zip((content, weights), observed or (), strict=False):
            chunk = source[action.timeline, start : start + length]
            target[row, : len(chunk)] = chunk
        content[row, : action.start - start] = finished[action.timeline, start : action.start]
        weights[row, : action.start - start] = 1
    return Observed(content, weights)
