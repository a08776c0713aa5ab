"""What a model trained on the Bandai contents can be asked to do, and whether a motion does it.

Each ability is a timeline and a yes-or-no question about one motion's geometry: no learned evaluator, no text encoder.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from stmc.evaluation.benchmarks.questions import Question
from stmc.evaluation.metrics.action_measures import mean_speed, waves
from stmc.motion.kinematics import forward_speed, turn, wrist_height
from stmc.motion.motion import Motion
from stmc.timeline import Timeline

WALK, RAISE = (0.0, 8.0), (2.5, 5.5)
"""When the walk and the raise of "walk and raise" happen, in seconds."""

LONG, PACE = (8, 15, 30), 1.8
"""Seconds for which a run is to keep its pace, and the least pace in metres per second."""

SLACK = 0.75
"""Seconds by which a raised arm may come early or stay late: half a transition and the time an arm takes."""


@dataclass(frozen=True)
class Ability:
    """`shown(motion)` says whether a motion of `timeline` shows it; `expected` is the share of samples that should."""

    name: str
    timeline: Timeline
    shown: Question
    expected: float | int


def raises(motion: Motion, left: bool, right: bool) -> bool:
    """Whether exactly the named wrists come above their shoulders at some time."""
    up = [bool((wrist_height(motion, side, "shoulder") > 0).any()) for side in ("left", "right")]
    return up == [left, right]


def raises_while_walking(motion: Motion) -> bool:
    """Whether the right wrist is above the shoulder during `RAISE` (and `SLACK`) alone, the left one never, and the
    body walks at 0.5 to 2 m/s before, during and after."""
    first, last = (int(second * motion.fps) for second in RAISE)
    slack = int(SLACK * motion.fps)
    up = wrist_height(motion, "right", "shoulder") > 0
    timely = bool(up[first:last].any()) and not bool(up[: first - slack].any()) and not bool(up[last + slack :].any())
    other = bool((wrist_height(motion, "left", "shoulder") > 0).any())
    speed = forward_speed(motion)
    walking = all(0.5 <= float(part.mean()) <= 2 for part in (speed[:first], speed[first:last], speed[last:]))
    return timely and walking and not other


def keeps_running(motion: Motion) -> bool:
    """Whether every two seconds of it are faster than `PACE` on average, after the first, in which it begins."""
    window = round(2 * motion.fps)
    speeds = [float(part.mean()) for part in forward_speed(motion)[window // 2 :].split(window) if len(part) == window]
    return bool(speeds) and min(speeds) > PACE


def abilities() -> tuple[Ability, ...]:
    """All of them, in the order in which they are reported."""
    both = {"left": (True, False), "right": (False, True), "both": (True, True)}
    arms = {"left": "left arm", "right": "right arm", "both": "left arm # right arm"}
    raised = {"left": "raise the left arm", "right": "raise the right arm", "both": "raise both arms"}
    waved = {"left": "wave with the left hand", "right": "wave with the right hand", "both": "wave with both hands"}
    sides = {"left": ("left",), "right": ("right",), "both": ("left", "right")}
    return (
        *(
            _ability(raised[side], 3, arms[side], lambda motion, up=both[side]: raises(motion, *up), 0.9)
            for side in both
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
        *(
            _ability(waved[side], 6, arms[side], lambda motion, which=sides[side]: waves(motion, which), 0.9)
            for side in sides
        ),
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
