"""Motions as files for other software. Knows nothing of models or pictures; a timeline goes along as it is."""

from stmc.formats.motion_files import FORMATS, READABLE, Format, format_of, read, write, write_as

__all__ = ["FORMATS", "READABLE", "Format", "format_of", "read", "write", "write_as"]
