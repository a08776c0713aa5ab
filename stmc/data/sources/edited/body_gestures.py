"""Gestures of the whole body as scripts of keys: punches, boxing, throws, a golf swing, picking up and dodging.

Hips and weight go first, the trunk follows, the hand comes last. Feet stay in place, except for the step of a throw.
"""

from __future__ import annotations

import numpy as np

from stmc.data.sources.edited.script import ONSET, Script, Spot, pelvis_key, turn_key
from stmc.editing import FootKey, Oscillation, WristKey

GUARD = Spot((0.09, -0.08, 0.15), (0.13, 0.02, 0.20), pole=((0.5, -1, -0.1), (0.5, -1, -0.1)))
JAB = Spot((0.0, -0.02, 0.452), (0.05, 0.04, 0.462), pole=((0.6, -1, 0), (0.8, -0.8, 0)), shrug=(4, 9))
COCKED = Spot((0.26, 0.05, -0.16), (0.32, 0.14, -0.10), pole=((1, 0, -0.4), (1, 0, -0.4)), shrug=(4, 8))
RELEASE = Spot((0.06, 0.12, 0.38), (0.14, 0.20, 0.42), pole=((1, -0.3, 0), (1, -0.3, 0)), shrug=(6, 10))
FOLLOW = Spot((-0.16, -0.36, 0.22), (-0.05, -0.28, 0.30), pole=((0.8, -0.6, -0.2), (0.8, -0.6, -0.2)))
BALANCE = Spot((0.08, -0.16, 0.36), (0.14, -0.02, 0.42), pole=((1, -1, 0), (1, -1, 0)))
FLOOR = Spot((0.05, 0.10, 0.05), (0.14, 0.18, 0.16), "ground", ((0.6, -0.2, -1), (0.6, -0.2, -1)))
BELLY = Spot((0.02, -0.30, 0.22), (0.10, -0.22, 0.28), pole=((0.6, -1, -0.3), (0.6, -1, -0.3)))
ASIDE = Spot((0.12, -0.32, -0.22), (0.20, -0.24, -0.10), "shoulder", ((0.6, 0.6, -1), (0.6, 0.6, -1)))
THIGH = Spot((0.09, 0.50, -0.10), (0.13, 0.56, -0.04), "ground", ((1, 0.3, -0.6), (1, 0.3, -0.3)))
SHIELD = Spot((0.04, -0.04, 0.20), (0.10, 0.06, 0.25), pole=((0.5, -1, 0.1), (0.5, -1, 0.1)))


def punch(rng: np.random.Generator) -> Script:
    """Script one to three straight punches from a guard: the hip turns, the trunk and the fist follow."""
    time, count = ONSET + 0.45, int(rng.integers(1, 4))
    guard, keys, hips, twists = GUARD.draw(rng), [], [], []
    raised, hip, yaw = float(time), rng.uniform(10, 18), rng.uniform(16, 26)
    ahead, depth = rng.uniform(0.03, 0.06), -rng.uniform(0.02, 0.045)
    keys.append(guard.key(time, 0.45, 1.3))
    hips.append(pelvis_key(time, 0.45, (0.0, depth, 0.0), hip * 0.4))
    twists.append(turn_key(time, 0.45, 0.3 * yaw, 4))
    for _ in range(count):
        out, back = 0.2, rng.uniform(0.25, 0.30)
        time += 0.5 + out
        keys += [JAB.draw(rng).key(time, out, 1.2), guard.near(rng, 0.015).key(time + back + 0.06, back, 1.35)]
        hips += [
            pelvis_key(time, out + 0.08, (0.0, depth, ahead), -hip),
            pelvis_key(time + 0.45, 0.4, (0, depth, 0), hip * 0.4),
        ]
        twists += [turn_key(time, out + 0.05, -yaw, 5), turn_key(time + 0.42, 0.36, 0.3 * yaw, 4)]
        time += back + 0.06
    ends = time + rng.uniform(0.3, 0.7) + 0.7
    seconds = max(3.5, ends + rng.uniform(0.3, 1.0))
    hips.append(pelvis_key(ends, 0.7))
    twists.append(turn_key(ends, 0.7))
    right = (GUARD.draw(rng).key(raised, 0.45, 1.3), WristKey(ends + 0.05, 0.7)) if rng.uniform() < 0.5 else ()
    return Script(seconds, (*keys, WristKey(ends, 0.7)), right, trunk=tuple(twists), pelvis=tuple(hips), gaze=0.9)


