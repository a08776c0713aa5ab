"""Benchmarks: requests to models, and the quality of the results. See `benchmark_protocol`."""

from stmc.evaluation.benchmarks.benchmark_protocol import Benchmark, Scores, TextEvaluator
from stmc.evaluation.benchmarks.compositions import Compositions
from stmc.evaluation.benchmarks.mtt_timelines import MttOpen, mtt_open
from stmc.evaluation.benchmarks.multi_track import MultiTrack, open_mtt, published_mtt
from stmc.evaluation.benchmarks.published_compositions import PublishedCompositions
from stmc.evaluation.benchmarks.single_text import SingleText

__all__ = [
    "Benchmark",
    "Compositions",
    "MttOpen",
    "MultiTrack",
    "PublishedCompositions",
    "Scores",
    "SingleText",
    "TextEvaluator",
    "mtt_open",
    "open_mtt",
    "published_mtt",
]
