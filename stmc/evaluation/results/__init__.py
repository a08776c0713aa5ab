"""Results of experiments: what was measured under which settings, and the tables and charts that are made of them.

Knows names and numbers; knows no motion, no model and no metric's formula. `stmc.evaluation.results.charts` is not
imported here: what only reads and writes records need not wait for what draws.
"""

from stmc.evaluation.results.intervals import Estimate, estimate
from stmc.evaluation.results.paper_results import (
    published_results,
    repetition_table,
    single_text_table,
    with_published,
)
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
