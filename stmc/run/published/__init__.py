"""What others published, as models and evaluators: STMC's, MDM's, FlowMDM's, MotionDiffuse's, TMR's and Guo's."""

from stmc.run.published.conversion import convert, read
from stmc.run.published.import_evaluators import read_guo, read_guo_evaluator
from stmc.run.published.torch_checkpoint import CheckpointError

__all__ = ["CheckpointError", "convert", "read", "read_guo", "read_guo_evaluator"]
