"""Text of `--help`: every setting with its meaning, unit, legal values and default, taken from its record."""

from __future__ import annotations

import dataclasses
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

from stmc.settings.records import FieldInfo, defaults, field_infos

WIDTH = 100
_NAMES = 18
"""Width of a line, and of its first column, which holds the names."""
Parts = Mapping[str, tuple[str, Sequence[str]]]
"""Groups of a configuration, each with its default choice and all choices."""
Tables = Mapping[str, tuple[type, Mapping[str, Any]]]
"""Records of parts of a configuration, such as `data/sampling`, each with its configured values."""


def format_help(
    name: str, described: str, settings: type, positional: Sequence[str], parts: Parts, tables: Tables
) -> str:
    """Return the help of a command.

    Args:
        name: Name of the command.
        described: Docstring of its module.
        settings: Record of its settings.
        positional: Names of the settings that positional arguments set, in order.
        parts: Groups of its configuration.
        tables: Records of its parts, whose settings are listed, too.
    """
    fields, default_values = field_infos(settings), defaults(settings)
    words = [
        each.upper() if default_values[each] is dataclasses.MISSING else f"[{each.upper()}]" for each in positional
    ]
    paragraphs = [
        " ".join(["Usage: stmc", name, *words, "[SETTING=VALUE …]"]),
        described.strip(),
        "Settings, also written --SETTING VALUE, with defaults in brackets:",
        "\n".join(
            _format_entry(each, _describe(fields[each]), default_values[each]) for each in _order_names(settings)
        ),
    ]
    if parts:
        paragraphs.append(
            "Parts, each a configuration file; PART=NAME chooses one, PART.SETTING=VALUE changes a setting of it:"
        )
        paragraphs.append(
            "\n".join(_format_entry(part, ", ".join(names), chosen) for part, (chosen, names) in parts.items())
        )
    paragraphs += [text for part, table in tables.items() for text in _format_part(part, *table)]
    paragraphs.append(
        "--config-dir FOLDER: add a folder of your own configuration files; --config-name NAME: start from NAME.yaml;\n"
        "--cfg: print the configuration and stop."
    )
    paragraphs.append(
        "--multirun SETTING=VALUE,VALUE: run one job per value; hydra/launcher=NAME chooses the launcher."
    )
    return "\n\n".join(paragraphs) + "\n"


def _format_part(part: str, record: type, values: Mapping[str, Any]) -> tuple[str, str]:
    """Return the heading and the settings of a part that is a record."""
    key, current = part.replace("/", "."), defaults(record) | dict(values)
    return (
        f"Settings of {part} (here {record.__name__}), written {key}.SETTING=VALUE, or with a leading plus\n"
        f"if --cfg does not show the setting; --help {part}=NAME lists those of another choice:",
        "\n".join(_format_entry(name, _describe(field), current[name]) for name, field in field_infos(record).items()),
    )


def _order_names(settings: type) -> list[str]:
    """Order the names of the settings: the command's own first, shared ones last."""
    return sorted(field_infos(settings), key=lambda name: name not in settings.__annotations__)


def _describe(field: FieldInfo) -> str:
    unit = f", in {field.unit}" if field.unit and not field.limits else ""
    return f"{field.help}{unit}{f' ({field.fits})' if field.fits != field.unit else ''}"


def _format_entry(name: str, text: str, default: Any) -> str:
    ending = (
        "required" if default is dataclasses.MISSING else textwrap.shorten(_format_value(default), 60, placeholder="…")
    )
    lines = textwrap.wrap(f"{text} [{ending}]", WIDTH - _NAMES, break_on_hyphens=False)
    apart = f"  {name:<{_NAMES - 2}}" if len(name) < _NAMES - 2 else f"  {name}\n{'':{_NAMES}}"
    return apart + f"\n{'':{_NAMES}}".join(lines)


def _format_value(value: Any) -> str:
    """Format a value as it is typed on a command line."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, tuple):
        return f"[{', '.join(map(_format_value, value))}]"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{key}: {_format_value(each)}' for key, each in value.items())}}}"
    return str(value)
