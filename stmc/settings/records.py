"""Settings as records: a dataclass whose fields say what each setting is, its range and its choices, and one check.

The fields are the only list: defaults, help and messages derive from them, in Python and on the command line alike.
Knows dataclasses; knows no setting, no file and no command line.
"""

from __future__ import annotations

import dataclasses
import inspect
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cache
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from stmc.io.untrusted import shown

Record = TypeVar("Record")
Function = TypeVar("Function", bound=Callable[..., Any])

_LIMITS: Mapping[str, tuple[str, Callable[[Any, Any], bool]]] = {
    "at_least": ("at least", lambda value, limit: value >= limit),
    "above": ("above", lambda value, limit: value > limit),
    "at_most": ("at most", lambda value, limit: value <= limit),
    "below": ("below", lambda value, limit: value < limit),
}


class SettingError(ValueError):
    """A setting that is unknown, of the wrong type or out of range; the message says which, the value and what fits."""


@dataclass(frozen=True)
class About:
    """What a field of a record of settings says of itself."""

    help: str
    unit: str = ""
    choices: tuple[str, ...] = ()
    """Of a string, or of each item of a tuple of strings; none: any."""
    limits: tuple[tuple[str, float | int], ...] = ()
    """Of a number: pairs of a key of `setting` ("at_least", "above", "at_most", "below") and a limit."""

    @property
    def fits(self) -> str:
        """The legal values in words: "from a, b, c", "at least 0 and below 1 s"."""
        if self.choices:
            return f"one of {', '.join(self.choices)}"
        limits = " and ".join(f"{_LIMITS[name][0]} {limit:g}" for name, limit in self.limits)
        return f"{limits} {self.unit}".strip()


def setting(
    default: Any,
    help: str,
    *,
    unit: str = "",
    choices: Iterable[str] = (),
    at_least: float | int | None = None,
    above: float | int | None = None,
    at_most: float | int | None = None,
    below: float | int | None = None,
) -> Any:
    """A field of a record of settings: its default (`MISSING`: it must be given), what it is in a line, and what values
    fit."""
    limits = {"at_least": at_least, "above": above, "at_most": at_most, "below": below}
    given = tuple((name, limit) for name, limit in limits.items() if limit is not None)
    first = {"default_factory": default.copy} if isinstance(default, dict) else {"default": default}
    return dataclasses.field(**first, metadata={"about": About(help, unit, tuple(choices), given)})


def as_in(record: type, name: str, default: Any = dataclasses.MISSING) -> Any:
    """Return a field like the one of another record: with its help, limits and choices, and with its default unless
    another one is given."""
    [other] = [field for field in dataclasses.fields(record) if field.name == name]
    default = other.default if default is dataclasses.MISSING else default
    return dataclasses.field(default=default, metadata=other.metadata)


def about(record: type) -> dict[str, About]:
    """What every setting of a record says of itself, in order."""
    return {field.name: field.metadata["about"] for field in dataclasses.fields(record) if "about" in field.metadata}


def defaults(record: type) -> dict[str, Any]:
    """The default of every setting of a record, in order; `dataclasses.MISSING` for what must be given."""
    fields = [field for field in dataclasses.fields(record) if "about" in field.metadata]
    made = {field.name: field.default_factory for field in fields if field.default_factory is not dataclasses.MISSING}
    return {field.name: made[field.name]() if field.name in made else field.default for field in fields}


def check(record: Any) -> None:
    """Raises `SettingError` for the first setting of a record that does not fit; for `__post_init__`."""
    _check_values(type(record), {name: getattr(record, name) for name in about(type(record))})


def record_of(kind: type[Record], values: Mapping[str, Any]) -> Record:
    """The record with these settings, lists as tuples, all others at their defaults. Raises `SettingError`, for unknown
    names too, with the nearest known one."""
    known = [field.name for field in dataclasses.fields(cast(Any, kind))]
    for name in values:
        check_name(name, known)
    values = {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}
    _check_values(kind, values)
    return kind(**values)


