"""Editing motions: partial regeneration (`changes`), and new motions made from recorded ones.

Knows timelines, motions and the body; knows no features and no sampling.
"""

from stmc.editing.changes import BORDER, Change, Kept, changed_prompt, changed_prompts, on_body
from stmc.editing.posture import FootKey, PelvisKey, TurnKey, bend_down, shift_pelvis, step, turn_head, turn_trunk
from stmc.editing.reaching import Oscillation, WristKey, body_frame, copy_arm, reach

__all__ = [
    "BORDER",
    "Change",
    "FootKey",
    "Kept",
    "Oscillation",
    "PelvisKey",
    "TurnKey",
    "WristKey",
    "bend_down",
    "body_frame",
    "changed_prompt",
    "changed_prompts",
    "copy_arm",
    "on_body",
    "reach",
    "shift_pelvis",
    "step",
    "turn_head",
    "turn_trunk",
]
