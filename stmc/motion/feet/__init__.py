"""Feet that stand: contacts found, feet locked, legs bent to where they are.

Knows the geometry of legs; knows no features, no model and no text.
"""

from stmc.motion.feet.cleaning import clean_feet

__all__ = ["clean_feet"]