def takes(kind: type) -> Callable[[Function], Function]:
    """Of a function with `**settings`: its signature shows the settings of the record `kind` instead, for help and
    completion. The function makes the record itself, with `record_of`."""

    def shows(function: Function) -> Function:
        signature = inspect.signature(function)
        own = [each for each in signature.parameters.values() if each.kind is not inspect.Parameter.VAR_KEYWORD]
        settings = [
            inspect.Parameter(each.name, inspect.Parameter.KEYWORD_ONLY, default=each.default, annotation=each.type)
            for each in dataclasses.fields(kind)
        ]
        vars(function)["__signature__"] = signature.replace(parameters=[*own, *settings])
        return function

    return shows


def check_name(name: Any, known: Iterable[str], kind: str = "setting") -> None:
    """Raises `SettingError` for the name of a `kind` of thing that is not known, with the nearest one that is."""
    known = list(known)
    if name not in known:
        near = get_close_matches(str(name), known, 1)
        meant = f"did you mean {near[0]}?" if near else f"choose from {', '.join(known)}"
        raise SettingError(f"unknown {kind} {shown(name)}: {meant}")


def _check_values(kind: type, values: Mapping[str, Any]) -> None:
    hints, known = _hints(kind), about(kind)
    for name in values:
        if name in known:
            if values[name] == "":
                raise SettingError(f"{name}='': a text needed")
            check_value(name, values[name], hints[name], known[name])


_hints = cache(get_type_hints)


def check_value(name: str, value: Any, hint: Any, each: About | None = None) -> None:
    """Raises `SettingError` for a value that is not of the type `hint`, or not what `each` says."""
    each = About("") if each is None else each
    kinds = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    kinds = tuple(kind for kind in kinds if kind is not int or float not in kinds)
    if value is None and NoneType in kinds:
        return
    if not any(_is(value, kind) for kind in kinds):
        words = " or ".join(dict.fromkeys(map(_words, kinds)))
        raise SettingError(f"{name}={shown(value)}: {words} needed{f', {each.fits}' if each.fits else ''}")
    items = value if isinstance(value, tuple) else (value,)
    if each.choices and (bad := [item for item in items if isinstance(item, str) and item not in each.choices]):
        raise SettingError(f"{name}={shown(bad[0])}: choose from {', '.join(each.choices)}")
    for item in items:
        if isinstance(item, (int, float)) and not all(_LIMITS[limit][1](item, at) for limit, at in each.limits):
            raise SettingError(f"{name}={shown(item)}: must be {each.fits}")


_WORDS: Mapping[Any, str] = {
    int: "a whole number", float: "a number", bool: "true or false", str: "a text", tuple: "a list", NoneType: "null",
    Mapping: "a table of names and values", Callable: "a function",
}  # fmt: skip


def _words(kind: Any) -> str:
    """A type as a message names it."""
    if get_origin(kind) is Literal:
        return f"one of {', '.join(map(str, get_args(kind)))}"
    return _WORDS.get(get_origin(kind) or kind, getattr(kind, "__name__", str(kind)))


def _is(value: Any, kind: Any) -> bool:
    """Whether a value is of a plain type: a bool is no number, a whole number is a float, and none is infinite."""
    if kind is float:
        return _is(value, int) or (isinstance(value, float) and math.isfinite(value))
    if kind is int:
        return isinstance(value, int) and not isinstance(value, bool)
    if get_origin(kind) is Literal:
        return value in get_args(kind)
    if get_origin(kind) in (Union, UnionType):
        return any(_is(value, each) for each in get_args(kind))
    if get_origin(kind) is Callable:
        return callable(value)
    if get_origin(kind) is tuple:
        return isinstance(value, tuple) and all(_is(item, get_args(kind)[0]) for item in value)
    if kind is NoneType:
        return value is None
    return isinstance(value, kind)
