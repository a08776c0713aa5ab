"""Answer files from raters, which are untrusted and checked against the key.

This module knows the format of answers; `analysis` interprets them.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stmc.evaluation.study.key import Aspect, Entry, Key
from stmc.io.untrusted import UnreadableError, load_json, quote, read_text

FORMAT = "stmc study answers 1"
NO_PREFERENCE = "none"
MOST_BYTES = 2**20
"""Maximum size of an answer file; a page writes a few kilobytes."""
_RATER = re.compile(r"[0-9a-f]{16}")
_KEYS = ("format", "survey", "rater", "answers")


class AnswersError(ValueError):
    """Error for a file that no page of the study wrote, or that was changed; the message names file and key."""


@dataclass(frozen=True)
class Answers:
    """One rater's answers to one survey: the chosen clip's id, or `NO_PREFERENCE`, by question and aspect."""

    source: str
    survey: str
    rater: str
    choices: Mapping[str, Mapping[Aspect, str]]


def read_answers(paths: Iterable[str | Path], key: Key) -> list[Answers]:
    """Read answer files in the order of their names.

    Raises `AnswersError` for a file that does not answer all questions of a survey of the key, and for two files of one
    rater and survey, with both names.
    """
    found: dict[tuple[str, str], Answers] = {}
    for path in sorted(map(Path, paths)):
        try:
            answers = _answers(path, key)
        except AnswersError as error:
            raise AnswersError(f"{path}: {error}") from None
        other = found.setdefault((answers.survey, answers.rater), answers)
        if other is not answers:
            raise AnswersError(f"{path}: the same rater's answers to the same survey are in {other.source}; keep one")
    return list(found.values())


def _answers(path: Path, key: Key) -> Answers:
    data = _expect(_json(path), "the document")
    _same(data, _KEYS, "the document")
    if data["format"] != FORMAT:
        raise AnswersError(f"format: {quote(data['format'])} is not {FORMAT!r}")
    rater, survey = data["rater"], data["survey"]
    if not isinstance(rater, str) or not _RATER.fullmatch(rater):
        raise AnswersError(f"rater: {quote(rater)} is not the code of 16 hexadecimal digits that a page gives")
    if not isinstance(survey, str) or survey not in key.surveys:
        raise AnswersError(f"survey: {quote(survey)} is none of the {len(key.surveys)} surveys of this key")
    entries = key.surveys[survey]
    given = _expect(data["answers"], "answers")
    _same(given, tuple(entries), "answers")
    choices = {question: _choices(given[question], entry, question) for question, entry in entries.items()}
    return Answers(str(path), survey, rater, choices)


def _choices(data: Any, entry: Entry, question: str) -> dict[Aspect, str]:
    place = f"answers.{question}"
    _same(_expect(data, place), tuple(aspect.value for aspect in Aspect), place)
    legal = (*entry.sides, NO_PREFERENCE)
    for aspect, choice in data.items():
        if choice not in legal:
            raise AnswersError(f"{place}.{aspect}: {quote(choice)} is neither of the two motions nor {NO_PREFERENCE!r}")
    return {aspect: data[aspect] for aspect in Aspect}


def _json(path: Path) -> Any:
    try:
        return load_json(read_text(path, MOST_BYTES))
    except OSError as error:
        raise AnswersError(f"cannot be read ({error.strerror})") from None
    except UnreadableError as error:
        raise AnswersError(str(error)) from None


def _expect(data: Any, place: str) -> dict[str, Any]:
    if not isinstance(data, dict):
        raise AnswersError(f"{place}: {quote(data)} is not an object")
    return data


def _same(data: Mapping[str, Any], keys: tuple[str, ...], place: str) -> None:
    if missing := [key for key in keys if key not in data]:
        raise AnswersError(
            f"{place}: {missing[0]!r} is missing" + (f", and {len(missing) - 1} more" * (len(missing) > 1))
        )
    if unknown := [key for key in data if key not in keys]:
        raise AnswersError(f"{place}: {quote(unknown[0])} does not belong there")
