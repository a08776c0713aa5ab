"""Motions as files for other software. Knows nothing of models or pictures; a timeline goes along as it is."""

from stmc.formats.motion_files import read, write

__all__ = ["read", "write"]
