"""The Blender that tests use: the program, or a Python that has its module."""

import importlib.util
import os
import shutil
import sys
from pathlib import Path

PROGRAM = shutil.which("blender")
MODULE = os.environ.get("STMC_BPY") or (sys.executable if importlib.util.find_spec("bpy") else None)
"""A Python with `bpy`, which may need an older NumPy than ours: STMC_BPY names another Python."""

REASON = "no Blender (Debian: apt-get install blender; or STMC_BPY=a Python with `pip install bpy`)"


def command(script: Path) -> list[str] | None:
    """What runs a script in Blender, None where there is none."""
    if MODULE:
        return [MODULE, str(script), "--"]
    return [PROGRAM, "--background", "--factory-startup", "--python", str(script), "--"] if PROGRAM else None
