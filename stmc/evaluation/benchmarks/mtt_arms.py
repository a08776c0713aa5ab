"""Whether a motion shows the texts of MTT that are about arms and the head, by geometry; left forms only.

A check looks at the body parts that its text claims and at nothing else: on a timeline the others do something else.
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
    longest,
    looked_left,
    reversals,
    seen_from,
    visits,
    within,
)
from stmc.evaluation.metrics.steps import turned
from stmc.motion.kinematics import joint, swings
from stmc.motion.motion import Motion


def raises(motion: Motion) -> bool:
    """Whether the left arm rises by 32 degrees or more above its shoulder, well stretched, once or twice, not to the
    head, and does not wave."""
    up = (elevation(motion, "left_shoulder", "left_wrist") > math.radians(32)) & (extension(motion, "left") > 0.6)
    free = up & ~within(motion, EAR) & ~within(motion, MOUTH) & ~within(motion, NAPE)
    return 1 <= len(visits(free, motion.fps, 0.2, 0.2)) <= 2 and not waves(motion)


def waves(motion: Motion) -> bool:
    """Whether the left forearm swings sideways four times or more while it points up all along, and
    hands do not clap."""
    steep = elevation(motion, "left_elbow", "left_wrist") > math.radians(20)
    stays = visits(steep, motion.fps, 0.5, 0.15)
    return max((swings(motion.trimmed(*stay), "left", 0.07) for stay in stays), default=0) >= 4 and not claps(motion)


def eats(motion: Motion) -> bool:
    """Whether the left hand visits the mouth twice or more, for 0.25 to 1.2 seconds each, and goes down by 15 cm or
    more in between."""
    height = seen_from(motion, "left_wrist", "head")[:, 1]
    stays = visits(within(motion, BITE), motion.fps, 0.25, 0.25)
    dips = [float(height[first:last].min()) for (_, first), (last, _) in pairwise(stays)]
    brief = all(last - first <= 1.2 * motion.fps for first, last in stays)
    return len(dips) >= 1 and brief and max(dips) < -0.2


def drinks(motion: Motion) -> bool:
    """Whether the left hand is held at the mouth once or twice, 0.6 seconds or more each, the head tipping back
    meanwhile."""
    near = within(motion, MOUTH)
    holds = visits(near, motion.fps, 0.6, 0.25)
    pitch = gaze(motion)[:, 1]
    otherwise = pitch[~near] if bool((~near).any()) else pitch
    tips = max((float(pitch[first:last].max()) for first, last in holds), default=-math.inf)
    return 1 <= len(holds) <= 2 and tips > float(otherwise.median()) + math.radians(6)


def phones(motion: Motion) -> bool:
    """Whether the left hand comes to the ear and stays for a third of the motion and 1.2 seconds at least."""
    return longest(within(motion, EAR), motion.fps) > max(1.2, motion.duration / 3)


def touches_back_of_head(motion: Motion) -> bool:
    """Whether the left hand is behind the head for 0.4 seconds or more."""
    return longest(within(motion, NAPE), motion.fps) > 0.4


def points(motion: Motion) -> bool:
    """Whether the left arm is held out straight, forwards or outwards, about level and still, without the
    other hand and never overhead."""
    angle, place = elevation(motion, "left_shoulder", "left_wrist"), seen_from(motion, "left_wrist", "chest")
    level = (angle > math.radians(-25)) & (angle < math.radians(35)) & (place[:, 2] > 0.1)
    still = torch.nn.functional.pad(hand_speed(motion, "left") < 0.35, (0, 1))
    level = level & (hand_gap(motion) > 0.25)
    held = longest(level & still & (extension(motion, "left") > 0.9), motion.fps)
    return held > 0.7 and float(angle.max()) < math.radians(50)


def throws(motion: Motion) -> bool:
    """Whether the left hand, from behind the shoulders and not below the chest, comes far forward within 0.6 seconds,
    faster than 2.5 metres per second."""
    place, few = seen_from(motion, "left_wrist", "chest"), max(1, round(0.6 * motion.fps))
    behind = (place[:, 2] < 0.02) & (place[:, 1] > -0.15)
    speed = hand_speed(motion, "left")
    for frame in behind.nonzero()[:, 0].tolist():
        coming = place[frame : frame + few, 2]
        if float(coming.max()) > 0.25 and float(speed[frame : frame + few].max()) > 2.5:
            return True
    return False


def punches(motion: Motion) -> bool:
    """Whether the left fist shoots from in front of the chest to an almost straight arm within a quarter second, at the
    height of the chest or above."""
    place, few = seen_from(motion, "left_wrist", "chest"), max(1, round(0.25 * motion.fps))
    reach = extension(motion, "left")
    for frame in range(len(place) - few):
        thrust = reach[frame + few] - reach[frame] > 0.3 and reach[frame + few] > 0.85
        guard = place[frame, 2] > 0.05 and place[frame, 1] > -0.3
        if bool(thrust and guard and place[frame + few, 2] > 0.3 and place[frame + few, 1].abs() < 0.2):
            return True
    return False


def picks_up(motion: Motion) -> bool:
    """Whether the left hand goes down near the floor, below the right one, and comes up again."""
    left, right = joint(motion, "left_wrist")[:, 2], joint(motion, "right_wrist")[:, 2]
    lowest = int(left.argmin())
    low = float(left[lowest]) < 0.4 and float(right[lowest]) > float(left[lowest]) + 0.08
    return low and float(left[lowest:].max()) > float(left[lowest]) + 0.35


def wipes(motion: Motion) -> bool:
    """Whether the left hand, without the other one, goes to and fro four times or more well in front of the body, the
    forearm not upright and the trunk not bent down."""
    place = seen_from(motion, "left_wrist", "chest")
    ahead = (place[:, 2] > 0.22) & (place[:, 1] < 0.2) & (place[:, 1] > -0.42) & (lean(motion)[:, 0] < math.radians(35))
    level = elevation(motion, "left_elbow", "left_wrist") < math.radians(45)
    alone = level & (hand_gap(motion) > 0.2) & ~within(motion, MOUTH)
    stays = visits(ahead & alone, motion.fps, 0.5, 0.1)
    return max((reversals(place[a:b, axis], 0.08) for a, b in stays for axis in (0, 1)), default=0) >= 4


def looks(motion: Motion) -> bool:
    """Whether the head turns to the left against the chest, to 30 degrees or more for 0.3 seconds, and less than half
    as far to the right; a head that leads a turn of the whole body does not count."""
    yaw, few = gaze(motion)[:, 0], max(1, round(motion.fps))
    heading = torch.nn.functional.pad(turned(motion)[None], (few // 2, few - few // 2), mode="replicate")[0]
    calm = (heading[few:] - heading[:-few]) < math.radians(25)
    held = longest((yaw > math.radians(30)) & calm & (looked_left(motion) > math.radians(25)), motion.fps)
    return held > 0.3 and float(yaw.min()) > -0.5 * float(yaw.max())


def claps(motion: Motion) -> bool:
    """Whether the hands come together in front of the chest four times or more, and part in between."""
    gap = hand_gap(motion)
    places = [seen_from(motion, f"{side}_wrist", "chest") for side in ("left", "right")]
    ahead = torch.stack([(place[:, 2] > 0.05) & (place[:, 1].abs() < 0.45) for place in places]).all(dim=0)
    together = visits((gap < 0.18) & ahead, motion.fps, 0.0, 0.0)
    parted = [float(gap[first:last].max()) > 0.22 for (_, first), (last, _) in pairwise(together)]
    return sum(parted) >= 3 and float(gap.median()) < 0.45


def plays_guitar(motion: Motion) -> bool:
    """Whether the left hand holds a neck, out to its side and below the shoulder, and the right one strums at the belly
    four times or more."""
    neck, strum = (seen_from(motion, f"{side}_wrist", "chest") for side in ("left", "right"))
    holds = (neck[:, 0] > 0.15) & (neck[:, 1] < -0.06) & (neck[:, 1] > -0.35) & (neck[:, 2] > 0.08)
    plays = (strum[:, 0].abs() < 0.25) & (strum[:, 1] < -0.12) & (strum[:, 2] > 0.05)
    strokes = [reversals(strum[a:b, 1], 0.03) for a, b in visits(holds & plays, motion.fps, 0.5, 0.15)]
    return max(strokes, default=0) >= 4


def plays_violin(motion: Motion) -> bool:
    """Whether the left hand holds a neck at the height of the shoulder and the right one draws a bow to and fro three
    times or more."""
    neck, bow = (seen_from(motion, f"{side}_wrist", "chest") for side in ("left", "right"))
    holds = (neck[:, 0] > 0.1) & (neck[:, 1] > -0.13) & (neck[:, 1] < 0.2) & (neck[:, 2] > 0.1)
    bent = extension(motion, "left") < 0.95
    along = bow @ bow.new_tensor([-0.86, -0.16, 0.48])
    near = (bow[:, 1] > -0.32) & (bow[:, 2] > 0.02)
    strokes = [reversals(along[a:b], 0.07) for a, b in visits(holds & bent & near, motion.fps, 0.5, 0.15)]
    still = float(joint_speed(motion, "left_wrist", beside="neck").median()) < 0.4
    return max(strokes, default=0) >= 3 and still
