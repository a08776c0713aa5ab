"""What keys of configurations were called before: run directories of earlier versions load all the same.

Knows names; knows no file.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

RENAMED: Mapping[str, str] = {"spread": "noise_scale", "late": "stitch_from", "window": "fixed_length"}
"""Every key that has another name now, wherever it stands in a run directory's config."""


def with_new_names(config: Any) -> Any:
    """A config of plain mappings and lists with today's keys; one that has both keeps today's."""
    if isinstance(config, Mapping):
        inner = {key: with_new_names(value) for key, value in config.items()}
        old = {RENAMED[key]: value for key, value in inner.items() if key in RENAMED}
        return old | {key: value for key, value in inner.items() if key not in RENAMED}
    return [with_new_names(each) for each in config] if isinstance(config, list) else config
