"""`config.yaml` as plain data: numbers, texts, lists and mappings only.

Depends on YAML and rejects hostile files; independent of the parts of a model.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from stmc.settings.records import quote

LARGEST, DEEPEST = 2**16, 16
"""Maximum size of a config in bytes, and maximum depth of nested collections. Real configs have a thousand bytes and
four levels."""
LONGEST_TEXT, LARGEST_NUMBER = 1000, 2**31
TARGET, PARTIAL = "_target_", "_partial_"


class RunError(ValueError):
    """A folder that is not a run directory, or a damaged one; the message names the file and the problem."""


class _Loader(yaml.SafeLoader):
    """A loader with unique text keys; `1e-5` is a number, as in YAML 1.2, and a date is a text."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[str, Any]:
        mapping: dict[str, Any] = {}
        for key_node, value_node in node.value:
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, str):
                raise RunError(f"line {key_node.start_mark.line + 1}: the key {quote(key)} is not a text")
            if key in mapping:
                raise RunError(f"line {key_node.start_mark.line + 1}: {quote(key)} is duplicated")
            mapping[key] = self.construct_object(value_node, deep=True)
        return mapping


_REPLACED_TAGS = ("tag:yaml.org,2002:float", "tag:yaml.org,2002:timestamp")
_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if tag not in _REPLACED_TAGS]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_FLOAT = re.compile(
    r"[-+]?(?:\d[\d_]*\.[\d_]*(?:[eE][-+]?\d+)?|\d[\d_]*[eE][-+]?\d+|\.\d[\d_]*(?:[eE][-+]?\d+)?|\.(?:inf|Inf|INF))$"
    r"|\.(?:nan|NaN|NAN)$"
)
_Loader.add_implicit_resolver(_REPLACED_TAGS[0], _FLOAT, list("-+0123456789."))


class _Dumper(yaml.SafeDumper):
    """A dumper for `_Loader`: it quotes texts that look like numbers, and never writes an alias."""

    yaml_implicit_resolvers = _Loader.yaml_implicit_resolvers

    def ignore_aliases(self, data: object) -> bool:
        return True


def read_config(path: Path) -> dict[str, Any]:
    """Read the plain data of a YAML file.

    Raises:
        RunError: If the file is damaged, too large or too deep, or has anchors, aliases, tags, interpolations,
            duplicate keys, keys with a leading `_` other than `_target_`, or missing values.
    """
    try:
        with path.open("rb") as file:
            data = file.read(LARGEST + 1)
        if len(data) > LARGEST:
            raise RunError(f"more than {LARGEST} bytes")
        text = data.decode("utf-8-sig")
        _check_syntax(text)
        config = yaml.load(text, _Loader)
        if not isinstance(config, dict):
            raise RunError(f"it must hold settings by name, not {quote(config)}")
        check_plain(config)
    except RunError as error:
        raise RunError(f"{path}: {error}") from error
    except (yaml.YAMLError, OSError, ValueError) as error:
        raise RunError(f"{path} cannot be read: {brief(error)}") from error
    return config


def config_text(config: Mapping[str, Any]) -> str:
    """Format plain data as YAML. Raises `RunError` if `read_config` would reject it."""
    check_plain(config)
    text = yaml.dump(config, Dumper=_Dumper, sort_keys=False, allow_unicode=True)
    if len(text.encode()) > LARGEST:
        raise RunError(f"the config has more than {LARGEST} bytes")
    return text


def check_plain(value: Any, place: str = "", depth: int = 0) -> None:
    """Raise `RunError` unless a value consists of numbers, texts, booleans, null and nested lists and mappings.

    Args:
        value: The value.
        place: Path of the value, for messages.
        depth: Depth of the value, at most `DEEPEST`.
    """
    if depth > DEEPEST:
        raise RunError(f"{quote(place)}: more than {DEEPEST} levels of nested collections")
    if isinstance(value, Mapping):
        for key, inner in value.items():
            _check_key(key, place)
            check_plain(inner, f"{place}.{key}" if place else key, depth + 1)
    elif isinstance(value, list):
        for position, inner in enumerate(value):
            check_plain(inner, f"{place}[{position}]", depth + 1)
    elif isinstance(value, str):
        _check_text(value, place)
    elif isinstance(value, (int, float)):
        if not abs(value) <= LARGEST_NUMBER:  # also true for NaN
            raise RunError(
                f"{place}={quote(value)}: must be a finite number with absolute value at most {LARGEST_NUMBER}"
            )
    elif value is not None:
        raise RunError(f"{place} must be a number, a text or a list, not a {type(value).__name__}")


def _check_key(key: Any, place: str) -> None:
    prefix = f"{place}: " if place else ""
    if not isinstance(key, str):
        raise RunError(f"{prefix}the key {quote(key)} is not a text")
    _check_text(key, place)
    if key.startswith("_") and key != TARGET:
        raise RunError(f"{prefix}the key {quote(key)} is invalid: only {TARGET} may begin with an underscore")


def _check_text(text: str, place: str) -> None:
    if "${" in text:
        raise RunError(
            f"{place}={quote(text)}: a run directory does not resolve interpolations; write the value itself"
        )
    if text == "???":
        raise RunError(f"{place} has no value (???)")
    if len(text) > LONGEST_TEXT or not text.isprintable():
        raise RunError(f"{place}={quote(text)}: must have at most {LONGEST_TEXT} characters, all of them printable")


def _check_syntax(text: str) -> None:
    """Reject aliases, which multiply, tags, which name types, and deep nesting, which exhausts the stack."""
    depth = 0
    for event in yaml.parse(text, _Loader):
        line = event.start_mark.line + 1
        if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None) is not None:
            raise RunError(f"line {line}: anchors and aliases are not allowed")
        if getattr(event, "tag", None) is not None:
            raise RunError(f"line {line}: the tag {quote(event.tag)} is not allowed")
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > DEEPEST:
            raise RunError(f"line {line}: more than {DEEPEST} levels of nested collections")


def brief(error: BaseException) -> str:
    """Shorten the message of an error to one line of at most 200 characters."""
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= 200 else f"{text[:199]}…"
