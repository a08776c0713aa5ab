"""Recipes of gestures: arms, heads and trunks that follow keys on calm recorded bodies.

Goals are metres in the axes of chest or head (outwards, up, forward) of the default body, whose arm is 0.466 m long.
Every gesture starts at rest; gestures that do not return stay until the end.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from stmc.data.sources.edited import gesture_gates as gates
from stmc.data.sources.edited.body_gestures import box, dodge, golf, pick_up, punch, throw
from stmc.data.sources.edited.gesture_bases import Kind, draw_base
from stmc.data.sources.edited.recipe import Bases, Draft, Recipe, Unusable
from stmc.data.sources.edited.script import ONSET, Script, Spot, turn_key
from stmc.editing import Oscillation, WristKey
from stmc.motion.motion import Motion

EAR = Spot((0.15, 0.0, 0.04), (0.18, 0.04, 0.09), "head", ((0.4, -1, 0.1), (0.9, -1, 0.5)), (2, 7), (0.03, 0, 0.1))
PLATE = Spot((0.05, -0.34, 0.24), (0.14, -0.26, 0.31), pole=((0.4, -1, -0.2), (0.8, -1, -0.2)))
MOUTH = Spot((0.03, -0.05, 0.16), (0.06, -0.02, 0.19), "head", ((0.6, -0.8, 0), (1, -0.8, 0)))
CUP = Spot((0.03, -0.26, 0.24), (0.11, -0.18, 0.30), pole=((0.4, -1, -0.2), (0.8, -1, -0.2)))
SIP = Spot((0.03, -0.04, 0.16), (0.06, -0.01, 0.18), "head", ((0.8, -1.0, 0), (1, -0.6, 0.1)), (2, 6))
BESIDE_HEAD = Spot(
    (0.22, 0.02, 0.06), (0.26, 0.06, 0.10), "head", ((1, -0.2, 0.5), (1, -0.2, 0.5)), (4, 8), (0, 0, 0.08)
)
NAPE = Spot((0.13, 0.02, -0.12), (0.165, 0.07, -0.08), "head", ((1, 0.2, 0.1), (1, 0.6, 0.5)), (8, 16))
TABLE = Spot((0.09, -0.26, 0.31), (0.16, -0.20, 0.35), pole=((0.5, -1, 0), (1, -1, 0)))
PANE = Spot((0.08, -0.18, 0.34), (0.14, -0.07, 0.38), pole=((0.5, -1, 0), (1, -1, 0)), shrug=(0, 5))
CLAP = Spot((0.098, -0.16, 0.24), (0.106, -0.06, 0.29), pole=((1, -1, -0.1), (1, -1, -0.1)))
NECK = Spot((0.30, -0.19, 0.20), (0.34, -0.14, 0.25), pole=((0.5, -1, -0.1), (0.5, -1, -0.1)))
STRINGS = Spot((0.0, -0.26, 0.20), (0.05, -0.22, 0.23), pole=((1, -0.6, -0.5), (1, -0.6, -0.3)))
SCROLL = Spot((0.25, -0.04, 0.26), (0.30, 0.03, 0.30), pole=((0.15, -1, 0), (0.3, -1, 0)), shrug=(2, 6))
BOW = Spot((0.08, -0.06, 0.28), (0.11, -0.03, 0.31), pole=((1, -0.4, -0.1), (1, -0.2, 0)), shrug=(0, 4))

WIPING, CLAPPING, STRUMMING, BOWING, RUBBING = 20 / 24, 20 / 10, 20 / 12, 20 / 32, 20 / 12
"""Frequencies in Hz of periodic movements: whole frames at 20 fps, in phase from an arrival that is always at the same
time, so that a network can learn the phase. Sizes, places and bodies differ."""

SHORTEST, LONGEST = 3.5, 9.0
"""Minimum and maximum duration of a clip in seconds."""
STANDING: dict[Kind, float] = {"stand": 1.0}
ANYWHERE: dict[Kind, float] = {"stand": 0.7, "walk": 0.18, "sit": 0.12}
ON_FEET: dict[Kind, float] = {"stand": 0.82, "walk": 0.18}
STANDING_OR_SEATED: dict[Kind, float] = {"stand": 0.85, "sit": 0.15}


@dataclass(frozen=True)
class _Gesture:
    """Makes clips of one action: draws a script and a body of the same length, and performs the script."""

    script: Callable[[np.random.Generator], Script]
    kinds: dict[Kind, float]

    def __call__(self, bases: Bases, rng: np.random.Generator) -> Draft:
        script = self.script(rng)
        if script.seconds > LONGEST:
            raise Unusable(f"a script of {script.seconds:.1f} s")
        kind = list(self.kinds)[rng.choice(len(self.kinds), p=list(self.kinds.values()))]
        base = draw_base(bases, rng, max(SHORTEST, script.seconds), kind)
        return Draft(script.perform(base.motion, rng), base.recording)


def _draw_rest(rng: np.random.Generator) -> float:
    """Draw the seconds of rest after a gesture."""
    return float(rng.uniform(0.3, 1.0))


def _end(rng: np.random.Generator, time: float, returning: float) -> tuple[tuple[WristKey, ...], float]:
    """Draw the key of the hand's return, with probability `returning`, and the duration of the clip in seconds."""
    if rng.uniform() >= returning:
        return (), time + rng.uniform(0.2, 0.6)
    takes = rng.uniform(0.6, 0.95)
    return (WristKey(time + takes, takes, skew=rng.uniform(1.0, 1.3)),), time + takes + _draw_rest(rng)


