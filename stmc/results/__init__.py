"""Results of experiments: what was measured under which settings, and the tables and charts that are made of them.

Knows names and numbers; knows no motion, no model and no metric's formula.
"""

from stmc.results.charts import bars, overlap_sweep, quality_against_cost
from stmc.results.estimates import Estimate, estimate
from stmc.results.records import Result, ResultError, by_setting, read_results, write_results
from stmc.results.tables import Table, comparison_table, overlap_table

__all__ = [
    "Estimate",
    "Result",
    "ResultError",
    "Table",
    "bars",
    "by_setting",
    "comparison_table",
    "estimate",
    "overlap_sweep",
    "overlap_table",
    "quality_against_cost",
    "read_results",
    "write_results",
]
