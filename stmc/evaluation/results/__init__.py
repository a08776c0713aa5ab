"""Results of experiments: records of measurements and settings, and their tables and charts.

This package knows names and numbers; it knows no motion, no model and no formula of a metric. It does not import
`stmc.evaluation.results.charts`, so that reading and writing records does not import matplotlib.
"""

from stmc.evaluation.results.intervals import Estimate, estimate
from stmc.evaluation.results.paper_results import published_results, repetition_table, single_text_table, with_published
from stmc.evaluation.results.result_records import Result, ResultError, by_setting, read_results, write_results
from stmc.evaluation.results.tables import Table, comparison_table, sweep_table

__all__ = [
    "Estimate",
    "Result",
    "ResultError",
    "Table",
    "by_setting",
    "comparison_table",
    "estimate",
    "published_results",
    "read_results",
    "repetition_table",
    "single_text_table",
    "sweep_table",
    "with_published",
    "write_results",
]
