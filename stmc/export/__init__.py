"""Motions as files: AMASS-like `.npz` and `.bvh`. Knows nothing of models, timelines or pictures."""

from stmc.export.files import read, write

__all__ = ["read", "write"]
