"""Editing motions: partial regeneration (`changes`), and new motions made from recorded ones: on other paths, at
another pace, turned on the spot, one behind the other.

Knows timelines, motions and the body; knows no features and no sampling.
"""

from stmc.editing.changes import BORDER, Change, Kept, changed_prompt, changed_prompts, on_body
from stmc.editing.paths import bend_path, change_pace, reverse, shift_sideways
from stmc.editing.resting import add_rest, follow
from stmc.editing.turning import turn_on_spot

__all__ = [
    "BORDER",
    "Change",
    "Kept",
    "add_rest",
    "bend_path",
    "change_pace",
    "changed_prompt",
    "changed_prompts",
    "follow",
    "on_body",
    "reverse",
    "shift_sideways",
    "turn_on_spot",
]
