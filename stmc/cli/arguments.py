"""What was typed behind a command, as Hydra's overrides: `key=value`, `--key value`, and plain arguments.

A text is taken as it is typed: file names with spaces, commas, quotes or parentheses need no more quoting than the
shell's.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, get_args, get_origin, get_type_hints

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException

from stmc.settings.records import SettingError, check_name, shown

_GIVEN = re.compile(r"([+~]{0,2})([A-Za-z_][\w./@-]*)=(.*)", re.DOTALL)
_DELETED = re.compile(r"~[A-Za-z_][\w./@-]*")
_FLAGS = {"--config-name": "name", "-cn": "name", "--config-dir": "folder", "-cd": "folder"}
_HELP, _SHOW, _MULTIRUN = ("--help", "-h"), ("--cfg", "-c"), ("--multirun", "-m")


@dataclass(frozen=True)
class Asked:
    """What was asked of a command. `name` is of its configuration, `folder` the user's own configurations."""

    overrides: tuple[str, ...] = ()
    name: str | None = None
    folder: Path | None = None
    help: bool = False
    show: bool = False
    multirun: bool = False
    """A job for every combination of values; these are then in Hydra's grammar: `shard=1/4,2/4`."""


def read(arguments: Sequence[str], record: type, groups: Mapping[str, Any], positional: Sequence[str]) -> Asked:
    """The arguments of a command with the settings of `record` and groups of configurations; plain ones are the
    settings `positional`, in order. Raises `SettingError`."""
    multirun = any(argument in _MULTIRUN for argument in arguments)
    hints, left = get_type_hints(record), [each for each in arguments if each not in _MULTIRUN]
    groups = {**groups, "hydra": None} if multirun else groups
    places, overrides, flags = iter(positional), [], {}
    while left:
        argument = left.pop(0)
        flag, equals, value = argument.partition("=")
        key = flag[2:].replace("-", "_")
        if argument in _HELP:
            flags["help"] = True
        elif flag in _SHOW:
            flags["show"] = True
            if not equals and left[:1] == ["job"]:
                left.pop(0)
        elif flag in _FLAGS:
            flags[_FLAGS[flag]] = value if equals else _next(left, flag)
        elif flag.startswith("--") and (key.partition(".")[0] in hints or key.partition(".")[0] in groups):
            value = value if equals else _value(left, flag, hints.get(key))
            overrides.append(_override("", key, value, hints, multirun))
        elif argument.startswith("--"):
            raise SettingError(f"unknown setting {shown(flag)}: --help lists all settings")
        elif found := _GIVEN.fullmatch(argument):
            check_name(re.split(r"[.@/]", found[2])[0], [*hints, *groups])
            overrides.append(_override(*found.groups(), hints, multirun))
        elif _DELETED.fullmatch(argument):
            overrides.append(argument)
        elif (key := next(places, None)) is not None:
            overrides.append(_override("", key, argument, hints, multirun))
        else:
            raise SettingError(f"{shown(argument)} is not a setting: give them as key=value; --help lists all")
    folder = Path(flags.pop("folder")).expanduser() if "folder" in flags else None
    return Asked(tuple(overrides), folder=folder, multirun=multirun, **flags)


def kinds(hint: Any) -> Iterator[Any]:
    """The types that a setting may have, without null."""
    yield from (kind for kind in (get_args(hint) if get_origin(hint) is UnionType else (hint,)) if kind is not NoneType)


def _value(left: list[str], flag: str, hint: Any) -> str:
    """Of a flag that stands apart from it; a setting that is true or false needs none."""
    if hint is bool and left[:1] not in (["true"], ["false"]):
        return "true"
    return _next(left, flag)


def _next(left: list[str], flag: str) -> str:
    if not left:
        raise SettingError(f"{flag} needs a value")
    return left.pop(0)


def _override(sign: str, key: str, value: str, hints: Mapping[str, Any], multirun: bool) -> str:
    """As Hydra reads it: a setting that is a text is quoted, and so is everything that Hydra has no grammar for. For
    many runs a list with commas is one value each."""
    hint, plain = hints.get(key), f"{sign}{key}={value}"
    if multirun and "," in value and _reads(plain, sweeps=True):
        return plain
    if hint is not None and str in kinds(hint) and value != "null":
        return f"{sign}{key}={quoted(value)}"
    if get_origin(hint) is tuple and value != "null" and _reads(f"{key}=[{value}]") and not value.startswith("["):
        return f"{sign}{key}=[{value}]"
    return plain if _reads(plain) else f"{sign}{key}={quoted(value)}"


def quoted(value: str) -> str:
    """A text as Hydra's grammar has it; what is quoted already stays."""
    if len(value) > 1 and value[0] == value[-1] and value[0] in "'\"":
        return value
    escaped = re.sub(r"(\\*)'", lambda found: found[1] * 2 + r"\'", value)
    trailing = len(escaped) - len(escaped.rstrip("\\"))
    return f"'{escaped}{chr(92) * trailing}'"


def _reads(override: str, sweeps: bool = False) -> bool:
    try:
        return OverridesParser.create().parse_override(override).is_sweep_override() == sweeps
    except (HydraException, RecursionError):
        return False