def box(rng: np.random.Generator) -> Script:
    """Script boxing: from a guard, the fists shoot forward in turn at an even beat; hips and trunk turn with them."""
    raised, beat, out, back = ONSET + 0.45, 0.5, 0.15, 0.22  # slower fists have a quarter of real boxers' energy
    guards = [GUARD.draw(rng), GUARD.draw(rng)]
    hands = [[guard.key(raised, 0.45, 1.3)] for guard in guards]
    hip, yaw, depth = rng.uniform(10, 16), rng.uniform(20, 28), -rng.uniform(0.03, 0.06)
    hips, twists = [pelvis_key(raised, 0.45, (0.0, depth, 0.0))], [turn_key(raised, 0.45, pitch=5)]
    time = raised + 0.2
    for number in range(int(rng.integers(6, 13))):
        arm, side = number % 2, 1 - 2 * (number % 2)
        time += out
        hands[arm] += [
            JAB.draw(rng).key(time, out, 1.2),
            guards[arm].near(rng, 0.015).key(time + back, back, 1.35),
        ]
        hips.append(
            pelvis_key(time, 0.3, (0.0, depth + rng.uniform(-0.02, 0.02), rng.uniform(0.03, 0.07)), -side * hip)
        )
        twists.append(turn_key(time, 0.3, -side * yaw, 5))
        time += beat - out
    return Script(time + 0.3, tuple(hands[0]), tuple(hands[1]), trunk=tuple(twists), pelvis=tuple(hips), gaze=0.9)


def throw(rng: np.random.Generator) -> Script:
    """Script an overhand throw: the hand is drawn back, the other foot steps, hips and chest turn, the arm follows."""
    winds = rng.uniform(0.68, 0.74)
    wound = ONSET + winds
    forward, follow = rng.uniform(0.28, 0.32), rng.uniform(0.30, 0.36)
    throws, down = wound + 0.05 + forward, 0.0
    down = throws + follow * 0.75
    ends, strides = down + rng.uniform(0.3, 0.7) + 0.8, rng.uniform() < 0.75
    stride = rng.uniform(0.20, 0.32) if strides else 0.0
    back, front, hip = -rng.uniform(0.03, 0.06), rng.uniform(0.07, 0.11) + 0.25 * stride, rng.uniform(10, 18)
    sink = -0.25 * stride**2 - 0.015
    hips = (
        pelvis_key(wound, winds, (0.03, -0.01, back), hip),
        pelvis_key(throws, forward + 0.12, (-0.01, sink, front), -hip, 4, skew=1.0),
        pelvis_key(ends + 0.2, 0.9),
    )
    yaw, over = rng.uniform(22, 32), rng.uniform(18, 26)
    trunk = (
        turn_key(wound, winds, yaw, -6, 4),
        turn_key(throws + 0.05, forward + 0.05, -over * 0.7, 10, -4, skew=1.0),
        turn_key(down + 0.05, follow, -over, 18, -6),
        turn_key(ends, 0.8),
    )
    cocked, release = COCKED.draw(rng), RELEASE.draw(rng)
    left = (
        cocked.key(wound, winds, 1.15),
        release.key(throws, forward, 0.85, roundness=0.8),
        FOLLOW.draw(rng).key(down, follow, 1.25, roundness=0.7),
        WristKey(ends, 0.8),
    )
    right = (BALANCE.draw(rng).key(wound, winds), WristKey(down + 0.1, follow + 0.2)) if rng.uniform() < 0.6 else ()
    feet = (
        FootKey(wound + 0.16, 0.45, (0.02, 0.0, stride), rng.uniform(0.05, 0.09)),
        FootKey(ends + 0.3, 0.6, lift=0.05),
    )
    seconds = ends + 0.3 + rng.uniform(0.3, 0.9)
    return Script(seconds, left, right, (), trunk, hips, feet if strides else (), gaze=0.85)


