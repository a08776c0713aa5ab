"""What others published, as models and evaluators: STMC's, MDM's, FlowMDM's, MotionDiffuse's, TMR's and Guo's."""

from stmc.published.checkpoint import CheckpointError
from stmc.published.conversion import convert, read
from stmc.published.evaluators import read_guo, read_guo_evaluator

__all__ = ["CheckpointError", "convert", "read", "read_guo", "read_guo_evaluator"]
