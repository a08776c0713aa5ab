"""The checkpoints that others published, as models of this library: STMC's, MDM's and MotionDiffuse's."""

from stmc.published.checkpoint import CheckpointError
from stmc.published.conversion import convert, read

__all__ = ["CheckpointError", "convert", "read"]
