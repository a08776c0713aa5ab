"""Records of runs, and files of records: JSON, one record per line. This module knows no table and no chart."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

from stmc.composing.sampling import Sampling
from stmc.io.files import write_whole
from stmc.settings.records import SettingError, field_infos, quote, record_of
from stmc.settings.renamed import RENAMED_IN_RECORDS


class ResultError(ValueError):
    """Error for an invalid record; the message names the file, the line and the key."""


@dataclass(frozen=True)
class Setting:
    """All choices of a run except the seed; runs with the same setting differ only by chance."""

    method: str
    denoiser: str = ""
    sampling: Sampling = Sampling()

    def value(self, name: str) -> Any:
        """Return the field, or the setting of sampling, with this name."""
        return getattr(self if name in ("method", "denoiser") else self.sampling, name)

    def without(self, names: Iterable[str]) -> Setting:
        """Return a copy in which these are unset."""
        open_ = {name: None for name in names if name in field_infos(Sampling)}
        here = {name: "" for name in names if name not in open_}
        return replace(self, **here, sampling=replace(self.sampling, **open_))


SETTINGS = ("method", "denoiser", *field_infos(Sampling))
"""Names of all choices."""


@dataclass(frozen=True)
class Result:
    """Measurements of one seed of one setting. Raises `ResultError` for a number that is not finite.

    Args:
        method: Name in `composing.METHODS`, or any other.
        seed: Seed of the run.
        metrics: Values by the keys of `naming.MEASURES`, or others.
        denoiser: Name of the denoiser.
        sampling: Settings of sampling; None for those that do not apply, as all for real motion. The sampler is a name.
        curves: Values per frame.
        resampled: Values of metrics on resamples of the timelines, the same resamples for every seed.
    """

    method: str
    seed: int
    metrics: Mapping[str, float | int]
    denoiser: str = ""
    sampling: Sampling = Sampling()
    curves: Mapping[str, Sequence[float | int]] = field(default_factory=dict)
    resampled: Mapping[str, Sequence[float | int]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        numbers = {f"metrics.{name}": value for name, value in self.metrics.items()}
        for kind in _ROWS:
            rows = getattr(self, kind).items()
            numbers |= {f"{kind}.{name}[{i}]": value for name, row in rows for i, value in enumerate(row)}
        for name, value in numbers.items():
            if isinstance(value, float) and not math.isfinite(value):
                raise ResultError(f"{name}: {value} is not a finite number")
        for name in ("metrics", *_ROWS):
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))

    @property
    def setting(self) -> Setting:
        """All choices except the seed."""
        return Setting(self.method, self.denoiser, self.sampling)


_ROWS = ("curves", "resampled")
_KINDS: Mapping[str, type] = {"method": str, "seed": int, "denoiser": str, "metrics": dict} | dict.fromkeys(_ROWS, dict)


def _check_values(data: Mapping[str, Any]) -> None:
    for name, kind in _KINDS.items():
        if name in data:
            _check(name, data[name], kind)
    for name, value in data["metrics"].items():
        _check(f"metrics.{name}", value, int, float)
    rows = {f"{kind}.{name}": row for kind in _ROWS for name, row in data.get(kind, {}).items()}
    for name, row in rows.items():
        _check(name, row, list)
        for value in row:
            _check(name, value, int, float)


def _check(name: str, value: Any, *kinds: type) -> None:
    if not isinstance(value, kinds) or isinstance(value, bool):
        raise ResultError(f"{name}: {quote(value)} is not {' or '.join(kind.__name__ for kind in kinds)}")


def by_setting(results: Iterable[Result]) -> dict[Setting, list[Result]]:
    """Group runs by setting, in the order of first appearance.

    Raises `ResultError` for a duplicate seed of a setting, which would make the interval too narrow.
    """
    groups: dict[Setting, list[Result]] = {}
    for result in results:
        group = groups.setdefault(result.setting, [])
        if any(other.seed == result.seed for other in group):
            raise ResultError(f"seed {result.seed} is duplicated for {result.setting}")
        group.append(result)
    return groups


def check_only_varied(groups: Iterable[Setting], varied: Sequence[str]) -> None:
    """Raise `ResultError` if settings differ in more than `varied`."""
    first, *others = (setting.without(varied) for setting in groups)
    for other in others:
        if first != other:
            message = difference(first, other)
            raise ResultError(f"records differ in more than {', '.join(varied)}: {message}; choose one")


def difference(first: Setting, second: Setting) -> str:
    """Describe the differences of two settings."""
    pairs = ((name, first.value(name), second.value(name)) for name in SETTINGS)
    return ", ".join(f"{name} {one} and {other}" for name, one, other in pairs if one != other)


def write_results(results: Sequence[Result], path: str | Path) -> None:
    """Write records as JSON, one per line; the file is written atomically."""
    content = "".join(f"{json.dumps(_flat(result))}\n" for result in results)
    write_whole(Path(path), lambda temporary: temporary.write_text(content, encoding="utf-8"))


def _flat(result: Result) -> dict[str, Any]:
    chosen = {name: result.setting.value(name) for name in SETTINGS}
    return chosen | {"seed": result.seed} | {name: dict(getattr(result, name)) for name in ("metrics", *_ROWS)}


def read_results(path: str | Path) -> list[Result]:
    """Read a file of `write_results`, with current names for renamed settings.

    Raises `ResultError`, which names the line and the key, for an invalid record.
    """
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
        raise ResultError(
            f'a record must be an object, {{"method": "stmc", "seed": 0, "metrics": {{…}}}}, not {line[:60]}'
        )
    old = {RENAMED_IN_RECORDS[key]: data.pop(key) for key in RENAMED_IN_RECORDS if key in data}
    data = old | data
    known = (*SETTINGS, "seed", "metrics", *_ROWS)
    if unknown := [key for key in data if key not in known]:
        raise ResultError(f"unknown key {quote(unknown[0])}; choose from {', '.join(known)}")
    if missing := [key for key in ("method", "seed", "metrics") if key not in data]:
        raise ResultError(f"missing {', '.join(missing)}")
    _check_values(data)
    try:
        sampling = record_of(Sampling, {name: data.pop(name) for name in field_infos(Sampling) if name in data})
    except SettingError as error:
        raise ResultError(str(error)) from None
    return Result(**data, sampling=sampling)
