"""Gates of gestures: checks whether a finished clip shows its action, from hands, head and pelvis.

Left forms only; right forms are the mirror images.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from stmc.editing import body_frame
from stmc.motion.body import JOINTS, PARENTS
from stmc.motion.geometry import global_rotations
from stmc.motion.motion import Motion

_EAR = (0.15, 0.02, 0.06)
_MOUTH = (0.045, -0.035, 0.175)
"""Positions of the wrist while the hand is at the ear and at the mouth, in the axes of the head."""


def wrist(motion: Motion, side: str, frame: str) -> Float[Tensor, "frames 3"]:
    """Return the position of a wrist in the axes of a part of the body; see `WristKey`.

    Args:
        motion: The motion.
        side: "left" or "right".
        frame: Part of the body.
    """
    origin, axes = body_frame(motion, frame, side)
    return ((motion.joints[:, JOINTS.index(f"{side}_wrist")] - origin)[:, None] @ axes)[:, 0]


def wrist_speed(motion: Motion, side: str, frame: str = "chest") -> Float[Tensor, " _"]:
    """Return the speed of a wrist relative to the body in m/s.

    Args:
        motion: The motion.
        side: "left" or "right".
        frame: Part of the body.
    """
    return wrist(motion, side, frame).diff(dim=0).norm(dim=-1) * motion.fps


def count_swings(values: Float[Tensor, " frames"], size: float) -> int:
    """Count the rises and falls of values by at least `size` between turning points."""
    turns, extreme, direction = 0, float(values[0]), 0
    for value in values.tolist():
        if direction * (value - extreme) > 0:
            extreme = value
        elif abs(value - extreme) >= size:
            turns, direction, extreme = turns + 1, 1 if value > extreme else -1, value
    return turns


def visits(near: Bool[Tensor, " frames"]) -> list[int]:
    """Return the lengths in frames of the runs of True."""
    runs, length = [], 0
    for inside in [*near.tolist(), False]:
        if not inside and length:
            runs.append(length)
        length = length + 1 if inside else 0
    return runs


def _seconds(motion: Motion, near: Bool[Tensor, " frames"]) -> list[float]:
    return [run / motion.fps for run in visits(near)]


def _is_near(motion: Motion, place: tuple[float, float, float], metres: float) -> Bool[Tensor, " frames"]:
    hand = wrist(motion, "left", "head")
    return (hand - hand.new_tensor(place)).norm(dim=-1) < metres


def _extension(motion: Motion, side: str) -> Float[Tensor, " frames"]:
    """Return the distance of the wrist from its shoulder, as a fraction of the arm's length."""
    shoulder, elbow, hand = (
        motion.joints[:, JOINTS.index(f"{side}_{name}")] for name in ("shoulder", "elbow", "wrist")
    )
    return (hand - shoulder).norm(dim=-1) / ((elbow - shoulder).norm(dim=-1) + (hand - elbow).norm(dim=-1))


def _feet_stay(motion: Motion, metres: float = 0.06) -> bool:
    feet = motion.joints[:, [JOINTS.index("left_ankle"), JOINTS.index("right_ankle")], :2]
    return bool((feet - feet[:1]).norm(dim=-1).max() < metres)


def _axis(motion: Motion, joint: str, column: int) -> Float[Tensor, "frames 3"]:
    """Return an axis of a joint (0 left, 1 up, 2 forward) in the world."""
    return global_rotations(motion.rotations, PARENTS)[:, JOINTS.index(joint), :, column]


def _yaw(motion: Motion, joint: str) -> Float[Tensor, " frames"]:
    """Return the angle in degrees by which a joint faces to the left of the pelvis."""
    ahead, left = motion.facing, body_frame(motion, "ground", "left")[1][..., 0]
    forward = _axis(motion, joint, 2)
    return torch.rad2deg(torch.atan2((forward * left).sum(dim=-1), (forward * ahead).sum(dim=-1)))


def phones(motion: Motion) -> bool:
    """Return whether the hand goes to the ear once and stays there."""
    runs = _seconds(motion, _is_near(motion, _EAR, 0.10))
    return len(runs) == 1 and runs[0] > 1.5


def eats(motion: Motion) -> bool:
    """Return whether the hand visits the mouth two to five times, briefly, and goes well away in between."""
    away = wrist(motion, "left", "head")[:, 1]
    stays = _seconds(motion, _is_near(motion, _MOUTH, 0.07))
    return 2 <= len(stays) <= 5 and max(stays) < 1 and count_swings(away, 0.15) >= 4


def drinks(motion: Motion) -> bool:
    """Return whether the hand is held at the mouth once or twice while the head tips back."""
    near = _is_near(motion, _MOUTH, 0.08)
    runs = [run for run in _seconds(motion, near) if run > 0.2]
    up = _axis(motion, "head", 2)[:, 2]
    return 1 <= len(runs) <= 2 and min(runs) > 0.7 and bool(up[near].max() > up[~near].mean() + 0.1)


def touches_head(motion: Motion) -> bool:
    """Return whether the hand stays behind the head."""
    hand = wrist(motion, "left", "head")
    runs = _seconds(motion, (hand[:, 2] < 0.0) & (hand.norm(dim=-1) < 0.24) & (hand[:, 1] > 0))
    return bool(runs) and max(runs) > 1.2


def points(motion: Motion) -> bool:
    """Return whether the arm is stretched forwards or outwards, roughly level, for a while."""
    level = wrist(motion, "left", "shoulder")
    stretched = (_extension(motion, "left") > 0.93) & (level[:, 1] > -0.12) & (level[:, 2] > 0.25)
    runs = _seconds(motion, stretched)
    return len(runs) == 1 and runs[0] > 0.8


