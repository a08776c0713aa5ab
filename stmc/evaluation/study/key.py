"""The answer key of a study: what each question asked in truth, and which method stood behind which opaque id.

Raters never get it: it is a file of its own, for the analysis.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

from stmc.io.files import write_text

FORMAT = "stmc study key 1"


class StudyError(ValueError):
    """A study that cannot be made or read; the message names the file or the number and what would be right."""


class Aspect(StrEnum):
    """What a rater is asked of each two motions: which is more realistic, which follows the timeline better."""

    REALISM = "realism"
    TIMELINE = "timeline"


class Kind(StrEnum):
    """What a question is for. Of a warm-up nothing is counted; a honeypot has one right answer, in one aspect."""

    PAIR = "pair"
    WARM_UP = "warm-up"
    REALISM_HONEYPOT = "realism honeypot"
    TIMELINE_HONEYPOT = "timeline honeypot"

    @property
    def tests(self) -> Aspect | None:
        """The aspect in which a honeypot has a right answer; None for what is no honeypot."""
        return {Kind.REALISM_HONEYPOT: Aspect.REALISM, Kind.TIMELINE_HONEYPOT: Aspect.TIMELINE}.get(self)


RIGHT, WRONG = "right", "wrong"
"""What stands for a method behind the two sides of a honeypot."""


@dataclass(frozen=True)
class Entry:
    """One question: its kind, the name of its pair, and what each clip's id stands for: a method, or right or wrong."""

    kind: Kind
    pair: str
    sides: Mapping[str, str]


@dataclass(frozen=True)
class Key:
    """The two methods' names, the first being the one under study, and every survey's questions by their ids."""

    methods: tuple[str, str]
    surveys: Mapping[str, Mapping[str, Entry]]

    def write(self, path: str | Path) -> None:
        """As JSON; the file appears whole or not at all."""
        surveys = {
            survey: {
                question: {"kind": entry.kind, "pair": entry.pair, "sides": dict(entry.sides)}
                for question, entry in entries.items()
            }
            for survey, entries in self.surveys.items()
        }
        content = json.dumps({"format": FORMAT, "methods": self.methods, "surveys": surveys}, indent=1) + "\n"
        write_text(Path(path), content)

    @classmethod
    def read(cls, path: str | Path) -> Key:
        """What `write` wrote. Raises `StudyError` naming the file for anything else."""
        try:
            data = json.loads(Path(path).read_text(encoding="utf-8"))
            if data["format"] != FORMAT:
                raise StudyError(f"{path}: the format is {data['format']!r}, not {FORMAT!r}")
            first, second = data["methods"]
            surveys = {
                survey: {question: _entry(entry, (first, second)) for question, entry in entries.items()}
                for survey, entries in data["surveys"].items()
            }
        except StudyError:
            raise
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
            raise StudyError(f"{path} is not an answer key as the study's script writes it ({error!r})") from None
        return cls((first, second), surveys)


def _entry(data: Mapping[str, Any], methods: tuple[str, str]) -> Entry:
    kind = Kind(data["kind"])
    behind = methods if kind.tests is None else (RIGHT, WRONG)
    if sorted(data["sides"].values()) != sorted(behind):
        raise ValueError(f"the sides are {data['sides']}, not {' and '.join(behind)}")
    return Entry(kind, data["pair"], data["sides"])
