"""Whether a run goes on as what it was begun as: the settings of the two are compared, one by one.

Knows settings as nested plain data; knows not what they mean.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from stmc.io.untrusted import cut

MAY_CHANGE = (
    *("run", "data.folder", "data.preparation", "text_cache"),  # places: what lies there has a fingerprint
    *("device", "threads", "training.compile", "trusted"),  # the machine, and whose code may run there
    *("training.steps", "training.log_every", "training.validate_every", "training.checkpoint_every", "training.keep"),
    *(
        "draw",
        "draw_every",
        "noise_scale",
        "guidance",
        "allow_changed_settings",
    ),  # what is done with the weights, not what they become
)
"""The settings (and all below them) that a resumed run may have otherwise: they change no step's outcome.

`training.steps` is among them, since what the steps depend on is where the learning rate's fall ends:
`training.lr_decay_steps`.
"""


class SettingsChanged(ValueError):
    """A run cannot go on, since it was begun with other settings; the message names each with both values."""


def deciding(settings: Mapping[str, Any]) -> dict[str, Any]:
    """The settings that decide what a run becomes, each under its path: `data.sampling.rows`."""
    return {
        path: value
        for path, value in _flat(settings, "").items()
        if not any(path == free or path.startswith(f"{free}.") for free in MAY_CHANGE)
    }


def differences(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """`path: old → new` for each setting that differs."""
    return [
        f"{path}: {cut(str(old.get(path, 'absent')))} → {cut(str(new.get(path, 'absent')))}"
        for path in dict.fromkeys((*old, *new))
        if path not in old or path not in new or old[path] != new[path]
    ]


def _flat(node: Any, path: str) -> dict[str, Any]:
    if isinstance(node, Mapping) and node:
        below = (_flat(value, f"{path}.{key}" if path else str(key)) for key, value in node.items())
        return {name: value for found in below for name, value in found.items()}
    return {path: node}
