"""Recipes of walking, jogging and turning: recorded walks and runs on other paths, at other paces and backwards."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from dataclasses import dataclass

import numpy as np

from stmc.data.sources.edited.measuring import degrees_turned, distance, flights, foot_speed, forward, pace, steady
from stmc.data.sources.edited.recipe import Base, Bases, Draft, Recipe, Unusable
from stmc.data.sources.edited.script import ONSET
from stmc.data.sources.edited.standing import draw_standing
from stmc.data.sources.edited.strides import repeat_strides
from stmc.editing.paths import bend_path, change_pace, reverse
from stmc.editing.turning import turn_on_spot
from stmc.motion.kinematics import joint
from stmc.motion.motion import Motion

_EVEN = ("normal", "active", "feminine", "masculine", "youthful", "happy")
"""Styles of plain walks."""
_CALM = ("normal", "feminine", "masculine", "youthful", "happy")
"""Styles whose arms are not a runner's."""
_SLOW = (*_CALM, "old", "elderly", "tired", "not-confident", "proud", "sad")
"""Styles that include slow walks."""
_LONGEST = 9.5
"""Maximum duration in seconds of a clip of a cyclic action."""


def _draw(
    bases: Bases, rng: np.random.Generator, actions: Collection[str], styles: Collection[str], seconds: float
) -> Base:
    """Draw the steady part of a recording of one of these actions, mirrored half of the time.

    Raises `Unusable` if it is shorter than `seconds`.
    """
    candidates = [base for action in actions for base in bases.get(action, ()) if base.style in styles]
    if not candidates:
        raise Unusable(f"no recording of {', '.join(actions)}")
    base = candidates[rng.integers(len(candidates))]
    motion = base.motion.trimmed(*steady(base.motion))
    if motion.duration < seconds:
        raise Unusable(f"{base.name} is shorter than {seconds:g} s")
    return Base(base.name, base.recording, base.style, motion.mirrored() if rng.random() < 0.5 else motion)


def _part(motion: Motion, rng: np.random.Generator, seconds: float) -> Motion:
    """Cut a random part of at most `seconds`."""
    frames = min(motion.frames, round(seconds * motion.fps))
    start = int(rng.integers(motion.frames - frames + 1))
    return motion.trimmed(start, start + frames)


def _is_straight(motion: Motion) -> bool:
    return abs(degrees_turned(motion)).max() < 30


def circle(bases: Bases, rng: np.random.Generator) -> Draft:
    """Bend a walk by 48 to 72 degrees per second."""
    base = _draw(bases, rng, ("walk",), _EVEN, 5.5)
    change = rng.uniform(0.85, 1.3) / pace(base.motion)
    tempo = float(np.clip(change, 0.8, 1.05))
    motion = change_pace(base.motion, tempo, float(np.clip(change / tempo, 0.8, 1.0)))
    rate = math.radians(rng.uniform(48, 72))
    motion = _part(motion, rng, _LONGEST)
    return Draft(bend_path(motion, radius=pace(motion) / rate), base.recording)


def _circles(motion: Motion) -> bool:
    angle = degrees_turned(motion)
    return angle[-1] > 340 and 0.75 < pace(motion) < 1.5


@dataclass(frozen=True)
class Bend:
    """Walks that turn left by a total angle, over 3.5 to 9.5 seconds: the recipe's `make`.

    A network that has only seen short turns goes on turning when it is asked for a long one.

    Args:
        angles: Range of the angle in degrees.
        ramps: Range of the fraction of the path over which the curvature grows, and over which it falls.
    """

    angles: tuple[float | int, float | int]
    ramps: tuple[float | int, float | int]

    def __call__(self, bases: Bases, rng: np.random.Generator) -> Draft:
        """Draw a walk, and bend it."""
        base = _draw(bases, rng, ("walk",), _EVEN, 3.6)
        motion = change_pace(base.motion, tempo=rng.uniform(0.8, 1.05), stride=rng.uniform(0.75, 1.0))
        motion = _part(motion, rng, rng.uniform(3.6, _LONGEST))
        angle, ramp = math.radians(rng.uniform(*self.angles)), rng.uniform(*self.ramps)
        return Draft(bend_path(motion, angle=angle, ramp=ramp), base.recording)


