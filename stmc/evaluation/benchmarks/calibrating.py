"""Calibrate the thresholds of the recogniser of prompts, and measure how well it then warns.

The data are the measured success of prompts, known prompts and unknown prompts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

from stmc.evaluation.benchmarks.mtt_checks import MTT_CHECKS
from stmc.io.untrusted import UnreadableError, load_json, quote, read_text
from stmc.text.vocabulary import RARELY, SHOWN_RATE, Calibration, Recognition

MOST_LOST = 0.05
"""The maximum fraction of known prompts that may warn."""
ENOUGH = 8
"""The number of known and of unknown prompts that an action needs for a threshold of its own."""
_MOST_BYTES = 2**22


@dataclass(frozen=True)
class Rates:
    """How well a model warns.

    Args:
        missed: Number of texts of MTT that the model rarely shows and that do not warn.
        asked: Number of texts of MTT with measured success.
        known: Fraction of known prompts that warn; None without any.
        unknown: Fraction of unknown prompts that warn; None without any.
    """

    missed: int
    asked: int
    known: float | None
    unknown: float | None

    def __str__(self) -> str:
        known, unknown = ("?" if share is None else f"{share:.1%}" for share in (self.known, self.unknown))
        return (
            f"missed without a warning: {self.missed} of {self.asked} texts of MTT; "
            f"known prompts that warn: {known}; unknown prompts that warn: {unknown}"
        )


def read_prompts(path: str | Path) -> tuple[dict[str, str], list[str]]:
    """Read known prompts, each with its action, and unknown prompts, which describe no action of the model.

    The file is `{"inside": [[action, text]], "outside": [text], "unusual": [text]}`; "unusual" is optional. Raises
    `ValueError` for any other file.
    """
    try:
        table = load_json(read_text(Path(path), _MOST_BYTES))
    except UnreadableError as error:
        raise ValueError(f"{path}: {error}") from error
    if not isinstance(table, Mapping) or not {"inside", "outside"} <= set(table):
        raise ValueError(f"{path}: an object with inside and outside needed, not {quote(table)}")
    inside, outside = table["inside"], [table["outside"], table.get("unusual", [])]
    if not isinstance(inside, list) or not all(_are_texts(row) and len(row) == 2 for row in inside):
        raise ValueError(f"{path}: inside: a list of [action, text] needed, not {quote(inside)}")
    if wrong := [texts for texts in outside if not _are_texts(texts)]:
        raise ValueError(f"{path}: outside and unusual: lists of texts needed, not {quote(wrong[0])}")
    return {text: action for action, text in inside}, [text for texts in outside for text in texts]


def calibrate_thresholds(
    calibration: Calibration, known: Mapping[str, str], unknown: Sequence[str], found: Mapping[str, Recognition]
) -> Calibration:
    """Choose the threshold below which most unknown prompts and at most `MOST_LOST` of the known prompts lie.

    An action with `ENOUGH` prompts of both kinds gets a threshold of its own.

    Args:
        calibration: What was measured; known prompts of actions that work rarely, which warn rightly, do not count.
        known: Prompts and their actions.
        unknown: Prompts about no action of the model.
        found: The recognition of each prompt.
    """
    working = [found[text] for text in working_prompts(calibration, known)]
    others = [found[text] for text in unknown]
    thresholds = {}
    for action in {each.action for each in others}:
        own = [[each.score for each in several if each.action == action] for several in (working, others)]
        if min(map(len, own)) >= ENOUGH:
            thresholds[action] = threshold_between(*own)
    scores = [[each.score for each in several] for several in (working, others)]
    common = threshold_between(*scores) if all(scores) else calibration.threshold
    return replace(calibration, threshold=common, thresholds=dict(sorted(thresholds.items())))


def threshold_between(known: Sequence[float], unknown: Sequence[float]) -> float:
    """Return the threshold that maximises the fraction of unknown scores below it minus that of known ones.

    At most `MOST_LOST` of the known scores lie below it. Ties give the lowest; rounded to thousandths.
    """
    scores = sorted({*known, *unknown})
    candidates = [scores[0], *((low + high) / 2 for low, high in pairwise(scores))]

    def gain(threshold: float) -> tuple[float, float]:
        lost, caught = (sum(score < threshold for score in several) / len(several) for several in (known, unknown))
        return (caught - lost if lost <= MOST_LOST else -1.0, -threshold)

    best = max(candidates, key=gain)
    return round(best, 3)


def rates_of_warnings(
    calibration: Calibration, known: Mapping[str, str], unknown: Sequence[str], found: Mapping[str, Recognition]
) -> Rates:
    """Count warnings: for texts of MTT with measured success, known prompts of working actions, and unknown prompts.

    The arguments are those of `calibrate_thresholds`.
    """
    warns = {
        text: not replace(each, threshold=calibration.threshold_of(each.action, each.threshold)).works
        for text, each in found.items()
    }
    asked = [text for text in MTT_CHECKS if text in calibration.trials]
    missed = [text for text in asked if (calibration.trials[text].rate or 0.0) < SHOWN_RATE and not warns[text]]
    working = working_prompts(calibration, known)
    shares = [sum(map(warns.__getitem__, texts)) / len(texts) if texts else None for texts in (working, unknown)]
    return Rates(len(missed), len(asked), *shares)


def working_prompts(calibration: Calibration, known: Mapping[str, str]) -> list[str]:
    """Return the known prompts, except those whose samples, or whose action's, were measured to show it rarely."""
    rates = {text: calibration.rate(text, action) for text, action in known.items()}
    return [text for text, rate in rates.items() if rate is None or rate >= RARELY]


def _are_texts(values: object) -> bool:
    return isinstance(values, list) and all(isinstance(value, str) for value in values)
