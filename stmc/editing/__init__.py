"""Editing motions: partial regeneration (`changes`), and new motions made from recorded ones.

Knows timelines, motions and the body; knows no features and no sampling.
"""

from stmc.editing.changes import BORDER, Change, Kept, changed_prompt, changed_prompts, on_body

__all__ = ["BORDER", "Change", "Kept", "changed_prompt", "changed_prompts", "on_body"]
