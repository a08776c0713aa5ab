"""Published models and evaluators: importers for STMC, MDM, FlowMDM, MotionDiffuse, TMR and Guo et al."""

from stmc.run.published.conversion import convert, read
from stmc.run.published.import_evaluators import read_guo, read_guo_evaluator
from stmc.run.published.torch_checkpoint import CheckpointError

__all__ = ["CheckpointError", "convert", "read", "read_guo", "read_guo_evaluator"]
