"""Benchmarks: what models are asked for, and how good what comes is. See `protocol`."""

from stmc.benchmarks.protocol import Benchmark, Scores, TextJudge

__all__ = ["Benchmark", "Scores", "TextJudge"]
