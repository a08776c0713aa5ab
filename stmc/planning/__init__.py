"""From timelines to plans in frames: who owns each body part, crops and tiles, and rules that make plans of plans.

Pure data: knows no features, no denoiser and no torch.
"""

from stmc.planning.assignment import Run, assign
from stmc.planning.plans import Crop, Plan, Span, Tile, plan
from stmc.planning.rules import handshake, multi_diffusion, second_take, soft, transition_spans

__all__ = [
    "Crop",
    "Plan",
    "Run",
    "Span",
    "Tile",
    "assign",
    "handshake",
    "multi_diffusion",
    "plan",
    "second_take",
    "soft",
    "transition_spans",
]
