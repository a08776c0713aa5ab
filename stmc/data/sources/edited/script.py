"""Scripts of gestures: keys of arms, head, trunk, pelvis and feet, drawn from ranges, and their performance.

Depends on the editing functions; independent of actions (see `arm_gestures`) and recordings.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stmc.editing import (
    FootKey,
    Oscillation,
    PelvisKey,
    TurnKey,
    WristKey,
    reach,
    shift_pelvis,
    step,
    turn_head,
    turn_trunk,
)
from stmc.editing.reaching import Triple
from stmc.motion.motion import Motion

ONSET = 0.5
"""Seconds of rest before a gesture. All gestures share one value: if onsets differ, a network tends to the mean of
their phases, and hands that should clap stand still."""

Spread = tuple[float | int, float | int]
"""Minimum and maximum of a uniform draw."""


@dataclass(frozen=True)
class Script:
    """One drawn gesture of a left-handed person that lasts `seconds`; see the classes of the keys."""

    seconds: float
    left: tuple[WristKey, ...] = ()
    right: tuple[WristKey, ...] = ()
    head: tuple[TurnKey, ...] = ()
    trunk: tuple[TurnKey, ...] = ()
    pelvis: tuple[PelvisKey, ...] = ()
    right_foot: tuple[FootKey, ...] = ()
    left_foot: tuple[FootKey, ...] = ()
    gaze: float | int = 0.0
    tremor: Spread = (0.0005, 0.0011)
    """Amplitude in metres; recorded hands that reach have a jerk of 30 to 100 m/s³, minimum jerk alone has half of
    that."""

    def perform(self, motion: Motion, rng: np.random.Generator) -> Motion:
        """Add the gesture to a motion: pelvis, feet, trunk and head first, so that hands reach goals on them."""
        motion = shift_pelvis(motion, self.pelvis)
        motion = step(step(motion, "right", self.right_foot), "left", self.left_foot)
        motion = turn_head(turn_trunk(motion, self.trunk, self.gaze), self.head)
        for side, keys in (("left", self.left), ("right", self.right)):
            if keys:
                seed = int(rng.integers(2**31))
                motion = reach(motion, side, keys, tremor=rng.uniform(*self.tremor), seed=seed)
        return motion


@dataclass(frozen=True)
class Spot:
    """A goal of a wrist with ranges: goal, elbow pole and raised collar bone (degrees) lie between two corners."""

    low: Triple
    high: Triple
    frame: str = "chest"
    pole: tuple[Triple, Triple] = ((0.4, -1.0, -0.2), (0.8, -1.0, -0.1))
    shrug: Spread = (0.0, 0.0)
    arc: Triple = (0.0, 0.0, 0.0)

    def draw(self, rng: np.random.Generator) -> Spot:
        """Draw a goal, as a spot without ranges."""
        goal = _draw_between(rng, self.low, self.high)
        pole, shrug = _draw_between(rng, *self.pole), rng.uniform(*self.shrug)
        return Spot(goal, goal, self.frame, (pole, pole), (shrug, shrug), self.arc)

    def near(self, rng: np.random.Generator, metres: float | int) -> Spot:
        """Draw a goal near this one, at the precision of a hand that returns to it."""
        x, y, z = (float(value + rng.uniform(-metres, metres)) for value in self.low)
        goal = (x, y, z)
        return Spot(goal, goal, self.frame, self.pole, self.shrug, self.arc)

    def key(
        self,
        time: float | int,
        takes: float | int,
        skew: float | int = 1.25,
        oscillation: Oscillation | None = None,
        roundness: float | int = 0.5,
    ) -> WristKey:
        """Create the key of a drawn spot.

        Args:
            time: Time of arrival in seconds.
            takes: Duration of the movement in seconds.
            skew: Skew of the velocity profile.
            oscillation: Oscillation after arrival, or None.
            roundness: Roundness of the path.
        """
        shrug = math.radians(self.shrug[0])
        return WristKey(
            time,
            takes,
            self.low,
            self.frame,
            self.pole[0],
            skew=skew,
            arc=self.arc,
            shrug=shrug,
            roundness=roundness,
            oscillation=oscillation,
        )


def turn_key(
    time: float | int,
    takes: float | int,
    yaw: float | int = 0.0,
    pitch: float | int = 0.0,
    roll: float | int = 0.0,
    skew: float | int = 1.15,
) -> TurnKey:
    """Create a `TurnKey` from angles in degrees.

    Args:
        time: Time of arrival in seconds.
        takes: Duration of the movement in seconds.
        yaw: Yaw in degrees.
        pitch: Pitch in degrees.
        roll: Roll in degrees.
        skew: Skew of the velocity profile.
    """
    return TurnKey(time, takes, math.radians(yaw), math.radians(pitch), math.radians(roll), skew)


def pelvis_key(
    time: float | int,
    takes: float | int,
    offset: Triple = (0.0, 0.0, 0.0),
    yaw: float | int = 0.0,
    pitch: float | int = 0.0,
    roll: float | int = 0.0,
    skew: float | int = 1.1,
) -> PelvisKey:
    """Create a `PelvisKey` from angles in degrees.

    Args:
        time: Time of arrival in seconds.
        takes: Duration of the movement in seconds.
        offset: Offset of the pelvis in metres.
        yaw: Yaw in degrees.
        pitch: Pitch in degrees.
        roll: Roll in degrees.
        skew: Skew of the velocity profile.
    """
    return PelvisKey(time, takes, offset, math.radians(yaw), math.radians(pitch), math.radians(roll), skew)


def _draw_between(rng: np.random.Generator, low: Triple, high: Triple) -> Triple:
    x, y, z = (float(rng.uniform(min(one, other), max(one, other))) for one, other in zip(low, high, strict=True))
    return x, y, z
