"""What a gesture is made of: keys of arms, head, trunk, pelvis and feet, drawn from spreads, and their performance.

Knows the editing functions; knows no action (see `gestures`) and no recording.
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
from stmc.editing.reaching import BodyFrame, Triple
from stmc.motion import Motion

Spread = tuple[float, float]
"""The least and the greatest value of something that is drawn evenly."""


@dataclass(frozen=True)
class Script:
    """One drawn gesture of a left-handed person that lasts `seconds`; see the keys' own classes."""

    seconds: float
    left: tuple[WristKey, ...] = ()
    right: tuple[WristKey, ...] = ()
    head: tuple[TurnKey, ...] = ()
    trunk: tuple[TurnKey, ...] = ()
    pelvis: tuple[PelvisKey, ...] = ()
    right_foot: tuple[FootKey, ...] = ()
    left_foot: tuple[FootKey, ...] = ()
    gaze: float = 0.0

    def perform(self, motion: Motion, rng: np.random.Generator) -> Motion:
        """The motion with the gesture on it: pelvis, feet, trunk and head first, so that hands reach goals on them."""
        motion = shift_pelvis(motion, self.pelvis)
        motion = step(step(motion, "right", self.right_foot), "left", self.left_foot)
        motion = turn_head(turn_trunk(motion, self.trunk, self.gaze), self.head)
        for side, keys in (("left", self.left), ("right", self.right)):
            if keys:
                seed = int(rng.integers(2**31))
                motion = reach(motion, side, keys, tremor=rng.uniform(0.0004, 0.0010), seed=seed)
        return motion


@dataclass(frozen=True)
class Spot:
    """A goal of a wrist with its spreads: goal, elbow pole and raised collar bone (degrees) lie between two corners."""

    low: Triple
    high: Triple
    frame: BodyFrame = "chest"
    pole: tuple[Triple, Triple] = ((0.4, -1.0, -0.2), (0.8, -1.0, -0.1))
    shrug: Spread = (0.0, 0.0)
    arc: Triple = (0.0, 0.0, 0.0)

    def drawn(self, rng: np.random.Generator) -> Spot:
        """One of the goals, as a spot without spread."""
        goal = _between(rng, self.low, self.high)
        pole, shrug = _between(rng, *self.pole), rng.uniform(*self.shrug)
        return Spot(goal, goal, self.frame, (pole, pole), (shrug, shrug), self.arc)

    def near(self, rng: np.random.Generator, metres: float) -> Spot:
        """A goal as near to this drawn one as a hand comes back to it."""
        goal = tuple(float(value + rng.uniform(-metres, metres)) for value in self.low)
        return Spot(goal, goal, self.frame, self.pole, self.shrug, self.arc)

    def key(
        self,
        time: float,
        takes: float,
        skew: float = 1.25,
        oscillation: Oscillation | None = None,
        roundness: float = 0.5,
    ) -> WristKey:
        """The key of a drawn spot."""
        shrug = math.radians(self.shrug[0])
        how = {"skew": skew, "arc": self.arc, "shrug": shrug, "roundness": roundness, "oscillation": oscillation}
        return WristKey(time, takes, self.low, self.frame, self.pole[0], **how)


def turned(
    time: float, takes: float, yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0, skew: float = 1.15
) -> TurnKey:
    """A `TurnKey` in degrees."""
    return TurnKey(time, takes, math.radians(yaw), math.radians(pitch), math.radians(roll), skew)


def shifted(
    time: float,
    takes: float,
    offset: Triple = (0.0, 0.0, 0.0),
    yaw: float = 0.0,
    pitch: float = 0.0,
    roll: float = 0.0,
    skew: float = 1.1,
) -> PelvisKey:
    """A `PelvisKey` in degrees."""
    return PelvisKey(time, takes, offset, math.radians(yaw), math.radians(pitch), math.radians(roll), skew)


def _between(rng: np.random.Generator, low: Triple, high: Triple) -> Triple:
    x, y, z = (float(rng.uniform(min(one, other), max(one, other))) for one, other in zip(low, high, strict=True))
    return x, y, z
