"""Calibrations as JSON files, one line per measured sentence.

Files are untrusted: their size is limited, and all values are checked.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from stmc.io.files import write_text
from stmc.io.untrusted import UnreadableError, load_json, quote, read_text, truncate
from stmc.text.vocabulary.calibration import Calibration, Trial
from stmc.text.vocabulary.sentences import LONGEST_TEXT
from stmc.text.vocabulary.vocabulary_files import LONGEST_NAME, MOST_SENTENCES, VocabularyError, check_text

MOST_BYTES = 8 * 2**20
"""Size limit of a file; that of the bundled model's actions takes 0.05 MiB."""

_KEYS = tuple(field.name for field in fields(Calibration))
_TRIAL = tuple(field.name for field in fields(Trial))
_WHOLE = {"samples": (1, 10**6), "steps": (1, 10**6), "seed": (0, 2**63)}
_SHARES = {"geometry": (0, 1), "evaluator": (0, 1), "guidance": (0, 1000)}
"""Limits of each number; those of `_SHARES` may be null."""


def write_calibration(calibration: Calibration, path: Path) -> None:
    """Write a calibration to a file, which is complete or absent."""
    rows = [f"  {_json(text)}: {_json(asdict(trial))}" for text, trial in sorted(calibration.trials.items())]
    trials = "{\n" + ",\n".join(rows) + "\n }" if rows else "{}"
    others = {key: getattr(calibration, key) for key in _KEYS if key != "trials"}
    lines = [*(f" {_json(key)}: {_json(value)}" for key, value in others.items()), f' "trials": {trials}']
    write_text(path, "{\n" + ",\n".join(lines) + "\n}\n")


def read_calibration(path: Path) -> Calibration:
    """Read a file of `write_calibration`. Raises `VocabularyError` for any other file."""
    try:
        return _calibration(load_json(read_text(path, MOST_BYTES)))
    except (VocabularyError, UnreadableError, OSError) as error:
        raise VocabularyError(f"{path} cannot be read: {truncate(' '.join(str(error).split()), 200)}") from error


def _calibration(table: Any) -> Calibration:
    _check_keys(table, _KEYS, "a calibration")
    if not isinstance(table["weights"], str) or not re.fullmatch(r"[0-9a-f]{64}|", table["weights"]):
        raise VocabularyError(f"weights={quote(table['weights'])}: must be a SHA-256 of 64 hexadecimal digits")
    for key in ("trials", "thresholds"):
        if not isinstance(table[key], Mapping) or len(table[key]) > MOST_SENTENCES:
            raise VocabularyError(f"{key}: must be an object of at most {MOST_SENTENCES} entries")
    if table["threshold"] is not None:
        _check_number(table["threshold"], "threshold", -3, 3)
    for name, threshold in table["thresholds"].items():
        check_text(name, LONGEST_NAME)
        _check_number(threshold, f"threshold of {quote(name)}", -3, 3)
    trials = {text: _trial(text, row) for text, row in table["trials"].items()}
    return Calibration(trials, table["threshold"], table["thresholds"], table["weights"])


def _trial(text: str, row: Any) -> Trial:
    check_text(text, LONGEST_TEXT)
    _check_keys(row, _TRIAL, quote(text))
    check_text(row["action"], LONGEST_NAME)
    for key, (least, most) in _WHOLE.items():
        _check_number(row[key], f"{quote(text)}: {key}", least, most, whole=True)
    for key, (least, most) in _SHARES.items():
        if row[key] is not None:
            _check_number(row[key], f"{quote(text)}: {key}", least, most)
    return Trial(**row)


def _check_keys(table: Any, keys: tuple[str, ...], name: str) -> None:
    if not isinstance(table, Mapping) or set(table) != set(keys):
        raise VocabularyError(f"{name}: must be an object of {', '.join(keys)}, not {quote(table)}")


def _check_number(value: Any, name: str, least: int, most: int, whole: bool = False) -> None:
    kinds = int if whole else (int, float)
    if isinstance(value, bool) or not isinstance(value, kinds) or not least <= value <= most:
        raise VocabularyError(
            f"{name}={quote(value)}: must be a {'whole ' if whole else ''}number from {least} to {most}"
        )


def _json(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False)
