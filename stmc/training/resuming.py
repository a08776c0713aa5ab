"""Compare the settings of a resumed run with those that it began with."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from stmc.io.untrusted import truncate

MAY_CHANGE = (
    *("run", "data.folder", "data.preparation", "text_cache"),  # paths; their contents have a fingerprint
    *("device", "threads", "training.compile", "trusted"),  # the machine, and trusted code
    *("training.steps", "training.log_every", "training.validate_every", "training.checkpoint_every", "training.keep"),
    *(
        "draw",
        "draw_every",
        "noise_scale",
        "guidance",
        "allow_changed_settings",
    ),  # the use of the weights, not their training
)
"""Settings, including nested ones, that may change in a resumed run: they affect no step's result.

`training.steps` is among them, since steps depend on the end of the learning rate's decay, `training.lr_decay_steps`,
instead.
"""


class SettingsChanged(ValueError):
    """Error for resuming a run that began with other settings; the message names each with both values."""


def deciding_settings(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings that affect the result of a run by their paths, such as `data.sampling.rows`."""
    return {
        path: value
        for path, value in _flat(settings, "").items()
        if not any(path == free or path.startswith(f"{free}.") for free in MAY_CHANGE)
    }


def differences(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """List `path: old → new` for each setting that differs."""
    return [
        f"{path}: {truncate(str(old.get(path, 'absent')))} → {truncate(str(new.get(path, 'absent')))}"
        for path in dict.fromkeys((*old, *new))
        if path not in old or path not in new or old[path] != new[path]
    ]


def _flat(node: Any, path: str) -> dict[str, Any]:
    if isinstance(node, Mapping) and node:
        below = (_flat(value, f"{path}.{key}" if path else str(key)) for key, value in node.items())
        return {name: value for found in below for name, value in found.items()}
    return {path: node}
