"""Geometric checks of MTT's texts about legs and the whole body; left forms only."""

from __future__ import annotations

import math

import torch

from stmc.evaluation.metrics.action_measures import (
    SEATED,
    UPRIGHT,
    cycles,
    displacement,
    flights,
    lean,
    mean_speed,
    pelvis_height,
)
from stmc.evaluation.metrics.gestures import hand_gap, longest
from stmc.evaluation.metrics.steps import (
    airborne_fraction,
    heading_change,
    jumps_with_both_feet,
    kick_height,
    path_length,
    pivots,
    rests_after,
    to_the_left,
)
from stmc.motion.kinematics import joint
from stmc.motion.motion import Motion

RUNNING, FLOATING = 0.06, 0.3
"""Fractions of the frames in the air: a fast gait above the first is a run or a jog; in some recordings of walks the
toes are off the floor up to the second."""

FASTER_THAN_A_WALK = 2.2
"""Speed in m/s above which nobody walks."""


def straight(motion: Motion) -> bool:
    """Return whether the heading stays within 60 degrees of the initial one."""
    return float(heading_change(motion).abs().max()) < math.radians(60)


def walks(motion: Motion, slowest: float | int, fastest: float | int) -> bool:
    """Return whether a person walks straight ahead, with a foot on the floor.

    Args:
        motion: The motion.
        slowest: Minimum mean speed along the heading in m/s, negative for backwards.
        fastest: Maximum mean speed along the heading in m/s.
    """
    paced = slowest <= mean_speed(motion) <= fastest and airborne_fraction(motion) < (
        RUNNING if fastest < 0 else FLOATING
    )
    return paced and straight(motion) and not jumps_with_both_feet(motion)


def jogs(motion: Motion, slowest: float | int, fastest: float | int) -> bool:
    """Return whether a person runs straight ahead, without jumps with both feet.

    Both feet are off the floor now and then, or the person is faster than any walk.

    Args:
        motion: The motion.
        slowest: Minimum mean speed along the heading in m/s, negative for backwards.
        fastest: Maximum mean speed along the heading in m/s.
    """
    speed = mean_speed(motion)
    running = airborne_fraction(motion) > RUNNING or abs(speed) > FASTER_THAN_A_WALK
    return slowest <= speed <= fastest and straight(motion) and running and not jumps_with_both_feet(motion)


def circles(motion: Motion) -> bool:
    """Return whether a person walks in a circle to the left.

    The turn is 300 degrees in 6 seconds, or at that rate, with a radius of 0.3 to 2.5 metres, and spread over all
    thirds of the path.
    """
    angle = heading_change(motion)
    whole, least = float(angle[-1]), math.radians(min(300.0, 50.0 * motion.duration))
    thirds = torch.stack([part[-1] - part[0] for part in angle.tensor_split(3)])
    return (
        whole >= least
        and 0.3 < path_length(motion) / whole < 2.5
        and float(thirds.min()) > 0.15 * whole
        and mean_speed(motion) > 0.3
    )


def turns(motion: Motion, least: float | int, most: float | int) -> bool:
    """Return whether an upright person has turned left in the end by `least` to `most` degrees, and never by 25 more.

    Args:
        motion: The motion.
        least: Minimum angle in degrees.
        most: Maximum angle in degrees.
    """
    angle, upright = torch.rad2deg(heading_change(motion)), float(pelvis_height(motion).min()) > SEATED
    kicks = max(kick_height(motion, side) for side in ("left", "right")) > 0.3
    return least <= float(angle[-1]) <= most and float(angle.max()) < most + 25 and upright and not kicks


def quarter_circle(motion: Motion) -> bool:
    """Return whether a person walks a quarter circle to the left: 60 to 120 degrees over 1.5 metres or more."""
    return turns(motion, 60, 120) and path_length(motion) > 1.5 and mean_speed(motion) > 0.3


def half_turn(motion: Motion, pivot: str) -> bool:
    """Return whether a person turns left by 150 to 210 degrees, and never more, about the ball of one foot."""
    angle = torch.rad2deg(heading_change(motion))
    return 150 <= float(angle[-1]) <= 210 and float(angle.max()) <= 215 and pivots(motion, pivot)


def kicks_high(motion: Motion) -> bool:
    """Return whether the left foot kicks at hip height or above."""
    return kick_height(motion, "left") > 0.72


def kicks_low(motion: Motion) -> bool:
    """Return whether the left foot kicks below the hips, and the right foot does not kick."""
    return 0.22 < kick_height(motion, "left") <= 0.68 and kick_height(motion, "right") < 0.22