def _is_quarter(motion: Motion) -> bool:
    angle = degrees_turned(motion)
    return 72 < angle[-1] < 108 and angle.max() < 115 and distance(motion) > 1.5


def _is_veer(motion: Motion) -> bool:
    angle = degrees_turned(motion)
    return 20 < angle[-1] < 55 and angle.max() < 65 and angle.min() > -20


def slow(bases: Bases, rng: np.random.Generator) -> Draft:
    """Make a walk with fewer and shorter steps."""
    base = _draw(bases, rng, ("walk", "walk-slow"), _SLOW, 2.5)
    return Draft(_at_speed(base.motion, rng, rng.uniform(0.3, 0.65), (0.58, 0.95)), base.recording)


def fast(bases: Bases, rng: np.random.Generator) -> Draft:
    """Make a walk with more and longer steps."""
    base = _draw(bases, rng, ("walk",), ("normal", "active", "feminine", "masculine", "youthful"), 3.0)
    return Draft(_at_speed(base.motion, rng, rng.uniform(1.65, 2.05), (1.12, 1.38)), base.recording)


def back_slow(bases: Bases, rng: np.random.Generator) -> Draft:
    """Make a backward walk, recorded or reversed, with fewer and shorter steps."""
    motion, recording = _backwards(bases, rng)
    return Draft(_at_speed(motion, rng, rng.uniform(0.25, 0.45), (0.58, 0.95)), recording)


def back_fast(bases: Bases, rng: np.random.Generator) -> Draft:
    """Make a backward walk, recorded or reversed, with more steps."""
    motion, recording = _backwards(bases, rng)
    return Draft(_at_speed(motion, rng, rng.uniform(1.1, 1.5), (1.1, 1.4)), recording)


def _backwards(bases: Bases, rng: np.random.Generator) -> tuple[Motion, str]:
    if rng.random() < 0.35:
        base = _draw(bases, rng, ("walk-back",), (*_SLOW, "masculinity", "musical", "chimpira", "active"), 2.5)
        return base.motion, base.recording
    base = _draw(bases, rng, ("walk",), _CALM, 3.0)
    return reverse(base.motion), base.recording


def _at_speed(motion: Motion, rng: np.random.Generator, speed: float, tempos: tuple[float, float]) -> Motion:
    """Change a motion to a speed in m/s, about half by its tempo and the rest by its stride."""
    change = speed / pace(motion)
    tempo = float(np.clip(change ** rng.uniform(0.4, 0.6), *tempos))
    stride = change / tempo
    if not 0.35 < stride < 1.2:
        raise Unusable(f"the speed needs steps {stride:.2f} times as long")
    seconds = rng.uniform(5.0, _LONGEST)
    return _part(change_pace(repeat_strides(motion, seconds * tempo), tempo, stride), rng, seconds)


_RUNNERS = ("normal", "active", "feminine", "masculine", "youthful", "happy", "exhausted")
"""Styles of plain runs."""


def long_run(bases: Bases, rng: np.random.Generator) -> Draft:
    """Repeat the strides of a run; recorded ones last two to four seconds."""
    base = _draw(bases, rng, ("run",), _RUNNERS, 1.9)
    seconds = rng.uniform(4.0, _LONGEST)
    return Draft(change_pace(repeat_strides(base.motion, seconds), tempo=rng.uniform(0.95, 1.05)), base.recording)


def _runs(motion: Motion) -> bool:
    return _is_straight(motion) and 1.6 < forward(motion) / motion.duration < 4.5 and flights(motion) >= motion.duration


