"""Parse the arguments of a command into Hydra's overrides: `key=value`, `--key value` and positional arguments.

Text is taken literally: file names with spaces, commas, quotes or parentheses need only the shell's own quoting.
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

from stmc.settings.records import SettingError, check_name, quote

_OVERRIDE = re.compile(r"([+~]{0,2})([A-Za-z_][\w./@-]*)=(.*)", re.DOTALL)
_DELETED = re.compile(r"~[A-Za-z_][\w./@-]*")
_FLAGS = {"--config-name": "name", "-cn": "name", "--config-dir": "folder", "-cd": "folder"}
_HELP, _SHOW, _MULTIRUN = ("--help", "-h"), ("--cfg", "-c"), ("--multirun", "-m")


@dataclass(frozen=True)
class Arguments:
    """Parsed arguments of a command. `name`: configuration to start from; `folder`: the user's own configurations."""

    overrides: tuple[str, ...] = ()
    name: str | None = None
    folder: Path | None = None
    help: bool = False
    show: bool = False
    multirun: bool = False
    """Whether to run a job for every combination of values, in Hydra's grammar: `shard=1/4,2/4`."""


def parse_arguments(
    arguments: Sequence[str], record: type, groups: Mapping[str, Any], positional: Sequence[str]
) -> Arguments:
    """Parse the arguments of a command. Raises `SettingError` for unknown settings and missing values.

    Args:
        arguments: Words of the command line.
        record: Record of the command's settings.
        groups: Configuration groups of the command.
        positional: Names of the settings that positional arguments set, in order.
    """
    multirun = any(argument in _MULTIRUN for argument in arguments)
    hints, remaining = get_type_hints(record), [each for each in arguments if each not in _MULTIRUN]
    groups = {**groups, "hydra": None} if multirun else groups
    names, overrides = iter(positional), list[str]()
    flags: dict[str, Any] = {}
    while remaining:
        argument = remaining.pop(0)
        flag, equals, value = argument.partition("=")
        key = flag[2:].replace("-", "_")
        if argument in _HELP:
            flags["help"] = True
        elif flag in _SHOW:
            flags["show"] = True
            if not equals and remaining[:1] == ["job"]:
                remaining.pop(0)
        elif flag in _FLAGS:
            flags[_FLAGS[flag]] = value if equals else _pop_value(remaining, flag)
        elif flag.startswith("--") and (key.partition(".")[0] in hints or key.partition(".")[0] in groups):
            value = value if equals else _flag_value(remaining, flag, hints.get(key))
            overrides.append(_as_override("", key, value, hints, multirun))
        elif argument.startswith("--"):
            raise SettingError(f"unknown setting {quote(flag)}; --help lists all settings")
        elif found := _OVERRIDE.fullmatch(argument):
            check_name(re.split(r"[.@/]", found[2])[0], [*hints, *groups])
            sign, key, value = found.groups()
            overrides.append(_as_override(sign, key, value, hints, multirun))
        elif _DELETED.fullmatch(argument):
            overrides.append(argument)
        elif (name := next(names, None)) is not None:
            overrides.append(_as_override("", name, argument, hints, multirun))
        else:
            raise SettingError(f"{quote(argument)} is not a setting; write settings as key=value, --help lists them")
    folder = Path(flags.pop("folder")).expanduser() if "folder" in flags else None
    return Arguments(tuple(overrides), folder=folder, multirun=multirun, **flags)


def setting_types(hint: Any) -> Iterator[Any]:
    """Yield the types that a setting may have, without null."""
    yield from (kind for kind in (get_args(hint) if get_origin(hint) is UnionType else (hint,)) if kind is not NoneType)


def _flag_value(remaining: list[str], flag: str, hint: Any) -> str:
    """Return the value that follows a flag; Boolean flags may omit it."""
    if hint is bool and remaining[:1] not in (["true"], ["false"]):
        return "true"
    return _pop_value(remaining, flag)


def _pop_value(remaining: list[str], flag: str) -> str:
    if not remaining:
        raise SettingError(f"{flag} needs a value")
    return remaining.pop(0)


def _as_override(sign: str, key: str, value: str, hints: Mapping[str, Any], multirun: bool) -> str:
    """Write an override in Hydra's grammar: text, and anything that Hydra cannot parse, is quoted.

    With `multirun`, commas separate the values of different jobs.
    """
    hint, plain = hints.get(key), f"{sign}{key}={value}"
    if multirun and "," in value and _parses(plain, sweeps=True):
        return plain
    if hint is not None and str in setting_types(hint) and value != "null":
        return f"{sign}{key}={quote_override(value)}"
    listed = any(get_origin(kind) is tuple for kind in setting_types(hint))
    if listed and value != "null" and _parses(f"{key}=[{value}]") and not value.startswith("["):
        return f"{sign}{key}=[{value}]"
    return plain if _parses(plain) else f"{sign}{key}={quote_override(value)}"


def quote_override(value: str) -> str:
    """Quote a text for Hydra's grammar; a quoted text is unchanged."""
    if len(value) > 1 and value[0] == value[-1] and value[0] in "'\"":
        return value
    escaped = re.sub(r"(\\*)'", lambda found: found[1] * 2 + r"\'", value)
    trailing = len(escaped) - len(escaped.rstrip("\\"))
    return f"'{escaped}{chr(92) * trailing}'"


def _parses(override: str, sweeps: bool = False) -> bool:
    try:
        return OverridesParser.create().parse_override(override).is_sweep_override() == sweeps
    except (HydraException, RecursionError):
        return False
