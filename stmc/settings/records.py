"""Settings as records: dataclasses whose fields hold the help, range and choices of each setting, and one check.

The fields are the only list: defaults, help and messages derive from them, in Python and on the command line alike.
Depends on dataclasses; independent of particular settings, files and command lines.
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

from stmc.io.untrusted import quote

Record = TypeVar("Record")
Function = TypeVar("Function", bound=Callable[..., Any])

_LIMITS: Mapping[str, tuple[str, Callable[[Any, Any], bool]]] = {
    "at_least": ("at least", lambda value, limit: value >= limit),
    "above": ("above", lambda value, limit: value > limit),
    "at_most": ("at most", lambda value, limit: value <= limit),
    "below": ("below", lambda value, limit: value < limit),
}


class SettingError(ValueError):
    """An unknown setting, a wrong type or a value out of range; the message names the setting and the valid values."""


@dataclass(frozen=True)
class FieldInfo:
    """Help, unit, choices and limits of a setting: the metadata of a field of a record."""

    help: str
    unit: str = ""
    choices: tuple[str, ...] = ()
    """Choices for a string, or for each item of a tuple of strings; empty: any string."""
    limits: tuple[tuple[str, float | int], ...] = ()
    """Limits of a number: pairs of an argument of `setting` ("at_least", "above", "at_most", "below") and its value."""

    @property
    def fits(self) -> str:
        """The valid values in words: "one of a, b, c", "at least 0 and below 1 s"."""
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
    """Make a field of a record of settings.

    Args:
        default: Default value; `MISSING` if the setting is required.
        help: Help in one line.
        unit: Unit of a number.
        choices: Valid strings; empty: any string.
        at_least: Inclusive lower limit of a number.
        above: Exclusive lower limit.
        at_most: Inclusive upper limit.
        below: Exclusive upper limit.
    """
    limits = {"at_least": at_least, "above": above, "at_most": at_most, "below": below}
    present = tuple((name, limit) for name, limit in limits.items() if limit is not None)
    first = {"default_factory": default.copy} if isinstance(default, dict) else {"default": default}
    return dataclasses.field(**first, metadata={"info": FieldInfo(help, unit, tuple(choices), present)})


def as_in(record: type, name: str, default: Any = dataclasses.MISSING) -> Any:
    """Make a field with the help, limits and choices of a field of another record.

    Args:
        record: The other record.
        name: Name of its field.
        default: Default value; that of the other field if omitted.
    """
    [other] = [field for field in dataclasses.fields(record) if field.name == name]
    default = other.default if default is dataclasses.MISSING else default
    return dataclasses.field(default=default, metadata=other.metadata)


def field_infos(record: type) -> dict[str, FieldInfo]:
    """Return the `FieldInfo` of every setting of a record, in order."""
    return {field.name: field.metadata["info"] for field in dataclasses.fields(record) if "info" in field.metadata}


def defaults(record: type) -> dict[str, Any]:
    """Return the default of every setting of a record, in order; `dataclasses.MISSING` for required ones."""
    fields = [field for field in dataclasses.fields(record) if "info" in field.metadata]
    makers = {field.name: field.default_factory for field in fields if field.default_factory is not dataclasses.MISSING}
    return {field.name: makers[field.name]() if field.name in makers else field.default for field in fields}


def check(record: Any) -> None:
    """Raise `SettingError` for the first invalid setting of a record; for `__post_init__`."""
    _check_values(type(record), {name: getattr(record, name) for name in field_infos(type(record))})


def record_of(kind: type[Record], values: Mapping[str, Any]) -> Record:
    """Make a record with these settings, lists as tuples, and defaults for the others.

    Raises `SettingError` for an invalid value, and for an unknown name, with the nearest valid one.
    """
    valid = [field.name for field in dataclasses.fields(cast(Any, kind))]
    for name in values:
        check_name(name, valid)
    values = {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}
    _check_values(kind, values)
    return kind(**values)


def with_signature_of(kind: type) -> Callable[[Function], Function]:
    """Replace `**settings` in a function's signature by the fields of the record `kind`, for help and completion.

    The function itself makes the record, with `record_of`.
    """

    def decorate(function: Function) -> Function:
        signature = inspect.signature(function)
        named = [item for item in signature.parameters.values() if item.kind is not inspect.Parameter.VAR_KEYWORD]
        settings = [
            inspect.Parameter(field.name, inspect.Parameter.KEYWORD_ONLY, default=field.default, annotation=field.type)
            for field in dataclasses.fields(kind)
        ]
        vars(function)["__signature__"] = signature.replace(parameters=[*named, *settings])
        return function

    return decorate


def check_name(name: Any, valid: Iterable[str], kind: str = "setting") -> None:
    """Raise `SettingError` for an unknown name, with the nearest valid one.

    Args:
        name: Name to check.
        valid: Valid names.
        kind: Noun for the message, such as "setting".
    """
    valid = list(valid)
    if name not in valid:
        matches = get_close_matches(str(name), valid, 1)
        advice = f"did you mean {matches[0]}?" if matches else f"choose from {', '.join(valid)}"
        raise SettingError(f"unknown {kind} {quote(name)}: {advice}")


def _check_values(kind: type, values: Mapping[str, Any]) -> None:
    hints, infos = _hints(kind), field_infos(kind)
    for name in values:
        if name in infos:
            if values[name] == "":
                raise SettingError(f"{name}='': must not be empty")
            check_value(name, values[name], hints[name], infos[name])


_hints = cache(get_type_hints)


def check_value(name: str, value: Any, hint: Any, info: FieldInfo | None = None) -> None:
    """Raise `SettingError` for a value of the wrong type or out of range.

    Args:
        name: Name of the setting, for the message.
        value: Value to check.
        hint: Type of the setting.
        info: Choices and limits; None: any value of the type is valid.
    """
    info = FieldInfo("") if info is None else info
    kinds = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    kinds = tuple(kind for kind in kinds if kind is not int or float not in kinds)
    if value is None and NoneType in kinds:
        return
    if not any(_is(value, kind) for kind in kinds):
        words = " or ".join(dict.fromkeys(map(_words, kinds)))
        raise SettingError(f"{name}={quote(value)}: must be {words}{f', {info.fits}' if info.fits else ''}")
    items = value if isinstance(value, tuple) else (value,)
    if info.choices and (bad := [item for item in items if isinstance(item, str) and item not in info.choices]):
        raise SettingError(f"{name}={quote(bad[0])}: choose from {', '.join(info.choices)}")
    for item in items:
        if isinstance(item, (int, float)) and not all(_LIMITS[limit][1](item, at) for limit, at in info.limits):
            raise SettingError(f"{name}={quote(item)}: must be {info.fits}")


_WORDS: Mapping[Any, str] = {
    int: "a whole number", float: "a number", bool: "true or false", str: "a text", tuple: "a list", NoneType: "null",
    Mapping: "a table of names and values", Callable: "a function",
}  # fmt: skip


def _words(kind: Any) -> str:
    """Name a type for a message."""
    if get_origin(kind) is Literal:
        return f"one of {', '.join(map(str, get_args(kind)))}"
    return _WORDS.get(get_origin(kind) or kind, getattr(kind, "__name__", str(kind)))


def _is(value: Any, kind: Any) -> bool:
    """Tell whether a value has a type. A bool is not a number, an int counts as a float, and floats must be finite."""
    if kind is float:
        return _is(value, int) or (isinstance(value, float) and math.isfinite(value))
    if kind is int:
        return isinstance(value, int) and not isinstance(value, bool)
    if get_origin(kind) is Literal:
        return value in get_args(kind)
    if get_origin(kind) in (Union, UnionType):
        return any(_is(value, member) for member in get_args(kind))
    if get_origin(kind) is Callable:
        return callable(value)
    if get_origin(kind) is tuple:
        return isinstance(value, tuple) and all(_is(item, get_args(kind)[0]) for item in value)
    if kind is NoneType:
        return value is None
    return isinstance(value, kind)
