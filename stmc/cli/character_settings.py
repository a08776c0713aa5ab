"""The `character` and `joint_map` settings of `stmc sample`."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console

import stmc
from stmc.settings.records import SettingError

_REASONS = {"vrm": "has no humanoid map of VRM", "vrma": "is a robot, whose motions are tables"}
"""Why a character cannot be written in a format that our own body does not have."""


def read_settings_character(
    path: str | None, joint_map: str | None, formats: Sequence[str] | None, console: Console
) -> stmc.Character | None:
    """Read the character of the settings and print its joint map.

    Args:
        path: File of the character; None: no character.
        joint_map: File that corrects the joint map; None: the map that is found.
        formats: Formats of the motions; None: those that suit the character.
        console: Console to print to.

    Returns:
        The character, or None without one.

    Raises:
        SettingError: If no format shows the character, if one cannot be written of it, or if one needs a character and
            there is none.
    """
    if path is None:
        if {"vrm", "vrma"} & set(formats or ()) or joint_map is not None:
            raise SettingError("formats=vrm, formats=vrma and joint_map need a character: character=hero.vrm")
        return None
    character = stmc.read_character(path, joint_map)
    kinds = [suffix[1:] for suffix in character.formats]
    asked = kinds if formats is None else formats
    if not set(kinds) & set(asked):
        raise SettingError(f"character={path}: none of these formats shows it; add one of {', '.join(kinds)}")
    for kind, reason in _REASONS.items():
        if kind in asked and kind not in kinds:
            raise SettingError(f"formats={kind}: {path} {reason}; choose from {', '.join(kinds)}")
    console.print(f"{path}: joints found by {character.found_by}", markup=False)
    for joint, name in character.joint_map.items():
        console.print(f"  {joint}: {name}", markup=False)
    return character