def phone(rng: np.random.Generator) -> Script:
    """Script a phone call: the hand goes to the ear and stays; the head leans to it and turns slightly."""
    begins, takes, stays = ONSET, rng.uniform(0.7, 0.8), rng.uniform(2.4, 6.0)
    there, ear = begins + takes, EAR.draw(rng)
    back, seconds = _end(rng, there + stays, 0.5)
    roll, nods = rng.uniform(4, 13), [turn_key(there, takes * 0.8, roll=rng.uniform(4, 13))]
    time = there + rng.uniform(0.2, 0.6)
    while time < there + stays - 0.9:
        time += rng.uniform(0.7, 1.2)
        nods.append(turn_key(time, rng.uniform(0.5, 0.7), rng.uniform(-12, 8), rng.uniform(-3, 7), roll))
    ends = [turn_key(max(back[0].time, time), 0.6)] if back else []
    drift = Oscillation(0.4, (0.002, 0.003, 0.002), (0.002, 0, 0.003))
    return Script(seconds, left=(ear.key(there, takes, rng.uniform(1.1, 1.5), drift), *back), head=(*nods, *ends))


def eat(rng: np.random.Generator) -> Script:
    """Script a meal: from the plate to the mouth and back, three times; the head meets the hand."""
    time, plate, mouth = ONSET + 0.7, PLATE.draw(rng), MOUTH.draw(rng)
    keys, nods, pitch = [plate.key(time, 0.6)], [], rng.uniform(6, 14)
    up, stay, down = 0.5, 0.3, 0.5
    for _ in range(3):
        at = time + 0.2 + up
        keys.append(mouth.near(rng, 0.005).key(at, up, rng.uniform(1.0, 1.3)))
        nods += [turn_key(at, up, pitch=pitch), turn_key(at + stay + down, down, pitch=0.3 * pitch)]
        time = at + stay + down
        keys.append(plate.near(rng, 0.02).key(time, down, rng.uniform(1.1, 1.4)))
    back, seconds = _end(rng, time + rng.uniform(0.1, 0.3), 0.75)
    bent = [turn_key(keys[0].time, 0.7, pitch=rng.uniform(1, 5)), *([turn_key(back[0].time, 0.7)] if back else [])]
    nods += [turn_key(back[0].time, 0.6)] if back else []
    return Script(seconds, left=(*keys, *back), head=tuple(nods), trunk=tuple(bent))


