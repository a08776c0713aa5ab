"""Foot cleanup: detection of contacts, locking of feet, and bending of legs.

Depends on the geometry of legs; independent of features, models and texts.
"""

from stmc.motion.feet.cleaning import clean_feet

__all__ = ["clean_feet"]