def raises(motion: Motion) -> bool:
    """Return whether the arm is stretched above the shoulder once, for half a second or more, away from the head."""
    level = wrist(motion, "left", "shoulder")
    up = (level[:, 1] > 0.3) & (_extension(motion, "left") > 0.9)
    runs = _seconds(motion, up)
    return len(runs) == 1 and runs[0] > 0.5 and not bool(_is_near(motion, _EAR, 0.12).any())


def wipes(motion: Motion) -> bool:
    """Return whether the hand moves to and fro in front of the body."""
    hand = wrist(motion, "left", "chest")
    return count_swings(hand[:, 0], 0.1) >= 6 and bool(hand[len(hand) // 2, 2] > 0.2)


def claps(motion: Motion) -> bool:
    """Return whether the hands come together and part repeatedly."""
    left, right = (motion.joints[:, JOINTS.index(f"{side}_wrist")] for side in ("left", "right"))
    gap = (left - right).norm(dim=-1)
    return count_swings(gap, 0.12) >= 8 and bool(0.07 < gap.min() < 0.15)


def plays_guitar(motion: Motion) -> bool:
    """Return whether the right hand strums in front of the body while the left one is on the neck, out to the side."""
    strum, neck = wrist(motion, "right", "chest"), wrist(motion, "left", "chest")
    return count_swings(strum[:, 1], 0.06) >= 8 and bool(neck[len(neck) // 2, 0] > 0.18) and not plays_violin(motion)


def plays_violin(motion: Motion) -> bool:
    """Return whether the right hand bows while the left one stays out in front at shoulder height."""
    bow, neck = wrist(motion, "right", "chest"), wrist(motion, "left", "chest")
    held = (neck[:, 1] > -0.12) & (neck[:, 2] > 0.2)
    return count_swings(bow[:, 0], 0.15) >= 4 and bool(held[len(held) // 2]) and bool(held.double().mean() > 0.4)


def swings_club(motion: Motion) -> bool:
    """Return whether the hands are together, go to the right, and come fast to the left."""
    left, right = (motion.joints[:, JOINTS.index(f"{side}_wrist")] for side in ("left", "right"))
    together = (left - right).norm(dim=-1) < 0.17
    turn = _yaw(motion, "spine3") + torch.rad2deg(motion.heading - motion.heading[0])
    return (
        max(_seconds(motion, together), default=0.0) > 1.6
        and bool(turn.max() - turn.min() > 65)
        and bool(wrist_speed(motion, "left", "ground").max() > 3.2)
        and _feet_stay(motion, 0.15)
    )


def throws(motion: Motion) -> bool:
    """Return whether the hand is drawn back behind the shoulders and comes forward fast."""
    hand, pace = wrist(motion, "left", "ground"), wrist_speed(motion, "left", "ground")
    shoulder = motion.joints[:, JOINTS.index("left_shoulder")]
    _, axes = body_frame(motion, "ground", "left")
    behind = ((motion.joints[:, JOINTS.index("left_wrist")] - shoulder) * axes[..., 2]).sum(dim=-1) < -0.03
    high = motion.joints[:, JOINTS.index("left_wrist"), 2] > shoulder[:, 2] - 0.05
    fastest = int(pace.argmax())
    return bool(pace.max() > 3.5) and bool((behind & high)[:fastest].any()) and bool(hand[fastest, 2] > -0.2)


def punches(motion: Motion) -> bool:
    """Return whether the arm shoots forward from a guard one to three times."""
    hand = wrist(motion, "left", "shoulder")
    runs = visits((_extension(motion, "left") > 0.88) & (hand[:, 1] > -0.15) & (hand[:, 2] > 0.3))
    return (
        1 <= len(runs) <= 3 and max(runs) < 0.5 * motion.fps and bool(wrist_speed(motion, "left", "ground").max() > 2.6)
    )


def boxes(motion: Motion) -> bool:
    """Return whether both arms shoot forward twice or more."""
    for side in ("left", "right"):
        hand = wrist(motion, side, "shoulder")
        runs = visits((_extension(motion, side) > 0.88) & (hand[:, 1] > -0.15) & (hand[:, 2] > 0.3))
        if len(runs) < 2 or max(runs) > 0.5 * motion.fps:
            return False
    return True


def picks_up(motion: Motion) -> bool:
    """Return whether the left hand goes down to the floor, the right one clearly less, and the feet stay."""
    left, right = (motion.joints[:, JOINTS.index(f"{side}_wrist"), 2] for side in ("left", "right"))
    low = int(left.argmin())
    sunk = motion.translation[0, 2] - motion.translation[:, 2].min()
    return bool(left[low] < 0.24 and right[low] > left[low] + 0.15 and sunk > 0.15) and _feet_stay(motion)


def looks(motion: Motion) -> bool:
    """Return whether the head turns far to the left, stays there for a while, and does not turn right."""
    yaw = _yaw(motion, "head")
    return max(_seconds(motion, yaw > 38), default=0.0) > 0.6 and bool(yaw.min() > -25)


def dodges(motion: Motion) -> bool:
    """Return whether the head moves away within half a second, relative to the pelvis, and comes back."""
    head = motion.joints[:, JOINTS.index("head")] - motion.translation
    away, half = (head - head[0]).norm(dim=-1), round(motion.fps / 2)
    quick = (head[half:] - head[:-half]).norm(dim=-1).max()
    return bool(quick > 0.14) and bool(away[-1] < 0.1) and _feet_stay(motion)