def drink(rng: np.random.Generator) -> Script:
    """Script a drink: a cup goes to the mouth once or twice, and the head tips back while the elbow rises."""
    cup, count, time, nods = CUP.draw(rng), int(rng.integers(1, 3)), ONSET + 0.6, []
    keys = [cup.key(time, 0.6)]
    time += 0.25
    sip = SIP.draw(rng)
    for _ in range(count):
        up, stay, down = rng.uniform(0.6, 0.7), rng.uniform(1.1, 1.3), rng.uniform(0.55, 0.7)
        time += up
        keys.append(sip.near(rng, 0.004).key(time, up, rng.uniform(1.1, 1.4)))
        nods += [turn_key(time + 0.25, 0.5, pitch=-rng.uniform(11, 19)), turn_key(time + stay + 0.3, 0.5)]
        time += stay + down
        keys.append(cup.near(rng, 0.02).key(time, down, rng.uniform(1.0, 1.3)))
        time += rng.uniform(0.1, 0.4)
    back, seconds = _end(rng, time, 0.65)
    return Script(seconds, left=(*keys, *back), head=tuple(nods))


def touch_head(rng: np.random.Generator) -> Script:
    """Script a touch: the hand goes past the ear to the back of the head and stays, rubbing in half of the draws."""
    begins, takes, stays = ONSET, rng.uniform(0.9, 1.0), rng.uniform(2.0, 5.0)
    there, nape = begins + takes, NAPE.draw(rng)
    rub = Oscillation(RUBBING, (0.004, 0.014, 0.0)) if rng.uniform() < 0.5 else None
    via = BESIDE_HEAD.draw(rng).key(begins + 0.72 * takes, 0.72 * takes, 1.2)
    back, seconds = _end(rng, there + stays, 0.55)
    if back:
        out = BESIDE_HEAD.draw(rng).key(back[0].time - 0.35, 0.5)
        back = (out, back[0])
    ends = [turn_key(back[-1].time, 0.7)] if back else []
    nod = turn_key(there, takes * 0.7, rng.uniform(-6, 6), rng.uniform(4, 16), rng.uniform(-2, 4))
    return Script(seconds, left=(via, nape.key(there, 0.5 * takes, 1.2, rub), *back), head=(nod, *ends))


def point(rng: np.random.Generator) -> Script:
    """Script a pointing gesture: the stretched arm rises to a goal ahead or aside, and the head looks there."""
    begins, takes, stays = ONSET, rng.uniform(0.55, 0.65), rng.uniform(1.8, 4.5)
    azimuth, elevation = np.radians(rng.uniform(-15, 45)), np.radians(rng.uniform(-8, 18))
    length, there = 0.466 * rng.uniform(0.955, 0.985), begins + takes
    x, y = length * np.sin(azimuth) * np.cos(elevation), length * np.sin(elevation)
    goal = (float(x), float(y), float(length * np.cos(azimuth) * np.cos(elevation)))
    shrug = rng.uniform(0, 6)
    spot = Spot(goal, goal, "shoulder", ((0.5, -1, -0.2), (0.5, -1, -0.2)), (shrug, shrug))
    back, seconds = _end(rng, there + stays, 0.6)
    share = rng.uniform(0.3, 0.9) * np.degrees(azimuth)
    look = [turn_key(there - rng.uniform(0.0, 0.2), takes * 0.8, float(share), -float(np.degrees(elevation)) * 0.4)]
    look += [turn_key(back[0].time, 0.6)] if back else []
    twist = [turn_key(there, takes, float(rng.uniform(-6, 2)))] + ([turn_key(back[0].time, 0.7)] if back else [])
    key = spot.key(there, takes, rng.uniform(1.2, 1.7), roundness=0.7)
    return Script(seconds, left=(key, *back), head=tuple(look), trunk=tuple(twist))


