"""What `--help` prints: every setting with what it is, its unit, what fits and its default, read off the record."""

from __future__ import annotations

import dataclasses
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

from stmc.settings.records import FieldInfo, defaults

WIDTH = 100
_NAMES = 18
"""Columns of a line, and those of them in front of what a setting is."""

Parts = Mapping[str, tuple[str, Sequence[str]]]
"""The groups that a configuration is composed of, each with the one chosen by default and all of them."""


Tables = Mapping[str, tuple[type, Mapping[str, Any]]]
"""The records that parts of a configuration describe, such as `data/sampling`, each with the values that it gives."""


def explanation(
    name: str, described: str, settings: type, positional: Sequence[str], parts: Parts, tables: Tables
) -> str:
    """The help of a command: how it is called, what it does, its settings, the parts of its configuration, and the
    settings of those that are records."""
    told, first = field_infos(settings), defaults(settings)
    plain = [each.upper() if first[each] is dataclasses.MISSING else f"[{each.upper()}]" for each in positional]
    paragraphs = [
        " ".join(["Usage: stmc", name, *plain, "[SETTING=VALUE …]"]),
        described.strip(),
        "Settings, also as --SETTING VALUE; defaults are in brackets:",
        "\n".join(_entry(each, _what(told[each]), first[each]) for each in _own_first(settings)),
    ]
    if parts:
        paragraphs.append("Parts, each a configuration file; PART.SETTING=VALUE changes a setting of one:")
        paragraphs.append("\n".join(_entry(part, ", ".join(names), chosen) for part, (chosen, names) in parts.items()))
    paragraphs += [text for part, table in tables.items() for text in _of_part(part, *table)]
    paragraphs.append(
        "--config-dir FOLDER: your own configuration files, beside ours; --config-name NAME: start from NAME.yaml;\n"
        "--cfg: print the configuration and stop."
    )
    paragraphs.append("--multirun SETTING=VALUE,VALUE: one job per value; hydra/launcher=NAME chooses where they run.")
    return "\n\n".join(paragraphs) + "\n"


def _of_part(part: str, record: type, values: Mapping[str, Any]) -> tuple[str, str]:
    """What a part that is a record says of itself."""
    place, shown = part.replace("/", "."), defaults(record) | dict(values)
    return (
        f"Settings of {part}, here {record.__name__}, as {place}.SETTING=VALUE, with a plus in front\n"
        f"where --cfg does not show it; --help {part}=NAME shows those of another:",
        "\n".join(_entry(name, _what(told), shown[name]) for name, told in field_infos(record).items()),
    )


def _own_first(settings: type) -> list[str]:
    """The names of the settings, those that other commands have, too, behind the others."""
    return sorted(field_infos(settings), key=lambda name: name not in settings.__annotations__)


def _what(told: FieldInfo) -> str:
    unit = f", in {told.unit}" if told.unit and not told.limits else ""
    return f"{told.help}{unit}{f' ({told.fits})' if told.fits != told.unit else ''}"


def _entry(name: str, text: str, default: Any) -> str:
    ending = "needed" if default is dataclasses.MISSING else textwrap.shorten(_typed(default), 60, placeholder="…")
    lines = textwrap.wrap(f"{text} [{ending}]", WIDTH - _NAMES, break_on_hyphens=False)
    apart = f"  {name:<{_NAMES - 2}}" if len(name) < _NAMES - 2 else f"  {name}\n{'':{_NAMES}}"
    return apart + f"\n{'':{_NAMES}}".join(lines)


def _typed(value: Any) -> str:
    """As it is typed on a command line."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, tuple):
        return f"[{', '.join(map(_typed, value))}]"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{key}: {_typed(each)}' for key, each in value.items())}}}"
    return str(value)
