"""Motion editing: partial regeneration (`changes`), and new motions derived from recorded ones, with another path or
pace, turned on the spot, or one after the other.

Depends on timelines, motions and the body; independent of features and sampling.
"""

from stmc.editing.changes import BORDER, Change, Kept, changed_prompt, changed_prompts, move_to_body
from stmc.editing.paths import bend_path, change_pace, reverse, shift_sideways
from stmc.editing.posture import FootKey, PelvisKey, TurnKey, bend_down, shift_pelvis, step, turn_head, turn_trunk
from stmc.editing.reaching import Oscillation, WristKey, body_frame, copy_arm, reach
from stmc.editing.resting import add_rest, follow
from stmc.editing.turning import turn_on_spot

__all__ = [
    "BORDER",
    "Change",
    "FootKey",
    "Kept",
    "Oscillation",
    "PelvisKey",
    "TurnKey",
    "WristKey",
    "add_rest",
    "bend_down",
    "bend_path",
    "body_frame",
    "change_pace",
    "changed_prompt",
    "changed_prompts",
    "copy_arm",
    "follow",
    "move_to_body",
    "reach",
    "reverse",
    "shift_pelvis",
    "shift_sideways",
    "step",
    "turn_head",
    "turn_on_spot",
    "turn_trunk",
]