def raise_arm(rng: np.random.Generator) -> Script:
    """Script a raised arm: it rises ahead or aside, nearly stretched, stays above the shoulder, and comes down."""
    begins, takes, stays = ONSET, rng.uniform(0.8, 1.1), rng.uniform(0.8, 5.0)
    azimuth, elevation = np.radians(rng.uniform(-10, 60)), np.radians(rng.uniform(55, 84))
    length, there = 0.466 * rng.uniform(0.93, 0.985), begins + takes
    level = length * np.cos(elevation)
    goal = (float(level * np.sin(azimuth)), float(length * np.sin(elevation)), float(level * np.cos(azimuth)))
    shrug = rng.uniform(8, 18)
    spot = Spot(goal, goal, "shoulder", ((1, -0.4, 0.2), (1, -0.4, 0.2)), (shrug, shrug))
    back, seconds = _end(rng, there + stays, 0.8)
    drift = Oscillation(0.4, (0.003, 0.002, 0.003), (0.002, 0, 0.003))
    return Script(seconds, left=(spot.key(there, takes, rng.uniform(1.1, 1.4), drift, roundness=0.9), *back))


def wipe(rng: np.random.Generator) -> Script:
    """Script wiping of a table or a pane, to and fro or in circles."""
    begins, takes, hertz = ONSET, 0.7, WIPING
    there, table = begins + takes, rng.uniform() < 0.5
    wide, narrow = rng.uniform(0.075, 0.105), rng.uniform(0.01, 0.05)
    around = Oscillation(hertz, (wide, 0.0, 0.0), (0.0, 0.25 * narrow, narrow) if table else (0.0, narrow, 0.0))
    back, seconds = _end(rng, there + rng.uniform(4.8, 5.6), 0.0)
    spot = (TABLE if table else PANE).draw(rng)
    pitch, nod = (rng.uniform(10, 18), rng.uniform(6, 14)) if table else (rng.uniform(0, 5), 0.0)
    ends = [turn_key(back[0].time, 0.8)] if back else []
    return Script(
        seconds,
        left=(spot.key(there, takes, 1.3, around), *back),
        head=(turn_key(there, takes, float(rng.uniform(-4, 6)), nod), *ends),
        trunk=(turn_key(there, takes, -4, pitch), *ends),
        tremor=(0.0012, 0.0020),
    )


def look(rng: np.random.Generator) -> Script:
    """Script a look: the head turns left, the chest slightly with it, and stays for a while."""
    begins, takes, yaw = ONSET, rng.uniform(0.5, 0.6), rng.uniform(50, 72)
    there, stays, pitch = begins + takes, rng.uniform(1.0, 4.5), rng.uniform(-6, 8)
    keys, chest = [turn_key(there, takes, 0.82 * yaw, pitch, skew=1.35)], [turn_key(there + 0.1, takes, 0.18 * yaw)]
    if rng.uniform() < 0.4:
        keys.append(
            turn_key(there + 0.5 * stays + 0.4, 0.4, 0.82 * yaw + rng.uniform(-12, 8), pitch + rng.uniform(-8, 8))
        )
    leaves, back = max(there + stays, keys[-1].time + 0.3), rng.uniform(0.45, 0.8)
    if rng.uniform() < 0.6:
        keys.append(turn_key(leaves + back, back))
        chest.append(turn_key(leaves + back + 0.1, back))
    seconds = max(3.5, leaves + back + rng.uniform(0.5, 1.2))
    return Script(seconds, head=tuple(keys), trunk=tuple(chest))


def applause(rng: np.random.Generator) -> Script:
    """Script clapping in front of the chest."""
    begins, takes, hertz = ONSET, 0.6, CLAPPING
    there, wide, lead = begins + takes, rng.uniform(0.044, 0.052), rng.uniform(0.004, 0.02)
    back, seconds = _end(rng, there + rng.uniform(4.8, 5.6), 0.0)
    spot = CLAP.draw(rng)
    hands = []
    for up in (lead, -lead):
        goal = (spot.low[0], spot.low[1] + up, spot.low[2])
        clap = Oscillation(hertz, (wide, 0.4 * up, -0.008))
        hands.append((Spot(goal, goal, pole=spot.pole).key(there, takes, 1.3, clap), *back))
    nod = turn_key(there, takes, float(rng.uniform(-8, 8)), float(rng.uniform(-3, 6)))
    return Script(seconds, left=hands[0], right=hands[1], head=(nod,))


