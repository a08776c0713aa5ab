"""Whether a motion shows an action, by geometry: no learned evaluator, no text encoder.

A question for every content of open motion capture that joints can tell, whatever else the body does: seated is low, a
jump leaves the floor and comes back. How often real motion passes (the ceiling) and how often motions of other contents
do (chance) say what an answer is worth: see `rates`. Knows joints, metres and seconds; knows no data set and no model.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from stmc.metrics.kinematics import forward_speed, joint, turn
from stmc.motion import Motion

Question = Callable[[Motion], bool]

SEATED, UPRIGHT = 0.62, 0.75
"""Metres: a pelvis below the one sits or squats, above the other it stands."""

OFF_THE_FLOOR, FLIGHT = 0.06, 0.12
"""A foot this far (metres) above the lowest point of both has left the floor; a body with both there for so many
seconds has jumped."""


@dataclass(frozen=True)
class Rates:
    """Shares of motions that pass a question: `ceiling` of those that show the action, `chance` of those that show any
    other, each content counting the same."""

    ceiling: float
    chance: float


def rates(question: Question, shown: Sequence[Motion], others: Mapping[str, Sequence[Motion]]) -> Rates:
    """Of a content's own motions and of all other contents'. Raises `ValueError` where one of the two is empty."""
    if not shown or not others:
        raise ValueError("rates need motions of the content and of others")
    passed = [_share(question, motions) for motions in others.values()]
    return Rates(_share(question, shown), sum(passed) / len(passed))


def _share(question: Question, motions: Sequence[Motion]) -> float:
    return sum(map(question, motions)) / len(motions)


def pelvis_height(motion: Motion) -> Float[Tensor, " frames"]:
    """Metres above the floor."""
    return motion.translation[:, 2]


def toe_heights(motion: Motion) -> Float[Tensor, "frames 2"]:
    """Heights of the left and the right toes above the lowest point of both."""
    heights = torch.stack([joint(motion, "left_foot")[:, 2], joint(motion, "right_foot")[:, 2]], dim=1)
    return heights - heights.min()


def joint_speed(motion: Motion, name: str, beside: str | None = None) -> Float[Tensor, " frames"]:
    """Metres per second of a joint, or of its place beside another joint; one frame shorter."""
    place = joint(motion, name) - (joint(motion, beside) if beside else 0.0)
    return place.diff(dim=0).norm(dim=-1) * motion.fps


def stretches(mask: Bool[Tensor, " frames"]) -> list[tuple[int, int]]:
    """First and last frame (exclusive) of each run of True."""
    edges = torch.nn.functional.pad(mask.int(), (1, 1)).diff()
    return list(zip((edges > 0).nonzero()[:, 0].tolist(), (edges < 0).nonzero()[:, 0].tolist(), strict=True))


def flights(motion: Motion) -> list[tuple[int, int]]:
    """Frames in which neither foot is on the floor, long enough for a jump."""
    runs = stretches(toe_heights(motion).amin(dim=1) > OFF_THE_FLOOR)
    return [(first, last) for first, last in runs if last - first >= FLIGHT * motion.fps]


def jumps(motion: Motion) -> bool:
    """Whether both feet leave the floor together and the motion ends on it."""
    return bool(flights(motion)) and lands(motion)


def lands(motion: Motion) -> bool:
    """Whether some foot stands on the floor in one of the last three frames."""
    return bool((toe_heights(motion)[-3:] < OFF_THE_FLOOR).any())


def way(motion: Motion) -> float:
    """Metres between where the pelvis begins and where it ends, on the floor."""
    return float((motion.translation[-1] - motion.translation[0])[:2].norm())


def cycles(values: Float[Tensor, " frames"], extent: float) -> int:
    """How often `values` rise by at least `extent` after they fell by as much, or at first."""
    count, rising, low, high = 0, True, math.inf, -math.inf
    for value in values.tolist():
        low, high = min(low, value), max(high, value)
        if rising and value - low >= extent:
            count, rising, high = count + 1, False, value
        elif not rising and high - value >= extent:
            rising, low = True, value
    return count


def stays(motion: Motion) -> bool:
    """Whether an upright body stays where it is: the pelvis within 10 cm, feet down, hands all but still."""
    drift = (motion.translation[:, :2] - motion.translation[:1, :2]).norm(dim=-1).max()
    hands = max(float(joint_speed(motion, f"{side}_wrist").mean()) for side in ("left", "right"))
    return bool(drift < 0.1) and hands < 0.3 and bool((pelvis_height(motion) > UPRIGHT).all())


def goes_low(motion: Motion, first: bool, last: bool) -> bool:
    """Whether the body sits or squats at some time, and stands upright at the `first` and the `last` quarter second as
    told."""
    height, few = pelvis_height(motion), max(1, round(motion.fps / 4))
    ends = (bool((height[:few] > UPRIGHT).any()), bool((height[-few:] > UPRIGHT).any()))
    return bool((height < SEATED).any()) and ends == (first, last)


def lean(motion: Motion) -> Float[Tensor, "frames 2"]:
    """Radians by which the trunk leans forward, and to the side, from upright."""
    trunk = joint(motion, "neck") - motion.translation
    across = torch.linalg.cross(trunk.new_tensor([0.0, 0.0, 1.0]).expand_as(trunk), motion.facing.to(trunk))
    parts = [(trunk * axis).sum(dim=-1) for axis in (motion.facing.to(trunk), across)]
    return torch.stack([torch.atan2(part, trunk[:, 2]) for part in parts], dim=1)


def torsion(motion: Motion) -> Float[Tensor, " frames"]:
    """Radians by which the shoulders' line is turned against the hips', seen from above."""
    angles = []
    for name in ("shoulder", "hip"):
        line = joint(motion, f"left_{name}") - joint(motion, f"right_{name}")
        angles.append(torch.atan2(line[:, 1], line[:, 0]))
    difference = angles[0] - angles[1]
    return torch.atan2(torch.sin(difference), torch.cos(difference))


def _either(measure: Callable[[Motion, str], bool]) -> Question:
    return lambda motion: any(measure(motion, side) for side in ("left", "right"))


def _both(measure: Callable[[Motion, str], bool]) -> Question:
    return lambda motion: all(measure(motion, side) for side in ("left", "right"))


def _kicks(motion: Motion, side: str) -> bool:
    return bool((joint(motion, f"{side}_ankle")[:, 2] > 0.6).any()) and _swings_leg(motion, side)


def _swings_leg(motion: Motion, side: str) -> bool:
    return bool((joint_speed(motion, f"{side}_ankle", beside="pelvis") > 4.0).any())


def _punches(motion: Motion, side: str, often: int = 1) -> bool:
    fast = joint_speed(motion, f"{side}_wrist", beside="neck") > 1.8
    return len(stretches(fast)) >= often


def _boxes(motion: Motion) -> bool:
    thrown = sum(
        len(stretches(joint_speed(motion, f"{side}_wrist", beside="neck") > 1.5)) for side in ("left", "right")
    )
    return thrown >= motion.duration / 1.5


def _sips(motion: Motion, side: str) -> bool:
    near = (joint(motion, f"{side}_wrist") - joint(motion, "head")).norm(dim=-1) < 0.28
    return int(near.sum()) > 0.3 * motion.fps


def _above_head(motion: Motion, side: str) -> Bool[Tensor, " frames"]:
    return joint(motion, f"{side}_wrist")[:, 2] > joint(motion, "head")[:, 2] + 0.1


def _circles(motion: Motion, side: str) -> bool:
    arm = joint(motion, f"{side}_wrist") - joint(motion, f"{side}_shoulder")
    return cycles(arm[:, 2], 0.25) >= 2 and float(arm.norm(dim=-1).median()) > 0.38


def _knee_up(motion: Motion, side: str) -> bool:
    return bool((joint(motion, f"{side}_knee")[:, 2] > motion.translation[:, 2] - 0.18).any())


def _wipes(motion: Motion, side: str) -> bool:
    raised = joint(motion, f"{side}_wrist")[:-1, 2] > joint(motion, f"{side}_shoulder")[:-1, 2] - 0.15
    moving = joint_speed(motion, f"{side}_wrist", beside="neck") > 0.3
    return float((raised & moving).float().mean()) > 0.35


def _reaches(motion: Motion, side: str) -> bool:
    return bool((joint(motion, f"{side}_wrist")[:, 2] > 1.6).any())


def _one_legged(motion: Motion) -> float:
    """The share of the frames with one foot 12 cm above the other."""
    heights = toe_heights(motion)
    return float(((heights[:, 0] - heights[:, 1]).abs() > 0.12).float().mean())


def _hops(motion: Motion) -> bool:
    return _one_legged(motion) > 0.5 and cycles(toe_heights(motion).amin(dim=1), 0.04) >= 2


def _jumping_jacks(motion: Motion) -> bool:
    apart = (joint(motion, "left_ankle") - joint(motion, "right_ankle")).norm(dim=-1)
    hands = sum(joint(motion, f"{side}_wrist")[:, 2] for side in ("left", "right")) / 2
    return cycles(hands, 0.5) >= 2 and cycles(apart, 0.2) >= 2


def _touches_toes(motion: Motion, side: str) -> bool:
    low = joint(motion, f"{side}_wrist")[:, 2] < 0.45
    return bool((low & (pelvis_height(motion) > SEATED)).any())


def _mops(motion: Motion) -> bool:
    hands = [joint(motion, f"{side}_wrist") for side in ("left", "right")]
    together = (hands[0] - hands[1]).norm(dim=-1) < 0.8
    low = torch.stack([hand[:, 2] for hand in hands]).amin(dim=0) < 1.05
    busy = max(float(joint_speed(motion, f"{side}_wrist", beside="pelvis").mean()) for side in ("left", "right"))
    return float((together & low).float().mean()) > 0.7 and 0.25 < busy < 1.5 and way(motion) < 2.5


def _picks_up(motion: Motion, side: str) -> bool:
    height = joint(motion, f"{side}_wrist")[:, 2]
    low = int(height.argmin())
    return bool(height[low] < 0.55) and bool(height[low:].max() > 0.9)


def _turns_over(motion: Motion) -> bool:
    hands = min(float(joint(motion, f"{side}_wrist")[:, 2].min()) for side in ("left", "right"))
    legs = max(float(joint(motion, f"{side}_ankle")[:, 2].max()) for side in ("left", "right"))
    return hands < 0.35 and legs > 1.0


def _treads(motion: Motion) -> bool:
    lifted = sum(cycles(joint(motion, f"{side}_foot")[:, 2], 0.06) for side in ("left", "right"))
    return lifted >= 2.0 * motion.duration and way(motion) < 0.6


def _stops(motion: Motion) -> bool:
    forward, few = forward_speed(motion), max(1, round(motion.fps / 5))
    return float(forward[: len(forward) // 2].max()) > 1.8 and float(forward[-few:].mean()) < 0.8


def _mean(motion: Motion) -> float:
    return float(forward_speed(motion).mean())


ACTIONS: Mapping[str, Question] = MappingProxyType({
    "stand": stays,
    "sit": lambda motion: bool(pelvis_height(motion).median() < SEATED),
    "sit-down": lambda motion: goes_low(motion, first=True, last=False),
    "stand-up": lambda motion: goes_low(motion, first=False, last=True),
    "squat": lambda motion: goes_low(motion, first=True, last=True),
    "jump-up": lambda motion: jumps(motion) and way(motion) < 0.6,
    "jump-forward": lambda motion: jumps(motion) and 0.3 < way(motion) < 2.5,
    "jump-over": lambda motion: bool(flights(motion)) and _mean(motion) > 1.2,
    "jump-and-grab": lambda motion: jumps(motion) and _either(_reaches)(motion),
    "leap": lambda motion: bool(flights(motion)) and _mean(motion) > 1.2,
    "hop": _hops,
    "jumping-jack": _jumping_jacks,
    "knee-raise": _both(_knee_up),
    "jog-in-place": _treads,
    "arm-circle": _both(_circles),
    "twist": lambda motion: float(torsion(motion).max() - torsion(motion).min()) > math.radians(50),
    "side-bend": lambda motion: bool((lean(motion)[:, 1].abs() > math.radians(15)).any()) and way(motion) < 0.5,
    "toe-touch": _either(_touches_toes),
    "scoop-up": _either(_picks_up),
    "reach-up": _either(_reaches),
    "kick": _either(_kicks),
    "kick-ball": _either(_swings_leg),
    "punch": _either(_punches),
    "box": _boxes,
    "drink": _either(_sips),
    "wash-window": _either(_wipes),
    "mop": _mops,
    "balance": lambda motion: _one_legged(motion) > 0.5 and way(motion) < 0.4 and not flights(motion),
    "cartwheel": _turns_over,
    "duck": lambda motion: bool((joint(motion, "head")[:, 2] < 1.15).any()) and _mean(motion) > 1.0,
    "turn-around": lambda motion: abs(turn(motion)) > math.radians(120),
    "run-stop": _stops,
    "run-turn-left": lambda motion: turn(motion) > math.radians(25) and _mean(motion) > 1.5,
    "run-turn-right": lambda motion: turn(motion) < -math.radians(25) and _mean(motion) > 1.5,
    "walk-veer-left": lambda motion: math.radians(12) < turn(motion) < math.radians(75) and 0.4 < _mean(motion) < 2,
    "walk-veer-right": lambda motion: -math.radians(75) < turn(motion) < -math.radians(12) and 0.4 < _mean(motion) < 2,
    "walk-slow": lambda motion: 0.3 < _mean(motion) < 1.1,
    "shoot-ball": lambda motion: bool((_above_head(motion, "left") & _above_head(motion, "right")).any()),
})  # fmt: skip
"""By a content's name, for those that geometry can tell; others (a salsa, a laugh) need eyes or an evaluator."""
