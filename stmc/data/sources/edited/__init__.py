"""Motions of actions that no open recording shows, made by editing recordings: one recipe per action."""

from stmc.data.sources.edited import arm_gestures as gestures
from stmc.data.sources.edited import idling, jumping, kicking, locomotion

RECIPES = (*locomotion.RECIPES, *jumping.RECIPES, *kicking.RECIPES, *idling.RECIPES, *gestures.RECIPES)
"""All recipes, in the order of the data set."""