def pick_up(rng: np.random.Generator) -> Script:
    """Script picking up: the body bends at hips and knees, and one hand goes to the floor.

    The other hand is on the thigh or aside.
    """
    takes, stays, up = rng.uniform(0.95, 1.1), rng.uniform(0.3, 0.45), rng.uniform(0.95, 1.1)
    low = ONSET + takes
    stands = low + stays + up
    depth, pitch, spine = rng.uniform(0.34, 0.46), rng.uniform(38, 50), rng.uniform(24, 34)
    yaw, ends = rng.uniform(8, 14), stands + rng.uniform(0.3, 0.9) + 0.7
    hips = (pelvis_key(low, takes, (0.0, -depth, -rng.uniform(0.08, 0.13)), -0.4 * yaw, pitch), pelvis_key(stands, up))
    trunk = (turn_key(low, takes, -yaw, spine, 5), turn_key(stands, up))
    head = (turn_key(low - 0.15 * takes, takes * 0.8, 4, rng.uniform(-4, 8)), turn_key(stands, up))
    carried = BELLY.draw(rng).key(stands, up, 1.1)
    left: tuple[WristKey, ...] = (FLOOR.draw(rng).key(low, takes * 0.9, 1.1), carried, WristKey(ends, 0.7))
    other = (THIGH if rng.uniform() < 0.6 else ASIDE).draw(rng)
    right = (other.key(low, takes, 1.1), WristKey(stands, up, skew=1.1))
    if rng.uniform() < 0.4:
        left, ends = left[:2], stands + 0.5
    return Script(ends + rng.uniform(0.3, 0.8), left, right, head, trunk, hips, gaze=0.2)


def golf(rng: np.random.Generator) -> Script:
    """Script a golf swing: address, backswing with a straight left arm, hit and a low finish, right-handed."""
    address = ONSET + 0.9
    back, hit, pause = rng.uniform(0.8, 0.9), rng.uniform(0.27, 0.31), 0.5
    top = address + pause + back
    impact, twist = top + 0.04 + hit, rng.uniform(30, 40)
    finish, holds = impact + rng.uniform(0.45, 0.5), rng.uniform(0.8, 1.2)
    ends, pitch, hip = finish + holds + 0.9, rng.uniform(20, 26), rng.uniform(14, 22)
    stance = -rng.uniform(0.03, 0.06)
    hips = (
        pelvis_key(address, 0.9, (0, stance, -0.04), 0, 14),
        pelvis_key(top, back, (-0.02, stance, -0.04), -hip, 13),
        pelvis_key(impact - 0.04, hit + 0.06, (0.04, stance, -0.03), 0.9 * hip, 12, skew=1.0),
        pelvis_key(finish, 0.5, (0.06, 0.5 * stance, 0.0), 1.9 * hip, 3),
        pelvis_key(ends, 0.9),
    )
    trunk = (
        turn_key(address, 0.9, 0, pitch, -3),
        turn_key(top, back, -twist, pitch, 3),
        turn_key(impact, hit + 0.02, 6, pitch, -6, skew=1.0),
        turn_key(finish, 0.5, twist, 0.3 * pitch, -5),
        turn_key(ends, 0.9),
    )
    head = (
        turn_key(address, 0.7, 0, 10),
        turn_key(top, back, twist + hip, 8),
        turn_key(impact, hit, -4, 10, skew=1.0),
        turn_key(finish, 0.5, -8, -2),
        turn_key(ends, 0.9),
    )
    swing = (address, pause, back, top, hit, impact, finish, ends)
    left, right = (_club(side, swing) for side in ("left", "right"))
    wide, stands = rng.uniform(0.05, 0.09), ends + 0.1
    left_foot = (FootKey(address - 0.35, 0.4, (wide, 0, 0), 0.03), FootKey(stands, 0.45, lift=0.03))
    right_foot = (FootKey(address, 0.4, (-wide, 0, 0), 0.03), FootKey(stands + 0.4, 0.45, lift=0.03))
    seconds = stands + 0.4 + rng.uniform(0.3, 0.8)
    return Script(seconds, left, right, head, trunk, hips, right_foot, left_foot)


