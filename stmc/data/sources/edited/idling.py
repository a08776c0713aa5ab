"""The recipe of standing about: recorded people who stand, breathe and shift their weight.

Knows bases and editing; knows no caches and no texts.
"""

from __future__ import annotations

import numpy as np

from stmc.data.sources.edited.measuring import standing
from stmc.data.sources.edited.recipe import Bases, Draft, Recipe
from stmc.data.sources.edited.standing import draw_standing
from stmc.motion import Motion


def idle(bases: Bases, rng: np.random.Generator) -> Draft:
    """Somebody who stands for four seconds to seven."""
    base = draw_standing(bases, rng, rng.uniform(4.0, 6.9))
    return Draft(base.motion, base.recording)


def _is_idle(motion: Motion) -> bool:
    return bool(standing(motion).all())


RECIPES = (Recipe("idle", "recorded", idle, _is_idle, clips=80, once=False),)
"""In the order of the data set."""
