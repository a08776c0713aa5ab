"""From timelines to plans in frames: ownership of body parts, crops and tiles, and rules that transform plans.

Pure data: independent of features, denoisers and torch.
"""

from stmc.timeline.planning.assignment import Run, assign
from stmc.timeline.planning.plans import Crop, Plan, Span, Tile, plan
from stmc.timeline.planning.rules import (
    cross_fade,
    handshake,
    look_back,
    multi_diffusion,
    reweighted,
    second_take,
    transition_spans,
    weighted,
)

__all__ = [
    "Crop",
    "Plan",
    "Run",
    "Span",
    "Tile",
    "assign",
    "cross_fade",
    "handshake",
    "look_back",
    "multi_diffusion",
    "plan",
    "reweighted",
    "second_take",
    "transition_spans",
    "weighted",
]