_GRIP = {
    "left": ((-0.02, -0.345, 0.240), (-0.175, 0.10, 0.335), (0.13, -0.27, 0.30), (0.20, -0.06, 0.22)),
    "right": ((0.005, -0.385, 0.225), (0.165, 0.035, 0.30), (-0.10, -0.30, 0.28), (-0.14, -0.11, 0.25)),
}
"""Positions of the hands at address and impact, at the top, past the ball, and at the finish."""
_GRIP_POLES = {"left": (0.6, -0.9, -0.1), "right": (0.8, -1.0, -0.2)}


def _club(side: str, swing: tuple[float, ...]) -> tuple[WristKey, ...]:
    """Return the keys of one hand on the club: it waits at address, and passes the ball without a stop."""
    address, pause, back, top, hit, impact, finish, ends = swing
    pole = _GRIP_POLES[side]
    ball, high, past, last = (Spot(goal, goal, pole=(pole, pole)) for goal in _GRIP[side])
    waggle = Oscillation(1 / max(pause, 0.3), (0.012 if side == "right" else -0.012, 0.004, 0.0))
    return (
        ball.key(address, 0.85, 1.2),
        Spot(ball.low, ball.low, pole=ball.pole).key(address + pause, pause, 1.0, waggle),
        high.key(top, back, 1.1, roundness=0.9),
        ball.key(impact, hit, 0.9, roundness=0.9),
        past.key(impact + 0.14, 0.2, 1.0, roundness=0.9),
        last.key(finish, finish - impact - 0.04, 1.2, roundness=0.7),
        WristKey(ends, 0.85),
    )


def dodge(rng: np.random.Generator) -> Script:
    """Script a dodge: head and trunk lean quickly back and slightly aside, and come up again.

    There is one direction: of dodges to the left, to the right and back, a network learns the mean, which is still.
    """
    out, stays, back = rng.uniform(0.3, 0.34), rng.uniform(0.3, 0.5), rng.uniform(0.55, 0.7)
    away = ONSET + out
    ends, side = away + stays + back, float(rng.choice([-1, 1]))
    lean, duck = rng.uniform(4, 14), rng.uniform(0.03, 0.08)
    aside, pitch, yaw = (side * rng.uniform(0, 0.03), -duck, -0.07), -rng.uniform(24, 32), -side * rng.uniform(0, 12)
    hips = (pelvis_key(away, out + 0.04, aside, 0, 0.3 * pitch, side * 0.15 * lean, 1.3), pelvis_key(ends, back))
    trunk = (turn_key(away, out, yaw, pitch, side * lean, 1.3), turn_key(ends, back))
    head = (turn_key(away - 0.03, out, 0.5 * yaw, 0.2 * pitch, side * rng.uniform(2, 12), 1.3), turn_key(ends, back))
    left: tuple[WristKey, ...] = ()
    right: tuple[WristKey, ...] = ()
    if rng.uniform() < 0.6:
        hands = [SHIELD.draw(rng).near(rng, 0.03) for _ in range(2)]
        left, right = ((hand.key(away + 0.05, out, 1.4), WristKey(ends + 0.1, back)) for hand in hands)
    seconds = max(3.0, ends + rng.uniform(0.6, 1.2))
    return Script(seconds, left, right, head, trunk, hips, gaze=rng.uniform(0.1, 0.5))
