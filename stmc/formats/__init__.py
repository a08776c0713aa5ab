"""Motion files for other software, with the timeline where a format allows it. Independent of models and rendering."""

from stmc.formats.motion_files import FORMATS, READABLE, Format, format_of, read, write, write_as

__all__ = ["FORMATS", "READABLE", "Format", "format_of", "read", "write", "write_as"]