def guitar(rng: np.random.Generator) -> Script:
    """Script guitar playing: the right hand strums, the left one moves on the neck every two strums."""
    begins, takes, hertz = ONSET, 0.7, STRUMMING
    there, neck = begins + takes, NECK.draw(rng)
    back, seconds = _end(rng, there + rng.uniform(4.8, 5.6), 0.0)
    strum = Oscillation(hertz, (0.0, rng.uniform(0.05, 0.065), 0.012), (0.012, 0.0, 0.0))
    left, change, inner = [neck.key(there, takes)], there, False
    last = back[0].time - 1.2 if back else seconds - 0.3
    while (change := change + 2 / hertz) < last:
        inner = not inner
        x, y, z = neck.low
        goal = (x - 0.09 * inner, y - 0.03 * inner, z)
        left.append(Spot(goal, goal, pole=neck.pole).key(change, 0.3))
    head = turn_key(there, takes, float(rng.uniform(2, 14)), float(rng.uniform(10, 20)))
    ends = (turn_key(back[0].time, 0.7),) if back else ()
    right = (STRINGS.draw(rng).key(there, takes, 1.25, strum), *back)
    return Script(seconds, left=(*left, *back), right=right, head=(head, *ends))


def violin(rng: np.random.Generator) -> Script:
    """Script violin playing: the left hand holds the neck, the right one bows, the head leans on the chin rest."""
    begins, takes, hertz = ONSET, 0.8, BOWING
    there, size = begins + takes, rng.uniform(0.12, 0.16)
    back, seconds = _end(rng, there + rng.uniform(4.8, 5.6), 0.0)
    bow = Oscillation(hertz, (0.8 * size, -0.15 * size, 0.45 * size), (0.0, 0.008, 0.0))
    vibrato = Oscillation(hertz, (0.006, 0.0, 0.004))
    head = turn_key(there, takes, float(rng.uniform(12, 22)), float(rng.uniform(6, 12)), float(rng.uniform(10, 18)))
    ends = (turn_key(back[0].time, 0.7),) if back else ()
    left = (SCROLL.draw(rng).key(there, takes, 1.2, vibrato), *back)
    right = (BOW.draw(rng).key(there, takes, 1.2, bow), *back)
    return Script(seconds, left=left, right=right, head=(head, *ends), tremor=(0.0008, 0.0014))


GOES_ON = ("wipe-left", "applause", "guitar", "violin", "box")
"""Actions that any part of a clip shows."""
INSTRUMENTS = ("guitar", "violin")
"""Actions of which the mirror image is no clip: the left hand holds the neck."""


def _recipe(
    action: str,
    script: Callable[[np.random.Generator], Script],
    accept: Callable[[Motion], bool],
    kinds: dict[Kind, float] = STANDING,
    clips: int = 70,
) -> Recipe:
    make = _Gesture(script, kinds)
    return Recipe(action, "authored", make, accept, clips, action not in GOES_ON, action not in INSTRUMENTS)


RECIPES: tuple[Recipe, ...] = (
    _recipe("punch-left", punch, gates.punches),
    _recipe("box", box, gates.boxes),
    _recipe("throw-left", throw, gates.throws),
    _recipe("pick-up-left", pick_up, gates.picks_up),
    _recipe("point-left", point, gates.points, ANYWHERE),
    _recipe("raise-up-left-hand", raise_arm, gates.raises, ANYWHERE, clips=80),
    _recipe("wipe-left", wipe, gates.wipes, ON_FEET),
    _recipe("eat-left", eat, gates.eats, ANYWHERE),
    _recipe("drink-left", drink, gates.drinks, ANYWHERE),
    _recipe("phone-left", phone, gates.phones, ANYWHERE),
    _recipe("touch-head-left", touch_head, gates.touches_head, ANYWHERE),
    _recipe("look-left", look, gates.looks, ANYWHERE),
    _recipe("applause", applause, gates.claps, STANDING_OR_SEATED),
    _recipe("guitar", guitar, gates.plays_guitar, STANDING_OR_SEATED),
    _recipe("violin", violin, gates.plays_violin, STANDING_OR_SEATED),
    _recipe("golf", golf, gates.swings_club),
    _recipe("dodge", dodge, gates.dodges),
)
"""One recipe per action; right forms are the mirror images."""
