"""Geometric checks of MTT's texts about arms and the head; left forms only.

A check looks only at the body parts that its text claims, because the others may do something else on a timeline.
"""

from __future__ import annotations

import math
from itertools import pairwise

import torch

from stmc.evaluation.metrics.action_measures import joint_speed, lean
from stmc.evaluation.metrics.gestures import (
    BITE,
    EAR,
    MOUTH,
    NAPE,
    elevation,
    extension,
    gaze,
    hand_gap,
    hand_speed,
    head_turn_left,
    is_in_box,
    longest,
    relative_path,
    reversals,
    visits,
)
from stmc.evaluation.metrics.steps import heading_change
from stmc.motion.kinematics import joint, swings
from stmc.motion.motion import Motion


def raises(motion: Motion) -> bool:
    """Return whether the left arm is raised, well stretched, by 32 degrees or more above its shoulder, once or twice.

    The hand does not go to the head, and does not wave.
    """
    up = (elevation(motion, "left_shoulder", "left_wrist") > math.radians(32)) & (extension(motion, "left") > 0.6)
    free = up & ~is_in_box(motion, EAR) & ~is_in_box(motion, MOUTH) & ~is_in_box(motion, NAPE)
    return 1 <= len(visits(free, motion.fps, 0.2, 0.2)) <= 2 and not waves(motion)


def waves(motion: Motion) -> bool:
    """Return whether the left forearm swings sideways four times or more while it points up, without a clap."""
    steep = elevation(motion, "left_elbow", "left_wrist") > math.radians(20)
    stays = visits(steep, motion.fps, 0.5, 0.15)
    return max((swings(motion.trimmed(*stay), "left", 0.07) for stay in stays), default=0) >= 4 and not claps(motion)


def eats(motion: Motion) -> bool:
    """Return whether the left hand visits the mouth twice or more, and goes down by 15 cm or more in between.

    Each visit lasts 0.25 to 1.2 seconds.
    """
    height = relative_path(motion, "left_wrist", "head")[:, 1]
    stays = visits(is_in_box(motion, BITE), motion.fps, 0.25, 0.25)
    dips = [float(height[first:last].min()) for (_, first), (last, _) in pairwise(stays)]
    brief = all(last - first <= 1.2 * motion.fps for first, last in stays)
    return len(dips) >= 1 and brief and max(dips) < -0.2


def drinks(motion: Motion) -> bool:
    """Return whether the left hand is held at the mouth once or twice while the head tips back.

    Each hold lasts 0.6 seconds or more.
    """
    near = is_in_box(motion, MOUTH)
    holds = visits(near, motion.fps, 0.6, 0.25)
    pitch = gaze(motion)[:, 1]
    otherwise = pitch[~near] if bool((~near).any()) else pitch
    tips = max((float(pitch[first:last].max()) for first, last in holds), default=-math.inf)
    return 1 <= len(holds) <= 2 and tips > float(otherwise.median()) + math.radians(6)


def phones(motion: Motion) -> bool:
    """Return whether the left hand stays at the ear for a third of the motion, and at least 1.2 seconds."""
    return longest(is_in_box(motion, EAR), motion.fps) > max(1.2, motion.duration / 3)


def touches_back_of_head(motion: Motion) -> bool:
    """Return whether the left hand is behind the head for 0.4 seconds or more."""
    return longest(is_in_box(motion, NAPE), motion.fps) > 0.4


def points(motion: Motion) -> bool:
    """Return whether the left arm is held out straight, forwards or outwards, roughly level and still.

    The other hand is not involved, and the arm is never overhead.
    """
    angle, position = elevation(motion, "left_shoulder", "left_wrist"), relative_path(motion, "left_wrist", "chest")
    level = (angle > math.radians(-25)) & (angle < math.radians(35)) & (position[:, 2] > 0.1)
    still = torch.nn.functional.pad(hand_speed(motion, "left") < 0.35, (0, 1))
    level = level & (hand_gap(motion) > 0.25)
    held = longest(level & still & (extension(motion, "left") > 0.9), motion.fps)
    return held > 0.7 and float(angle.max()) < math.radians(50)


def throws(motion: Motion) -> bool:
    """Return whether the left hand moves from behind the shoulders far forwards within 0.6 seconds.

    It starts not below the chest, and is faster than 2.5 m/s.
    """
    position, frames = relative_path(motion, "left_wrist", "chest"), max(1, round(0.6 * motion.fps))
    behind = (position[:, 2] < 0.02) & (position[:, 1] > -0.15)
    speed = hand_speed(motion, "left")
    for frame in behind.nonzero()[:, 0].tolist():
        path = position[frame : frame + frames, 2]
        if float(path.max()) > 0.25 and float(speed[frame : frame + frames].max()) > 2.5:
            return True
    return False


