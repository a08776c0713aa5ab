"""Benchmarks: what models are asked for, and how good what comes is. See `protocol`."""

from stmc.benchmarks.compositions import Compositions
from stmc.benchmarks.mtt_timelines import MttOpen, mtt_open
from stmc.benchmarks.multi_track import MultiTrack, open_mtt, published_mtt
from stmc.benchmarks.protocol import Benchmark, Scores, TextEvaluator
from stmc.benchmarks.published_compositions import PublishedCompositions
from stmc.benchmarks.single_text import SingleText

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
