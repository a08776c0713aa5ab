"""The recipe of idling: recorded people who stand, breathe and shift their weight."""

from __future__ import annotations

import numpy as np

from stmc.data.sources.edited.measuring import both_stand
from stmc.data.sources.edited.recipe import Bases, Draft, Recipe
from stmc.data.sources.edited.standing import draw_standing
from stmc.editing.resting import follow
from stmc.motion.motion import Motion


def idle(bases: Bases, rng: np.random.Generator) -> Draft:
    """Join two or three recordings of standing people, with their feet in place.

    A waiting person breathes, shifts the weight, looks about and changes posture now and then.
    """
    first = draw_standing(bases, rng, rng.uniform(2.4, 3.8), busy=0.7)
    motion = first.motion
    for _ in range(int(rng.integers(1, 3))):
        motion = follow(motion, draw_standing(bases, rng, rng.uniform(2.2, 3.4), busy=0.7).motion)
    return Draft(motion, first.recording)


def _is_idle(motion: Motion) -> bool:
    return bool(both_stand(motion).all())


RECIPES = (Recipe("idle", "edited", idle, _is_idle, clips=80, once=False),)
"""Recipes in the order of the data set."""
