"""One record per run of an experiment, and the file of many: JSON, a record a line. Knows no table and no chart."""

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
from stmc.settings.records import SettingError, field_infos, record_of, shown
from stmc.settings.renamed import RENAMED_IN_RECORDS


class ResultError(ValueError):
    """A record that is invalid; the message names the file, the line and the key."""


@dataclass(frozen=True)
class Setting:
    """All that was chosen for a run but the seed: runs that share it differ by chance alone."""

    method: str
    denoiser: str = ""
    sampling: Sampling = Sampling()

    def value(self, name: str) -> Any:
        """Of the field, or of the setting of sampling, of that name."""
        return getattr(self if name in ("method", "denoiser") else self.sampling, name)

    def without(self, names: Iterable[str]) -> Setting:
        """The same with these left open."""
        open_ = {name: None for name in names if name in field_infos(Sampling)}
        here = {name: "" for name in names if name not in open_}
        return replace(self, **here, sampling=replace(self.sampling, **open_))


SETTINGS = ("method", "denoiser", *field_infos(Sampling))
"""The names of all that was chosen."""


@dataclass(frozen=True)
class Result:
    """What one seed of one setting measured. A setting of sampling that is None does not apply, as none does to real
    motion; the sampler is a name.

    `method` is a name of `composing.METHODS` or any other; `metrics` has the keys of `naming.MEASURES` or others,
    `curves` what was measured frame by frame, `resampled` what metrics are on draws of what was asked for: the same
    draws for every seed. Raises `ResultError` for a number that is not finite.
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
        """Everything but the seed and what was measured."""
        return Setting(self.method, self.denoiser, self.sampling)


_ROWS = ("curves", "resampled")
_KINDS: Mapping[str, type] = {"method": str, "seed": int, "denoiser": str, "metrics": dict} | dict.fromkeys(_ROWS, dict)


def _check(name: str, value: Any, *kinds: type) -> None:
    if not isinstance(value, kinds) or isinstance(value, bool):
        raise ResultError(f"{name}: {shown(value)} is not {' or '.join(kind.__name__ for kind in kinds)}")


def by_setting(results: Iterable[Result]) -> dict[Setting, list[Result]]:
    """The runs of each setting, in the order of first appearance.

    Raises `ResultError` for a seed that a setting has twice: it would make the interval too narrow.
    """
    groups: dict[Setting, list[Result]] = {}
    for result in results:
        group = groups.setdefault(result.setting, [])
        if any(other.seed == result.seed for other in group):
            raise ResultError(f"seed {result.seed} is duplicated for {result.setting}")
        group.append(result)
    return groups


def refuse_other_differences(groups: Iterable[Setting], varied: Sequence[str]) -> None:
    """Raises `ResultError` where settings differ in more than those that are `varied`."""
    first, *others = (setting.without(varied) for setting in groups)
    for other in others:
        if first != other:
            told = difference(first, other)
            raise ResultError(f"records differ in more than {', '.join(varied)}: {told}; choose one")


def difference(first: Setting, second: Setting) -> str:
    """In what two settings differ, and how."""
    pairs = ((name, first.value(name), second.value(name)) for name in SETTINGS)
    return ", ".join(f"{name} {one} and {other}" for name, one, other in pairs if one != other)


def write_results(results: Sequence[Result], path: str | Path) -> None:
    """Writes JSON, a record a line; the file appears whole or not at all."""
    content = "".join(f"{json.dumps(_flat(result))}\n" for result in results)
    write_whole(Path(path), lambda temporary: temporary.write_text(content, encoding="utf-8"))


def _flat(result: Result) -> dict[str, Any]:
    chosen = {name: result.setting.value(name) for name in SETTINGS}
    return chosen | {"seed": result.seed} | {name: dict(getattr(result, name)) for name in ("metrics", *_ROWS)}


def read_results(path: str | Path) -> list[Result]:
    """The records of a file that `write_results` wrote, with today's names of the settings. Raises `ResultError` naming
    the line and the key."""
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
    old = {RENAMED_IN_RECORDS[key]: data.pop(key) for key in RENAMED_IN_RECORDS if key in data}
    data = old | data
    known = (*SETTINGS, "seed", "metrics", *_ROWS)
    if unknown := [key for key in data if key not in known]:
        raise ResultError(f"unknown key {shown(unknown[0])}; choose from {', '.join(known)}")
    if missing := [key for key in ("method", "seed", "metrics") if key not in data]:
        raise ResultError(f"no {', '.join(missing)}")
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
    try:
        sampling = record_of(Sampling, {name: data.pop(name) for name in field_infos(Sampling) if name in data})
    except SettingError as error:
        raise ResultError(str(error)) from None
    return Result(**data, sampling=sampling)
