"""Metrics of motions: realism, retrieval, matching, smoothness, and the metrics of whole timelines."""

from stmc.evaluation.metrics.matching_metrics import matching_score, multimodality, r_precision
from stmc.evaluation.metrics.realism import fid, frechet_distance
from stmc.evaluation.metrics.retrieval import Retrieval, cosines, ranks, t2m_m2t
from stmc.evaluation.metrics.smoothness import jerk, peak_jerk, transition_distance

__all__ = [
    "Retrieval",
    "cosines",
    "fid",
    "frechet_distance",
    "jerk",
    "matching_score",
    "multimodality",
    "peak_jerk",
    "r_precision",
    "ranks",
    "t2m_m2t",
    "transition_distance",
]
