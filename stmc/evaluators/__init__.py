"""Evaluators of motion: networks that embed motions and texts in one space, for retrieval and realism."""

from stmc.evaluators.evaluator import Evaluator
from stmc.evaluators.guo import GuoEvaluator
from stmc.evaluators.matching_scores import MatchingEvaluator
from stmc.evaluators.tmr import Posterior, Tmr

__all__ = [
    "Evaluator",
    "GuoEvaluator",
    "MatchingEvaluator",
    "Posterior",
    "Tmr",
]
