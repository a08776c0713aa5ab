"""Abilities of a model trained on the Bandai actions, and tests whether a motion shows them.

Each ability is a timeline and a yes-or-no question about the geometry of one motion, without a learned evaluator or a
text encoder.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

from stmc.evaluation.benchmarks.questions import Question
from stmc.evaluation.metrics.action_measures import mean_speed, waves
from stmc.motion.kinematics import forward_speed, turn, wrist_height
from stmc.motion.motion import Motion
from stmc.timeline import Timeline

WALK, RAISE = (0.0, 8.0), (2.5, 5.5)
"""Spans in seconds of the walk and the raise of "walk and raise"."""
LONG, PACE = (8, 15, 30), 1.8
"""Seconds for which a run must keep its pace, and the minimum pace in m/s."""
SLACK = 0.75
"""Seconds by which a raised arm may be early or late: half a transition and the time that an arm takes."""


@dataclass(frozen=True)
class Ability:
    """An ability: `shown(motion)` tests a motion of `timeline`.

    `expected` is the fraction of samples that should pass.
    """

    name: str
    timeline: Timeline
    shown: Question
    expected: float | int


def raises(motion: Motion, left: bool, right: bool) -> bool:
    """Return whether exactly the specified wrists come above their shoulders at some time.

    Args:
        motion: The motion.
        left: Whether the left wrist should.
        right: Whether the right wrist should.
    """
    up = [bool((wrist_height(motion, side, "shoulder") > 0).any()) for side in ("left", "right")]
    return up == [left, right]


def raises_while_walking(motion: Motion) -> bool:
    """Return whether the right arm is raised during a walk at the right time.

    The right wrist is above the shoulder during `RAISE` (with `SLACK`) only, the left one never, and the body walks at
    0.5 to 2 m/s before, during and after.
    """
    first, last = (int(second * motion.fps) for second in RAISE)
    slack = int(SLACK * motion.fps)
    up = wrist_height(motion, "right", "shoulder") > 0
    timely = bool(up[first:last].any()) and not bool(up[: first - slack].any()) and not bool(up[last + slack :].any())
    other = bool((wrist_height(motion, "left", "shoulder") > 0).any())
    speed = forward_speed(motion)
    walking = all(0.5 <= float(part.mean()) <= 2 for part in (speed[:first], speed[first:last], speed[last:]))
    return timely and walking and not other


def keeps_running(motion: Motion) -> bool:
    """Return whether every two seconds, after the first, are faster than `PACE` on average."""
    window = round(2 * motion.fps)
    speeds = [float(part.mean()) for part in forward_speed(motion)[window // 2 :].split(window) if len(part) == window]
    return bool(speeds) and min(speeds) > PACE


def abilities() -> tuple[Ability, ...]:
    """Return all abilities in the order of reports."""
    both = {"left": (True, False), "right": (False, True), "both": (True, True)}
    arms = {"left": "left arm", "right": "right arm", "both": "left arm # right arm"}
    raised = {"left": "raise the left arm", "right": "raise the right arm", "both": "raise both arms"}
    waved = {"left": "wave with the left hand", "right": "wave with the right hand", "both": "wave with both hands"}
    sides = {"left": ("left",), "right": ("right",), "both": ("left", "right")}
    return (
        *(
            _ability(raised[side], 3, arms[side], partial(raises, left=left, right=right), 0.9)
            for side, (left, right) in both.items()
        ),
        _ability("walk forwards", 6, "legs", lambda motion: 0.5 <= mean_speed(motion) <= 2, 0.95),
        _ability("run", 4, "legs", lambda motion: mean_speed(motion) > 1.5, 0.9),
        *(
            Ability(f"run for {seconds} s", Timeline.parse(f"run # 0 # {seconds} # legs"), keeps_running, 0.9)
            for seconds in LONG
        ),
        _ability("walk backwards", 6, "legs", lambda motion: mean_speed(motion) < -0.2, 0.9),
        _ability("turn left", 5, "legs", lambda motion: turn(motion) > math.pi / 4, 0.9),
        _ability("turn right", 5, "legs", lambda motion: turn(motion) < -math.pi / 4, 0.9),
        *(_ability(waved[name], 6, arms[name], partial(waves, sides=wavers), 0.9) for name, wavers in sides.items()),
        Ability(
            "walk and raise the right arm meanwhile",
            Timeline.parse(
                f"walk forwards # {WALK[0]} # {WALK[1]} # legs\n"
                f"raise the right arm # {RAISE[0]} # {RAISE[1]} # right arm"
            ),
            raises_while_walking,
            0.85,
        ),
    )


def _ability(text: str, seconds: float | int, parts: str, shown: Question, expected: float | int) -> Ability:
    return Ability(text, Timeline.parse(f"{text} # 0 # {seconds} # {parts}"), shown, expected)
