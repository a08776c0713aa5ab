"""Metrics, benchmarks, tables of results, and the perceptual study."""

from lazy_loader import attach

__getattr__, __dir__, __all__ = attach(
    __name__, submodules=["benchmarks", "metrics", "results", "study", "verification"]
)
