"""Recipes of jumps backwards and hops to the side: recorded jumps forward, played backwards or sheared.

Knows bases and editing; knows no caches and no texts.
"""

from __future__ import annotations

import numpy as np

from stmc.data.sources.edited.measuring import distance, flights, forward, leftward, rests, turned
from stmc.data.sources.edited.recipe import Base, Bases, Draft, Recipe, Unusable
from stmc.data.sources.edited.standing import draw_standing
from stmc.editing.paths import change_pace, reverse, shift_sideways
from stmc.editing.resting import add_rest
from stmc.motion import Motion


def _draw(bases: Bases, rng: np.random.Generator, shortest: float, longest: float) -> Base:
    """A recorded jump forward of such a length in metres, mirrored as often as not."""
    found = bases["jump-forward"]
    base = found[rng.integers(len(found))]
    if not shortest < distance(base.motion) < longest:
        raise Unusable(f"{base.name} goes {distance(base.motion):.2f} m")
    return Base(base.name, base.recording, base.style, base.motion.mirrored() if rng.random() < 0.5 else base.motion)


def rested(motion: Motion, bases: Bases, rng: np.random.Generator) -> Motion:
    """The motion with rest before and after it."""
    before, after = rng.uniform(0.35, 1.0), rng.uniform(1.1, 2.3)
    return add_rest(motion, draw_standing(bases, rng, after + 0.2).motion, before, after)


def jump_back(bases: Bases, rng: np.random.Generator) -> Draft:
    """A jump forward played backwards, shorter."""
    base = _draw(bases, rng, 0.5, 1.3)
    stride = rng.uniform(0.4, 0.8) / distance(base.motion)
    motion = change_pace(reverse(base.motion), tempo=rng.uniform(0.95, 1.1), stride=min(1.0, stride))
    return Draft(rested(motion, bases, rng), base.recording)


def _is_jump_back(motion: Motion) -> bool:
    straight = abs(turned(motion)).max() < 40
    return flights(motion) == 1 and -1.0 < forward(motion) < -0.3 and straight and rests(motion, 0.6)


def hop(bases: Bases, rng: np.random.Generator) -> Draft:
    """A jump forward sheared to the left."""
    base = _draw(bases, rng, 0.4, 1.3)
    way = rng.uniform(0.18, 0.35) if rng.random() < 0.4 else rng.uniform(0.35, 0.7)
    motion = change_pace(base.motion, tempo=rng.uniform(0.95, 1.15))
    motion = shift_sideways(motion, way, forward=rng.uniform(0.0, 0.1))
    return Draft(rested(motion, bases, rng), base.recording)


def _is_hop(motion: Motion) -> bool:
    aside, straight = leftward(motion), abs(turned(motion)).max() < 40
    return (
        1 <= flights(motion) <= 3
        and aside > 0.12
        and abs(forward(motion)) < 0.5 * aside
        and straight
        and rests(motion, 0.6)
    )


RECIPES = (
    Recipe("jump-back", "edited", jump_back, _is_jump_back, clips=80),
    Recipe("hop-left", "edited", hop, _is_hop, clips=100),
)
"""In the order of the data set."""
