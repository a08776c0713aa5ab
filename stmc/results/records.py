"""One record per run of an experiment, and the file of many: JSON, a record a line. Knows no table and no chart."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from stmc.files import write_whole


class ResultError(ValueError):
    """A record that cannot be meant; the message names the file, the line and the key."""


class Setting(NamedTuple):
    """All that was chosen for a run but the seed: runs that share it differ by chance alone."""

    method: str
    denoiser: str
    steps: int | None
    sampler: str | None
    overlap: float | int | None
    guidance: float | int | None
    spread: str | None
    late: float | int | None
    absolute: float | int | None


@dataclass(frozen=True)
class Result:
    """What one seed of one setting measured. None: the setting does not apply, as none does to real motion.

    `method` is a name of `naming.METHODS` or any other; `metrics` has the keys of `naming.MEASURES` or others.
    Raises `ResultError` for a number that is not finite.
    """

    method: str
    seed: int
    metrics: Mapping[str, float | int]
    denoiser: str = ""
    steps: int | None = None
    sampler: str | None = None
    overlap: float | int | None = None
    """Seconds of a whole transition (2 l in the paper)."""
    guidance: float | int | None = None
    spread: str | None = None
    """Of `ddpm`'s noise."""
    late: float | int | None = None
    """The share of steps before stitching begins."""
    absolute: float | int | None = None
    """The share of steps that FlowMDM takes with absolute positions."""
    curves: Mapping[str, Sequence[float | int]] = field(default_factory=dict)
    """What was measured frame by frame."""

    def __post_init__(self) -> None:
        numbers = {f"metrics.{name}": value for name, value in self.metrics.items()}
        numbers |= {f"curves.{name}[{i}]": value for name, row in self.curves.items() for i, value in enumerate(row)}
        for name, value in (numbers | self.setting._asdict()).items():
            if isinstance(value, float) and not math.isfinite(value):
                raise ResultError(f"{name}: {value} is not a finite number")
        for name in ("metrics", "curves"):
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))

    @property
    def setting(self) -> Setting:
        """Everything but the seed and what was measured."""
        return Setting(*(getattr(self, name) for name in Setting._fields))


_KINDS: Mapping[str, tuple[type, ...]] = {
    "method": (str,),
    "seed": (int,),
    "denoiser": (str,),
    "steps": (int, type(None)),
    "sampler": (str, type(None)),
    "overlap": (int, float, type(None)),
    "guidance": (int, float, type(None)),
    "spread": (str, type(None)),
    "late": (int, float, type(None)),
    "absolute": (int, float, type(None)),
    "curves": (dict,),
    "metrics": (dict,),
}


def _check(name: str, value: Any, kinds: tuple[type, ...]) -> None:
    if not isinstance(value, kinds) or isinstance(value, bool):
        legal = " or ".join("null" if kind is type(None) else kind.__name__.lower() for kind in kinds)
        raise ResultError(f"{name}: {value!r} is not {legal}")


def by_setting(results: Iterable[Result]) -> dict[Setting, list[Result]]:
    """The runs of each setting, in the order of first appearance.

    Raises `ResultError` for a seed that a setting has twice: it would make the interval too narrow.
    """
    groups: dict[Setting, list[Result]] = {}
    for result in results:
        group = groups.setdefault(result.setting, [])
        if any(other.seed == result.seed for other in group):
            raise ResultError(f"seed {result.seed} stands twice for {result.setting}")
        group.append(result)
    return groups


def refuse_other_differences(groups: Iterable[Setting], varied: Sequence[str]) -> None:
    """Raises `ResultError` where settings differ in more than the fields `varied`."""
    same = dict.fromkeys(varied)
    first, *others = groups
    for other in others:
        if first._replace(**same) != other._replace(**same):
            told = difference(first._replace(**same), other._replace(**same))
            raise ResultError(f"records differ in more than {', '.join(varied)}: {told}; choose one")


def difference(first: Setting, second: Setting) -> str:
    """In which fields two settings differ, and how."""
    pairs = zip(Setting._fields, first, second, strict=True)
    return ", ".join(f"{name} {one} and {other}" for name, one, other in pairs if one != other)


def write_results(results: Sequence[Result], path: str | Path) -> None:
    """Writes JSON, a record a line; the file appears whole or not at all."""
    lines = [
        json.dumps(
            {key.name: getattr(result, key.name) for key in fields(Result)}
            | {name: dict(getattr(result, name)) for name in ("metrics", "curves")}
        )
        for result in results
    ]
    content = "".join(f"{line}\n" for line in lines)
    write_whole(Path(path), lambda temporary: temporary.write_text(content, encoding="utf-8"))


def read_results(path: str | Path) -> list[Result]:
    """The records of a file that `write_results` wrote. Raises `ResultError` naming the line and the key."""
    results = []
    try:
        lines = Path(path).read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError as error:
        raise ResultError(f"{path}: not UTF-8 text ({error.reason} at byte {error.start})") from None
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        try:
            results.append(_of_line(line))
        except ResultError as error:
            raise ResultError(f"{path}, line {number}: {error}") from None
    return results


def _of_line(line: str) -> Result:
    try:
        data = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise ResultError(f"not JSON ({error})") from None
    if not isinstance(data, dict):
        raise ResultError(f'a record is an object, {{"method": "stmc", "seed": 0, "metrics": {{…}}}}, not {line[:60]}')
    known = [key.name for key in fields(Result)]
    if unknown := [key for key in data if key not in known]:
        raise ResultError(f"unknown key {unknown[0]!r}; choose from {', '.join(known)}")
    if missing := [key for key in ("method", "seed", "metrics") if key not in data]:
        raise ResultError(f"no {', '.join(missing)}")
    for name, value in data.items():
        _check(name, value, _KINDS[name])
    for name, value in data["metrics"].items():
        _check(f"metrics.{name}", value, (int, float))
    for name, row in data.get("curves", {}).items():
        _check(f"curves.{name}", row, (list,))
        for value in row:
            _check(f"curves.{name}", value, (int, float))
    return Result(**data)
