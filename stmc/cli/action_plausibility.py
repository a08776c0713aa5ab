"""How plausible the samples of `stmc actions` are: their feet, hands and energy, and their rest after an action."""

from __future__ import annotations

import math
import random
from collections.abc import Mapping, Sequence
from statistics import fmean, median

from stmc.evaluation.metrics.liveliness import lower_toe_height, motion_energy, rest_energy
from stmc.motion.kinematics import foot_sliding, hand_step
from stmc.motion.motion import Motion

STANDING = ("stand", "idle")
"""Contents whose recordings are the reference of samples that have finished a one-shot action."""
LIVELY = 2.0
"""Energies of samples that differ from those of recordings by a larger factor are reported."""
DRAWS = 200
"""Number of draws of `share_lively`."""
FROZEN = 0.1
"""Share of the recordings' median energy below which a sample has frozen: less than a third of their speed."""


def has_frozen(motion: Motion, energy: float) -> bool:
    """Return whether a motion has frozen; the evaluator may still find a pose of its action.

    `energy` is the median energy of recordings of the action, in m²/s².
    """
    return motion_energy(motion) < FROZEN * energy


def is_lively(ratio: float) -> bool:
    """Return whether an energy is within a factor of `LIVELY` of that of recordings."""
    return 1 / LIVELY <= ratio <= LIVELY


def share_lively(recordings: Sequence[Motion], count: int) -> float | None:
    """Return how often the median energy of `count` recordings is within a factor of `LIVELY` of that of all.

    This is what samples could reach. The recordings are drawn with replacement, with seed 0. None if they are still.
    """
    energies, rng = [motion_energy(motion) for motion in recordings], random.Random(0)
    if not (whole := median(energies)):
        return None
    return fmean(is_lively(median(rng.choices(energies, k=count)) / whole) for _ in range(DRAWS))


def measure_plausibility(motions: Sequence[Motion]) -> dict[str, float | None]:
    """Measure foot sliding (mean) and hand steps (maximum) in centimetres, and medians of life; see `liveliness`."""
    slides = [100 * foot_sliding(motion) for motion in motions]
    stands = [slide for slide in slides if not math.isnan(slide)]
    return {
        "sliding_cm": fmean(stands) if stands else None,
        "hand_step_cm": max(100 * hand_step(motion) for motion in motions),
        "energy": median(map(motion_energy, motions)),
        "rest_energy": median(map(rest_energy, motions)),
        "lower_toe_cm": median(100 * lower_toe_height(motion) for motion in motions),
    }


def split_rest(
    motions: Mapping[str, Sequence[Motion]], after: float | int
) -> tuple[Mapping[str, Sequence[Motion]], list[Motion]]:
    """Split motions into the action, by sentence, and the seconds `after` it, of all sentences."""
    if not after:
        return motions, []
    frames = {text: [motion.frames - round(after * motion.fps) for motion in each] for text, each in motions.items()}
    pairs = {text: list(zip(each, frames[text], strict=True)) for text, each in motions.items()}
    actions = {text: [motion.trimmed(0, end) for motion, end in each] for text, each in pairs.items()}
    return actions, [motion.trimmed(end, motion.frames) for each in pairs.values() for motion, end in each]


def measure_rest(rests: Sequence[Motion], real: Mapping[str, Sequence[Motion]]) -> dict[str, float | None]:
    """Measure the energy after one-shot actions as a share of that of recordings of standing people."""
    standing = [motion_energy(motion) for name in STANDING for motion in real.get(name, ())]
    reference = median(standing) if standing else 0.0
    return {"after": median(map(motion_energy, rests)) / reference if rests and reference else None}