def punches(motion: Motion) -> bool:
    """Return whether the left fist shoots from the chest to a nearly straight arm within a quarter second.

    It moves at the height of the chest or above.
    """
    position, frames = relative_path(motion, "left_wrist", "chest"), max(1, round(0.25 * motion.fps))
    reach = extension(motion, "left")
    for frame in range(len(position) - frames):
        thrust = reach[frame + frames] - reach[frame] > 0.3 and reach[frame + frames] > 0.85
        guarded = position[frame, 2] > 0.05 and position[frame, 1] > -0.3
        if bool(thrust and guarded and position[frame + frames, 2] > 0.3 and position[frame + frames, 1].abs() < 0.2):
            return True
    return False


def picks_up(motion: Motion) -> bool:
    """Return whether the left hand goes down near the floor, below the right one, and comes up again."""
    left, right = joint(motion, "left_wrist")[:, 2], joint(motion, "right_wrist")[:, 2]
    lowest = int(left.argmin())
    low = float(left[lowest]) < 0.4 and float(right[lowest]) > float(left[lowest]) + 0.08
    return low and float(left[lowest:].max()) > float(left[lowest]) + 0.35


def wipes(motion: Motion) -> bool:
    """Return whether the left hand alone moves to and fro four times or more well in front of the body.

    The forearm is not upright, and the trunk is not bent down.
    """
    position = relative_path(motion, "left_wrist", "chest")
    ahead = (
        (position[:, 2] > 0.22)
        & (position[:, 1] < 0.2)
        & (position[:, 1] > -0.42)
        & (lean(motion)[:, 0] < math.radians(35))
    )
    level = elevation(motion, "left_elbow", "left_wrist") < math.radians(45)
    alone = level & (hand_gap(motion) > 0.2) & ~is_in_box(motion, MOUTH)
    stays = visits(ahead & alone, motion.fps, 0.5, 0.1)
    return max((reversals(position[a:b, axis], 0.08) for a, b in stays for axis in (0, 1)), default=0) >= 4


def looks(motion: Motion) -> bool:
    """Return whether the head turns left relative to the chest by 30 degrees or more for 0.3 seconds.

    It turns less than half as far to the right. A head that leads a turn of the whole body does not count.
    """
    yaw, frames = gaze(motion)[:, 0], max(1, round(motion.fps))
    heading = torch.nn.functional.pad(
        heading_change(motion)[None], (frames // 2, frames - frames // 2), mode="replicate"
    )[0]
    calm = (heading[frames:] - heading[:-frames]) < math.radians(25)
    held = longest((yaw > math.radians(30)) & calm & (head_turn_left(motion) > math.radians(25)), motion.fps)
    return held > 0.3 and float(yaw.min()) > -0.5 * float(yaw.max())


def claps(motion: Motion) -> bool:
    """Return whether the hands come together in front of the chest four times or more, and part in between."""
    gap = hand_gap(motion)
    places = [relative_path(motion, f"{side}_wrist", "chest") for side in ("left", "right")]
    ahead = torch.stack([(place[:, 2] > 0.05) & (place[:, 1].abs() < 0.45) for place in places]).all(dim=0)
    together = visits((gap < 0.18) & ahead, motion.fps, 0.0, 0.0)
    parted = [float(gap[first:last].max()) > 0.22 for (_, first), (last, _) in pairwise(together)]
    return sum(parted) >= 3 and float(gap.median()) < 0.45


def plays_guitar(motion: Motion) -> bool:
    """Return whether the left hand holds a neck and the right hand strums at the belly four times or more.

    The left hand is out to its side and below the shoulder.
    """
    neck, strum = (relative_path(motion, f"{side}_wrist", "chest") for side in ("left", "right"))
    holds = (neck[:, 0] > 0.15) & (neck[:, 1] < -0.06) & (neck[:, 1] > -0.35) & (neck[:, 2] > 0.08)
    plays = (strum[:, 0].abs() < 0.25) & (strum[:, 1] < -0.12) & (strum[:, 2] > 0.05)
    strokes = [reversals(strum[a:b, 1], 0.03) for a, b in visits(holds & plays, motion.fps, 0.5, 0.15)]
    return max(strokes, default=0) >= 4


def plays_violin(motion: Motion) -> bool:
    """Return whether the left hand holds a neck at shoulder height and the right hand bows three times or more."""
    neck, bow = (relative_path(motion, f"{side}_wrist", "chest") for side in ("left", "right"))
    holds = (neck[:, 0] > 0.1) & (neck[:, 1] > -0.13) & (neck[:, 1] < 0.2) & (neck[:, 2] > 0.1)
    bent = extension(motion, "left") < 0.95
    along = bow @ bow.new_tensor([-0.86, -0.16, 0.48])
    near = (bow[:, 1] > -0.32) & (bow[:, 2] > 0.02)
    strokes = [reversals(along[a:b], 0.07) for a, b in visits(holds & bent & near, motion.fps, 0.5, 0.15)]
    still = float(joint_speed(motion, "left_wrist", beside="neck").median()) < 0.4
    return max(strokes, default=0) >= 3 and still
