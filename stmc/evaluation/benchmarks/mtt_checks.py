"""One geometric check for each of MTT's 60 texts (STMC, section 4.1), without a learned evaluator or a text encoder.

Checks are written for the left side; a right check is the left check of the mirror image, so that both are equally
strict. `confusions` and docs/evaluation.md report how often motions of the text and of other texts pass.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

from stmc.evaluation.benchmarks import mtt_arms as arms
from stmc.evaluation.benchmarks import mtt_legs as legs
from stmc.evaluation.benchmarks.questions import Question
from stmc.motion.motion import Motion

_OTHER = {"left": "right", "clockwise": "counterclockwise"}
_OTHER |= {value: key for key, value in _OTHER.items()}


@dataclass(frozen=True)
class Check:
    """A check of a text.

    Args:
        shows: Function that returns whether a motion shows the text.
        actions: Actions of the data whose clips show the text.
        meant: Texts whose motions also show the text, because they are more specific: a slow walk is a walk.
    """

    shows: Question
    actions: tuple[str, ...]
    meant: tuple[str, ...] = ()


def mirror_words(words: str) -> str:
    """Return the text of the mirror image, with left and right, clockwise and counterclockwise exchanged."""
    return re.sub(r"counterclockwise|clockwise|left|right", lambda match: _OTHER[match.group()], words)


def _mirror(check: Check) -> Check:
    return Check(
        lambda motion: check.shows(motion.mirrored()),
        tuple(map(mirror_words, check.actions)),
        tuple(map(mirror_words, check.meant)),
    )


def _both(question: Question) -> Question:
    return lambda motion: question(motion) and question(motion.mirrored())


def _either(question: Question) -> Question:
    return lambda motion: question(motion) or question(motion.mirrored())


_SIDED = {
    "walk in a circle counterclockwise": Check(legs.circles, ("walk-circle-left",)),
    "walk in a quarter circle to the left": Check(
        legs.quarter_circle, ("quarter-circle-left", "walk-turn-left"), ("turn left",)
    ),
    "turn 180 degrees to the left on the left foot": Check(
        lambda motion: legs.half_turn(motion, "left"), ("half-turn-left-on-left-foot",)
    ),
    "turn 180 degrees to the left on the right foot": Check(
        lambda motion: legs.half_turn(motion, "right"), ("half-turn-left-on-right-foot",)
    ),
    "turn left": Check(
        lambda motion: legs.turns(motion, 45, 145), ("walk-turn-left",), ("walk in a quarter circle to the left",)
    ),
    "low kick with the left foot": Check(legs.kicks_low, ("low-kick-left",)),
    "high kick with the left foot": Check(legs.kicks_high, ("high-kick-left",)),
    "raise the left arm": Check(arms.raises, ("raise-up-left-hand",), ("raise both arms in the air",)),
    "wave with the left hand": Check(arms.waves, ("wave-left-hand",), ("wave with both hands",)),
    "talk on phone with left hand": Check(arms.phones, ("phone-left",)),
    "point with his left hand": Check(arms.points, ("point-left",)),
    "drink with the left arm": Check(arms.drinks, ("drink-left",)),
    "eat something with the left arm": Check(arms.eats, ("eat-left",)),
    "look left": Check(arms.looks, ("look-left",)),
    "throw something with left hand": Check(arms.throws, ("throw-left",)),
    "pick something with the left hand": Check(arms.picks_up, ("pick-up-left",)),
    "punch with the left hand": Check(arms.punches, ("punch-left",)),
    "hop to the left": Check(lambda motion: legs.jumps_to(motion, "left"), ("hop-left",)),
    "touches back of head with left hand": Check(arms.touches_back_of_head, ("touch-head-left",)),
    "wipe with the left hand": Check(arms.wipes, ("wipe-left",)),
}

_SYMMETRIC = {
    "walk forwards": Check(
        lambda motion: legs.walks(motion, 0.3, 2.1), ("walk",), ("slowly walk forwards", "quickly walk forwards")
    ),
    "walk backwards": Check(
        lambda motion: legs.walks(motion, -1.6, -0.2),
        ("walk-back",),
        ("slowly walk backwards", "quickly walk backwards"),
    ),
    "slowly walk forwards": Check(lambda motion: legs.walks(motion, 0.15, 0.9), ("walk-slow",)),
    "slowly walk backwards": Check(lambda motion: legs.walks(motion, -0.46, -0.12), ("walk-back-slow",)),
    "quickly walk forwards": Check(lambda motion: legs.walks(motion, 1.5, 2.4), ("walk-fast",)),
    "quickly walk backwards": Check(lambda motion: legs.walks(motion, -2.0, -1.05), ("walk-back-fast",)),
    "run": Check(lambda motion: legs.jogs(motion, 1.5, 9.0), ("run",), ("jogs forwards",)),
    "jogs forwards": Check(lambda motion: legs.jogs(motion, 1.3, 9.0), ("run",), ("run",)),
    "jogs backwards": Check(lambda motion: legs.jogs(motion, -3.5, -0.7), ("jog-back",)),
    "perform a squat": Check(lambda motion: legs.squats(motion) and not _either(arms.picks_up)(motion), ("squat",)),
    "sit down": Check(legs.sits_down, ("sit-down",)),
    "applause": Check(arms.claps, ("applause",)),
    "play the guitar": Check(arms.plays_guitar, ("guitar",)),
    "play the violin": Check(arms.plays_violin, ("violin",)),
    "raise both arms in the air": Check(_both(arms.raises), ("raise-up-both-hands",)),
    "wave with both hands": Check(_both(arms.waves), ("wave-both-hands",)),
    "dodge a hit to his head": Check(legs.dodges, ("dodge",)),
    "bow": Check(lambda motion: legs.bows(motion) and not legs.golfs(motion), ("bow",)),
    "jump forward": Check(lambda motion: legs.jumps_to(motion, "forward"), ("jump-forward",)),
    "jump backward": Check(lambda motion: legs.jumps_to(motion, "backward"), ("jump-back",)),
    "play golf": Check(legs.golfs, ("golf",)),
    "jumping jacks": Check(legs.jumping_jacks, ("jumping-jack",)),
}

MTT_CHECKS: Mapping[str, Check] = MappingProxyType({
    **_SYMMETRIC,
    **_SIDED,
    **{mirror_words(text): _mirror(check) for text, check in _SIDED.items() if "180" not in text},
})  # fmt: skip
"""Checks by MTT's text."""


def same_meaning(text: str) -> frozenset[str]:
    """Return a text, and the texts whose checks its motions may pass because it implies them."""
    return frozenset({text} | {other for other, check in MTT_CHECKS.items() if text in check.meant})


def confusions(motions: Mapping[str, Sequence[Motion]]) -> dict[str, dict[str, float]]:
    """Return the fractions of the motions of each text (inner keys) that pass the check of each text (outer keys)."""
    answers: dict[str, dict[str, float]] = {text: {} for text in MTT_CHECKS}
    for shown, samples in motions.items():
        for text, check in MTT_CHECKS.items():
            answers[text][shown] = sum(check.shows(motion) for motion in samples) / len(samples)
    return answers
