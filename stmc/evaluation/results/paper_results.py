"""Published rows of the papers, for comparison with ours, and the standard table for single texts.

This module knows the records under `assets/published_results`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from importlib.resources import as_file, files

from stmc.evaluation.results.intervals import Estimate
from stmc.evaluation.results.naming import REAL, measures, place, variant
from stmc.evaluation.results.result_records import Result, ResultError, by_setting, read_results
from stmc.evaluation.results.tables import Row, Table

REMARK = "Published rows are taken from the paper, without its intervals."


def published_results(name: str) -> list[Result]:
    """Read the records of a published table, such as "stmc_table_1". Raises `ResultError` for an unknown name."""
    folder = files("stmc") / "assets" / "published_results"
    names = sorted(file.name.removesuffix(".jsonl") for file in folder.iterdir() if file.name.endswith(".jsonl"))
    if name not in names:
        raise ResultError(f"unknown published table {name!r}; choose from {', '.join(names)}")
    with as_file(folder / f"{name}.jsonl") as path:
        return read_results(path)


def with_published(results: Iterable[Result], table: Callable[[Iterable[Result]], Table], published: str) -> Table:
    """Build a table of own results, followed by that of published ones, with the source of each row.

    Args:
        results: Own records.
        table: Function that builds a table of records.
        published: Name of a published table, as in `published_results`.
    """
    own, theirs = table(results), table(published_results(published))
    headings = max(own.headings, theirs.headings, key=len)

    def label_row(source: str, row: Row) -> Row:
        return replace(row, labels=(source, *row.labels, *["–"] * (len(headings) - len(row.labels))))

    blocks = tuple(
        tuple(label_row(source, row) for row in block)
        for source, made in (("ours", own), ("published", theirs))
        for block in made.blocks
    )
    columns = measures(key for block in blocks for row in block for key in row.estimates)
    return Table(f"{own.caption} {REMARK}", ("Source", *headings), columns, blocks)


def single_text_table(results: Iterable[Result]) -> Table:
    """Build the `repetition_table` of the HumanML3D benchmark of single texts."""
    return repetition_table(results, "HumanML3D, single texts")


def repetition_table(results: Iterable[Result], title: str) -> Table:
    """Build a table in the usual form: real motion first, then each denoiser and method.

    Shares of steps with absolute positions have a column if there are any. Means over repetitions are ± 1.96 s / √n,
    where s² divides by n, as in the published evaluations.
    """
    groups = by_setting(results)
    blended = any(setting.sampling.ape_steps is not None for setting in groups)
    rows = []
    for setting, runs in groups.items():
        share = setting.sampling.ape_steps
        labels: tuple[str, ...] = (setting.denoiser or "–", variant(setting))
        labels += ("–" if share is None else f"{share:.1%}",) if blended else ()
        order = (setting.method != REAL, place(setting), setting.denoiser, -1 if share is None else share)
        rows.append((order, Row(labels, _estimates(runs), competes=setting.method != REAL)))
    ordered = tuple(row for _, row in sorted(rows, key=lambda each: each[0]))
    blocks = tuple(block for block in (_select(ordered, False), _select(ordered, True)) if block)
    repetitions = max((len(runs) for runs in groups.values()), default=0)
    caption = f"{title}: means over {repetitions} repetitions ± 95% confidence intervals (1.96 s / √n)."
    columns = measures(key for row in ordered for key in row.estimates)
    headings = ("Denoiser", "Method", *(("APE steps",) if blended else ()))
    return Table(caption, headings, columns, blocks)


def normal_estimate(values: list[float | int]) -> Estimate:
    """Compute the mean ± 1.96 s / √n, where s² divides by n, or no interval for one value.

    Raises `ValueError` for no values.
    """
    if not values:
        raise ValueError("the mean of no values is undefined")
    mean = math.fsum(values) / len(values)
    if len(values) == 1:
        return Estimate(mean, None, 1)
    deviation = math.sqrt(math.fsum((value - mean) ** 2 for value in values) / len(values))
    return Estimate(mean, 1.96 * deviation / math.sqrt(len(values)), len(values))


def _estimates(runs: list[Result]) -> dict[str, Estimate]:
    shared = [name for name in runs[0].metrics if all(name in run.metrics for run in runs)]
    return {name: normal_estimate([run.metrics[name] for run in runs]) for name in shared}


def _select(rows: tuple[Row, ...], competes: bool) -> tuple[Row, ...]:
    return tuple(row for row in rows if row.competes == competes)