def jog_back(bases: Bases, rng: np.random.Generator) -> Draft:
    """Reverse a run, with short steps."""
    base = _draw(bases, rng, ("run",), _RUNNERS, 1.9)
    longer = repeat_strides(base.motion, rng.uniform(3.0, _LONGEST))
    motion = change_pace(reverse(longer), tempo=rng.uniform(0.92, 1.08), stride=rng.uniform(0.42, 0.62))
    return Draft(_part(motion, rng, _LONGEST), base.recording)


@dataclass(frozen=True)
class HalfTurn:
    """Half turns to the left on one foot: the recipe's `make` and its gate."""

    pivot: str

    def make(self, bases: Bases, rng: np.random.Generator) -> Draft:
        """Draw a standing body, and turn it in two steps."""
        seconds, steps, start = rng.uniform(0.6, 0.75), 2, ONSET
        total = start + steps * seconds + rng.uniform(1.0, 2.2)
        base = draw_standing(bases, rng, float(np.clip(total, 3.6, 6.0)))
        angle, lift = math.radians(rng.uniform(172, 188)), rng.uniform(0.05, 0.1)
        return Draft(turn_on_spot(base.motion, angle, self.pivot, steps, start, seconds, lift), base.recording)

    def accept(self, motion: Motion) -> bool:
        """Return whether the body makes a half turn about a foot that stays, while the other foot walks around it."""
        angle, ball = degrees_turned(motion), joint(motion, f"{self.pivot}_foot")[:, :2]
        other = "right" if self.pivot == "left" else "left"
        walks = float(foot_speed(motion, other).sum() / motion.fps) > 0.5
        stays = float((ball - ball[0]).norm(dim=-1).max()) < 0.05
        return 160 < angle[-1] < 200 and angle.max() < 205 and angle.min() > -10 and stays and walks


def _walks(slowest: float, fastest: float, backwards: bool = False) -> Callable[[Motion], bool]:
    """Return a gate for straight forward or backward walks between two speeds."""

    def accept(motion: Motion) -> bool:
        ahead = forward(motion) * (-1 if backwards else 1)
        return _is_straight(motion) and slowest < ahead / motion.duration < fastest and ahead > 0.9 * distance(motion)

    return accept


def _jogs_back(motion: Motion) -> bool:
    return _walks(0.9, 2.0, backwards=True)(motion) and flights(motion) >= motion.duration


RECIPES = (
    Recipe("walk-circle-left", "edited", circle, _circles, clips=80, once=False),
    Recipe("quarter-circle-left", "edited", Bend((84, 97), (0.1, 0.25)), _is_quarter, clips=120),
    Recipe("walk-turn-left", "edited", Bend((82, 100), (0.4, 0.5)), _is_quarter, clips=80),
    Recipe("walk-veer-left", "edited", Bend((30, 45), (0.2, 0.5)), _is_veer, clips=80),
    Recipe("half-turn-left-on-left-foot", "authored", HalfTurn("left").make, HalfTurn("left").accept, clips=80),
    Recipe("half-turn-left-on-right-foot", "authored", HalfTurn("right").make, HalfTurn("right").accept, clips=80),
    Recipe("walk-slow", "edited", slow, _walks(0.25, 0.7), clips=80, once=False),
    Recipe("walk-fast", "edited", fast, _walks(1.55, 2.2), clips=80, once=False),
    Recipe("walk-back-slow", "edited", back_slow, _walks(0.2, 0.5, backwards=True), clips=80, once=False),
    Recipe("walk-back-fast", "edited", back_fast, _walks(1.0, 1.7, backwards=True), clips=80, once=False),
    Recipe("run", "edited", long_run, _runs, clips=80, once=False),
    Recipe("jog-back", "edited", jog_back, _jogs_back, clips=80, once=False),
)
"""Recipes in the order of the data set."""
