"""The answer key of a study: the kind of each question, and the method behind each opaque id.

The key is a separate file for the analysis; raters never see it.
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
    """Error for a study that cannot be made or read; the message names the file or the number and a remedy."""


class Aspect(StrEnum):
    """The two questions about a pair: which motion is more realistic, and which follows the timeline better."""

    REALISM = "realism"
    TIMELINE = "timeline"


class Kind(StrEnum):
    """Purpose of a question. Warm-ups do not count; a honeypot has one right answer, in one aspect."""

    PAIR = "pair"
    WARM_UP = "warm-up"
    REALISM_HONEYPOT = "realism honeypot"
    TIMELINE_HONEYPOT = "timeline honeypot"

    @property
    def tests(self) -> Aspect | None:
        """The aspect in which a honeypot has a right answer; None for other kinds."""
        return {Kind.REALISM_HONEYPOT: Aspect.REALISM, Kind.TIMELINE_HONEYPOT: Aspect.TIMELINE}.get(self)


RIGHT, WRONG = "right", "wrong"
"""Names of the two sides of a honeypot, in place of methods."""


@dataclass(frozen=True)
class Entry:
    """One question: its kind, the name of its pair, and the method (or right or wrong) of each clip by its id."""

    kind: Kind
    pair: str
    sides: Mapping[str, str]


@dataclass(frozen=True)
class Key:
    """Names of the two methods, the one under study first, and the questions of every survey by their ids."""

    methods: tuple[str, str]
    surveys: Mapping[str, Mapping[str, Entry]]

    def write(self, path: str | Path) -> None:
        """Write the key as JSON; the file is written atomically."""
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
        """Read a file of `write`. Raises `StudyError`, which names the file, for any other content."""
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
            raise StudyError(f"{path} is not an answer key of `stmc study` ({error!r})") from None
        return cls((first, second), surveys)


def _entry(data: Mapping[str, Any], methods: tuple[str, str]) -> Entry:
    kind = Kind(data["kind"])
    behind = methods if kind.tests is None else (RIGHT, WRONG)
    if sorted(data["sides"].values()) != sorted(behind):
        raise ValueError(f"the sides are {data['sides']}, not {' and '.join(behind)}")
    return Entry(kind, data["pair"], data["sides"])
