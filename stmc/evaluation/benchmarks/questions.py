"""Geometric questions whether a motion shows an action of a data set, without a learned evaluator or a text encoder.

There is a question for every action of the open data that joints can show, whatever else the body does: a seated person
is low, a jump leaves the floor and comes back. The value of an answer depends on the pass rates of real motion (the
ceiling) and of motions of other actions (chance); see `rates`. Depends on the labels of `data.sources`; independent of
models.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType

import torch
from jaxtyping import Bool
from torch import Tensor

from stmc.evaluation.metrics.action_measures import (
    SEATED,
    UPRIGHT,
    cycles,
    displacement,
    flights,
    forward_reach,
    goes_low,
    joint_speed,
    jumps,
    lean,
    lifts,
    mean_speed,
    pelvis_height,
    stays,
    thrusts,
    toe_heights,
    torsion,
    waves,
)
from stmc.motion.kinematics import forward_speed, joint, turn
from stmc.motion.motion import Motion

Question = Callable[[Motion], bool]


@dataclass(frozen=True)
class Rates:
    """Fractions of motions that pass a question.

    Args:
        ceiling: Fraction of the motions that show the action.
        chance: Fraction of the motions of other actions, each with the same weight.
    """

    ceiling: float
    chance: float


def rates(question: Question, shown: Sequence[Motion], others: Mapping[str, Sequence[Motion]]) -> Rates:
    """Compute the pass rates of an action's own motions and of all other actions' motions.

    Args:
        question: The question.
        shown: Motions of the action.
        others: Motions of the other actions.

    Raises:
        ValueError: If `shown` or `others` is empty.
    """
    if not shown or not others:
        raise ValueError("rates need motions of the action and of other actions")
    other_rates = [_pass_rate(question, motions) for motions in others.values()]
    return Rates(_pass_rate(question, shown), sum(other_rates) / len(other_rates))


def _pass_rate(question: Question, motions: Sequence[Motion]) -> float:
    return sum(map(question, motions)) / len(motions)


def _either(measure: Callable[[Motion, str], bool]) -> Question:
    return lambda motion: any(measure(motion, side) for side in ("left", "right"))


def _both(measure: Callable[[Motion, str], bool]) -> Question:
    return lambda motion: all(measure(motion, side) for side in ("left", "right"))


def _kicks(motion: Motion, side: str) -> bool:
    return bool((joint(motion, f"{side}_ankle")[:, 2] > 0.6).any()) and _swings_leg(motion, side, 4.0)


def _swings_leg(motion: Motion, side: str, least: float = 5.5) -> bool:
    return bool((joint_speed(motion, f"{side}_ankle", beside="pelvis") > least).any())


def _at_the_mouth(motion: Motion, side: str) -> float:
    """Return the seconds that a wrist is near the face."""
    near = (joint(motion, f"{side}_wrist") - joint(motion, "head")).norm(dim=-1) < 0.28
    return int(near.sum()) / motion.fps


def _drinks(motion: Motion) -> bool:
    seconds = sorted(_at_the_mouth(motion, side) for side in ("left", "right"))
    return seconds[1] > 0.3 and seconds[0] < seconds[1] / 2 and displacement(motion) < 0.3


def _above_head(motion: Motion, side: str) -> Bool[Tensor, " frames"]:
    return joint(motion, f"{side}_wrist")[:, 2] > joint(motion, "head")[:, 2] + 0.1


def _circles(motion: Motion, side: str) -> bool:
    arm = joint(motion, f"{side}_wrist") - joint(motion, f"{side}_shoulder")
    return cycles(arm[:, 2], 0.25) >= 2 and float(arm.norm(dim=-1).median()) > 0.38


def _knee_up(motion: Motion, side: str) -> bool:
    high = joint(motion, f"{side}_knee")[:, 2] > pelvis_height(motion) - 0.18
    return bool((high & (pelvis_height(motion) > UPRIGHT)).any())


def _wipes(motion: Motion, side: str) -> bool:
    raised = joint(motion, f"{side}_wrist")[:-1, 2] > joint(motion, f"{side}_shoulder")[:-1, 2] - 0.2
    moving = joint_speed(motion, f"{side}_wrist", beside="neck") > 0.3
    ahead = forward_reach(motion, side)[:-1] > 0.2
    return float((raised & moving & ahead).float().mean()) > 0.3 and displacement(motion) < 1.0 and motion.duration > 2


def _reaches(motion: Motion, side: str) -> bool:
    return bool((joint(motion, f"{side}_wrist")[:, 2] > 1.6).any())


def _one_legged(motion: Motion) -> float:
    """Return the fraction of the frames with one foot 12 cm above the other."""
    heights = toe_heights(motion)
    return float(((heights[:, 0] - heights[:, 1]).abs() > 0.12).float().mean())


def _hops(motion: Motion) -> bool:
    return _one_legged(motion) > 0.5 and cycles(toe_heights(motion).amin(dim=1), 0.04) >= 2


def _jumping_jacks(motion: Motion) -> bool:
    apart = (joint(motion, "left_ankle") - joint(motion, "right_ankle")).norm(dim=-1)
    hands = (joint(motion, "left_wrist")[:, 2] + joint(motion, "right_wrist")[:, 2]) / 2
    return cycles(hands, 0.5) >= 2 and cycles(apart, 0.2) >= 2


def _touches_toes(motion: Motion, side: str) -> bool:
    low = joint(motion, f"{side}_wrist")[:, 2] < 0.45
    return bool((low & (pelvis_height(motion) > SEATED)).any())


def _mops(motion: Motion) -> bool:
    hands = [joint(motion, f"{side}_wrist") for side in ("left", "right")]
    together = (hands[0] - hands[1]).norm(dim=-1) < 0.8
    low = torch.stack([hand[:, 2] for hand in hands]).amin(dim=0) < 1.05
    strokes = max(cycles(forward_reach(motion, side), 0.12) for side in ("left", "right"))
    bent = float(lean(motion)[:, 0].median()) > math.radians(8)
    return float((together & low).float().mean()) > 0.7 and bent and strokes >= 1 and displacement(motion) < 2.5


def _picks_up(motion: Motion, side: str) -> bool:
    height = joint(motion, f"{side}_wrist")[:, 2]
    low = int(height.argmin())
    return bool(height[low] < 0.55) and bool(height[low:].max() > 0.9)


def _turns_over(motion: Motion) -> bool:
    hands = min(float(joint(motion, f"{side}_wrist")[:, 2].min()) for side in ("left", "right"))
    legs = max(float(joint(motion, f"{side}_ankle")[:, 2].max()) for side in ("left", "right"))
    return hands < 0.35 and legs > 1.0


def _treads(motion: Motion) -> bool:
    lifted = [cycles(joint(motion, f"{side}_ankle")[:, 2], 0.05) for side in ("left", "right")]
    return sum(lifted) >= 1.6 * motion.duration and min(lifted) > 0 and displacement(motion) < 0.6


def _stops(motion: Motion) -> bool:
    forward, frames = forward_speed(motion), max(1, round(motion.fps / 5))
    return float(forward[: len(forward) // 2].max()) > 1.8 and float(forward[-frames:].mean()) < 0.8


def _veers(motion: Motion, angle: float) -> bool:
    return math.radians(12) < angle < math.radians(75) and 0.4 < mean_speed(motion) < 2


_SIDES = {"left-hand": ("left",), "right-hand": ("right",), "both-hands": ("left", "right")}

QUESTIONS: Mapping[str, Question] = MappingProxyType({
    "stand": stays,
    "sit": lambda motion: bool(pelvis_height(motion).median() < SEATED),
    "sit-down": lambda motion: goes_low(motion, first=True, last=False),
    "stand-up": lambda motion: goes_low(motion, first=False, last=True),
    "squat": lambda motion: goes_low(motion, first=True, last=True),
    "jump-up": lambda motion: jumps(motion) and displacement(motion) < 0.6,
    "jump-forward": lambda motion: jumps(motion) and 0.3 < displacement(motion) < 2.5,
    "jump-over": lambda motion: bool(flights(motion)) and mean_speed(motion) > 1.2,
    "jump-and-grab": lambda motion: jumps(motion) and _either(_reaches)(motion),
    "leap": lambda motion: bool(flights(motion)) and mean_speed(motion) > 1.2,
    "hop": _hops,
    "jumping-jack": _jumping_jacks,
    "knee-raise": _both(_knee_up),
    "jog-in-place": _treads,
    "arm-circle": _both(_circles),
    "twist": lambda motion: float(torsion(motion).max() - torsion(motion).min()) > math.radians(50),
    "side-bend": lambda motion: bool((lean(motion)[:, 1].abs() > math.radians(15)).any())
    and displacement(motion) < 0.5,
    "toe-touch": _either(_touches_toes),
    "scoop-up": _either(_picks_up),
    "reach-up": _either(_reaches),
    "kick": _either(_kicks),
    "kick-ball": _either(_swings_leg),
    "punch": _either(lambda motion, side: thrusts(motion, side) > 0),
    "box": lambda motion: thrusts(motion, "left") + thrusts(motion, "right") >= max(1.0, motion.duration / 4),
    "drink": _drinks,
    "wash-window": _either(_wipes),
    "mop": _mops,
    "balance": lambda motion: _one_legged(motion) > 0.5 and displacement(motion) < 0.4 and not flights(motion),
    "cartwheel": _turns_over,
    "duck": lambda motion: bool((joint(motion, "head")[:, 2] < 1.15).any()) and mean_speed(motion) > 1.0,
    "turn-around": lambda motion: abs(turn(motion)) > math.radians(120),
    "run-stop": _stops,
    "run-turn-left": lambda motion: turn(motion) > math.radians(25) and mean_speed(motion) > 1.5,
    "run-turn-right": lambda motion: turn(motion) < -math.radians(25) and mean_speed(motion) > 1.5,
    "walk-veer-left": lambda motion: _veers(motion, turn(motion)),
    "walk-veer-right": lambda motion: _veers(motion, -turn(motion)),
    "walk-slow": lambda motion: 0.15 < mean_speed(motion) < 1.1,
    "shoot-ball": lambda motion: bool((_above_head(motion, "left") & _above_head(motion, "right")).any()),
    "walk": lambda motion: 0.4 <= mean_speed(motion) <= 2,
    "walk-back": lambda motion: mean_speed(motion) < -0.2,
    "run": lambda motion: mean_speed(motion) > 1.5,
    "dash": lambda motion: mean_speed(motion) > 1.5,
    "walk-turn-left": lambda motion: turn(motion) > math.pi / 4,
    "walk-turn-right": lambda motion: turn(motion) < -math.pi / 4,
    **{f"raise-up-{hands}": partial(lifts, sides=sides) for hands, sides in _SIDES.items()},
    **{f"wave-{hands}": partial(waves, sides=sides) for hands, sides in _SIDES.items()},
})  # fmt: skip
"""Questions by the name of an action, for actions that geometry can show; others (a salsa, a laugh) need eyes or an
evaluator. A wrist near shoulder height counts as raised, because some of Bandai's actors raise it no higher."""