def goes_down(motion: Motion) -> int | None:
    """Return the lowest frame of a person who stood before and sits or squats there, or None."""
    height = pelvis_height(motion)
    lowest = int(height.argmin())
    low = float(height[lowest]) < SEATED and bool((height[: lowest + 1] > UPRIGHT).any())
    return lowest if low else None


def squats(motion: Motion) -> bool:
    """Return whether a standing person goes down and up again in place, without a jump or a hand at the floor."""
    lowest, height = goes_down(motion), pelvis_height(motion)
    if lowest is None or displacement(motion) > 0.5:
        return False
    jumped = any(float(height[first:last].max()) > UPRIGHT for first, last in flights(motion))
    hands = min(float(joint(motion, f"{side}_wrist")[lowest, 2]) for side in ("left", "right"))
    return bool((height[lowest:] > UPRIGHT).any()) and hands > 0.22 and not jumped


def sits_down(motion: Motion) -> bool:
    """Return whether a standing person goes down and stays down."""
    frames = max(1, round(motion.fps / 4))
    return goes_down(motion) is not None and bool((pelvis_height(motion)[-frames:] < SEATED + 0.08).all())


def jumps_to(motion: Motion, direction: str) -> bool:
    """Return whether both feet jump mostly "forward", "backward" or "left", land, and rest."""
    jumps = jumps_with_both_feet(motion)
    if not jumps:
        return False
    forward, left = sum(jump.forward for jump in jumps), sum(jump.left for jump in jumps)
    along, across = {"forward": (forward, left), "backward": (-forward, left), "left": (left, forward)}[direction]
    return along > 0.15 and along > abs(across) and rests_after(motion, jumps[-1].last)


def jumping_jacks(motion: Motion) -> bool:
    """Return whether hands go up and down and feet apart and together, at least twice, with stretched arms."""
    apart = (joint(motion, "left_ankle") - joint(motion, "right_ankle")).norm(dim=-1)
    hands = (joint(motion, "left_wrist")[:, 2] + joint(motion, "right_wrist")[:, 2]) / 2
    return cycles(hands, 0.5) >= 2 and cycles(apart, 0.2) >= 2 and float(hands.max()) > 1.4


def golfs(motion: Motion) -> bool:
    """Return whether two hands together swing fast, low in the middle, from one side of the body to the other."""
    hands = (joint(motion, "left_wrist") + joint(motion, "right_wrist")) / 2 - joint(motion, "pelvis")
    together, across = hand_gap(motion) < 0.25, to_the_left(motion, hands)
    if float(together.float().mean()) < 0.5:
        return False
    swung = hands.diff(dim=0).norm(dim=-1)[together[1:]] * motion.fps
    sides = float(across[together].min()) < -0.15 and float(across[together].max()) > 0.15
    return sides and bool((swung > 2.2).any()) and float(hands[together, 2].min()) < 0.1


def bows(motion: Motion) -> bool:
    """Return whether an upright person bends forwards by 24 degrees or more, for 0.9 seconds, and comes up again."""
    bent, height = lean(motion)[:, 0], pelvis_height(motion)
    deepest = int(bent.argmax())
    most = float(bent[deepest])
    rises = max(float(bent[: deepest + 1].min()), float(bent[deepest:].min())) < 0.6 * most
    slow = longest(bent > math.radians(20), motion.fps) >= 0.9
    return most > math.radians(24) and rises and slow and float(height[deepest]) > 0.7 and not _hands_low(motion)


def _hands_low(motion: Motion) -> bool:
    return min(float(joint(motion, f"{side}_wrist")[:, 2].min()) for side in ("left", "right")) < 0.3


def dodges(motion: Motion) -> bool:
    """Return whether the head moves aside or back by 10 cm or more relative to the pelvis, and returns.

    The movement takes at most 0.6 seconds.
    """
    head, frames = joint(motion, "head") - joint(motion, "pelvis"), max(1, round(0.6 * motion.fps))
    across, ahead = to_the_left(motion, head), (head * motion.facing).sum(dim=-1)
    away = torch.maximum((across - across.median()).abs(), ahead.median() - ahead)
    peak = int(away.argmax())
    far, quick = float(away[peak]), float(away[peak] - away[max(0, peak - frames) : peak + 1].min())
    kicks = max(float(joint(motion, f"{side}_ankle")[:, 2].max()) for side in ("left", "right")) > 0.6
    comes_back = float(away[peak:].min()) < 0.5 * far
    return far > 0.1 and quick > 0.07 and comes_back and not kicks and not jumps_with_both_feet(motion)
