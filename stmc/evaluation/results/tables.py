"""The papers' tables as text and LaTeX: means ± 95 % intervals, with the best value of each column marked.

This module knows rows and columns; `intervals` computes means and intervals.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain

from stmc.composing.sampling import INDEPENDENT
from stmc.evaluation.results.intervals import Estimate, estimates
from stmc.evaluation.results.naming import REAL, SETTINGS, Measure, measures, method_row, place, variant
from stmc.evaluation.results.result_records import (
    Result,
    ResultError,
    Setting,
    by_setting,
    check_only_varied,
    difference,
)

_SPECIAL = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "–": "--",
    "±": r"$\pm$",
} | {sign: f"\\{sign}" for sign in "&%$#_{}"}


@dataclass(frozen=True)
class Row:
    """Labels and estimates of a row. Only rows that compete can be the best; real motion does not compete."""

    labels: tuple[str, ...]
    estimates: Mapping[str, Estimate]
    competes: bool = True


@dataclass(frozen=True)
class Table:
    """Blocks of rows; in each block, the best mean of a column is marked, with all that are equal when rounded."""

    caption: str
    headings: tuple[str, ...]
    measures: tuple[Measure, ...]
    blocks: tuple[tuple[Row, ...], ...]

    def text(self) -> str:
        """Format the table as aligned columns; a * marks the best values."""
        heads = [*self.headings, *(f"{self._heading(each)} {each.arrow} " for each in self.measures)]
        bodies = [[[*row.labels, *self._cells(block, row, _plain)] for row in block] for block in self.blocks]
        wide = [max(len(cells[column]) for cells in chain([heads], *bodies)) for column in range(len(heads))]
        rule = "-" * (sum(wide) + 2 * (len(wide) - 1))
        lines = [self.caption, rule, _line(heads, wide, len(self.headings))]
        for body in bodies:
            lines += [rule, *(_line(cells, wide, len(self.headings)) for cells in body)]
        return "\n".join([*lines, rule]) + "\n"

    def latex(self) -> str:
        """Format the table as a LaTeX `table`, which needs booktabs; the best values are bold."""
        arrows = {"higher": r"$\uparrow$", "lower": r"$\downarrow$", "real": r"$\rightarrow$"}
        heads = [_escaped(name) for name in self.headings]
        heads += [f"{_escaped(self._heading(each))} {arrows[each.better]}" for each in self.measures]
        lines = [r"\begin{table}", r"\centering", rf"\begin{{tabular}}{{{'l' * len(self.headings)}"]
        lines[-1] += "c" * len(self.measures) + "}"
        lines += [r"\toprule", _latex_line(heads)]
        for block in self.blocks:
            lines.append(r"\midrule")
            for row in block:
                cells = self._cells(block, row, _typeset)
                lines.append(_latex_line([*(_escaped(label) for label in row.labels), *cells]))
        lines += [r"\bottomrule", r"\end{tabular}", rf"\caption{{{_escaped(self.caption)}}}", r"\end{table}"]
        return "\n".join(lines) + "\n"

    def _heading(self, measure: Measure) -> str:
        """Return the heading of a measure, with its unit and its chance level if known."""
        levels = [row.estimates[measure.chance].mean for row in chain(*self.blocks) if measure.chance in row.estimates]
        chance = f"by chance {measure.format(sum(levels) / len(levels))}" if levels else ""
        behind = "; ".join(filter(None, (measure.unit, chance)))
        return f"{measure.heading} ({behind})" if behind else measure.heading

    def _cells(self, block: Sequence[Row], row: Row, show) -> list[str]:
        return [
            show(measure, row.estimates[measure.key], row.competes and _is_best(block, row, measure))
            if measure.key in row.estimates
            else "–"
            for measure in self.measures
        ]


def comparison_table(results: Iterable[Result]) -> Table:
    """Build Table 1 of STMC: a block for the ground truth and one per denoiser, with methods in the paper's order.

    Different starts of stitching have a row each. Raises `ResultError` if a method of a denoiser has several settings
    otherwise.
    """
    groups = by_setting(results)
    _check_unambiguous(groups)
    blocks: dict[str, list[tuple[tuple[int, float], Row]]] = {}
    for setting, runs in groups.items():
        shown = method_row(setting.method)
        labels = (setting.denoiser or "–", variant(setting), shown.tracks, shown.crops)
        row = Row(labels, estimates(runs), competes=setting.method not in (REAL, INDEPENDENT))
        blocks.setdefault("" if setting.method == REAL else setting.denoiser, []).append((place(setting), row))
    ordered = sorted(blocks.items(), key=lambda block: block[0] != "")
    rows = tuple(tuple(row for _, row in sorted(block, key=lambda each: each[0])) for _, block in ordered)
    headings = ("Denoiser", "Method", "#tracks", "#crops")
    return _table("Comparison with baselines", headings, rows, groups)


def sweep_table(results: Iterable[Result], varied: Sequence[str]) -> Table:
    """Build a table with a row per value of the settings `varied` (names of `SETTINGS`); Table A.1 varies the overlap.

    Raises `ResultError` for an unknown setting, for records that differ in other settings, and if no record has one.
    """
    if unknown := [name for name in varied if name not in SETTINGS]:
        raise ResultError(f"unknown setting {unknown[0]!r}; choose from {', '.join(SETTINGS)}")
    groups = by_setting(result for result in results if any(result.setting.value(name) is not None for name in varied))
    if not groups:
        raise ResultError(f"no record has {' or '.join(varied)}")
    check_only_varied(groups, varied)
    rows = [
        Row(tuple(_value(setting.value(name)) for name in varied), estimates(runs))
        for setting, runs in sorted(groups.items(), key=lambda group: _order(group[0], varied))
    ]
    names = [SETTINGS[name] for name in varied]
    headings = tuple(name[0].upper() + name[1:] for name in names)
    return _table(f"Influence of {' and '.join(names)}", headings, (tuple(rows),), groups)


def _order(setting: Setting, varied: Sequence[str]) -> tuple:
    """Return the sort key of a setting: unset values first, numbers by value, names alphabetically."""
    values = (setting.value(name) for name in varied)
    return tuple((value is not None, value or 0) if not isinstance(value, str) else (True, value) for value in values)


def _value(value: str | float | int | None) -> str:
    return "–" if value is None else value if isinstance(value, str) else f"{value:g}"


def _check_unambiguous(groups: Mapping[Setting, Sequence[Result]]) -> None:
    seen: dict[tuple[str, str, float | int | None], Setting] = {}
    for setting in groups:
        other = seen.setdefault((setting.denoiser, setting.method, setting.sampling.stitch_from), setting)
        if other != setting:
            name = f"{setting.method} of {setting.denoiser or 'no denoiser'}"
            raise ResultError(f"{name} has several settings, {difference(other, setting)}; choose one")


def _table(
    subject: str, headings: tuple[str, ...], blocks: tuple[tuple[Row, ...], ...], groups: Mapping[Setting, Sequence]
) -> Table:
    columns = measures(key for block in blocks for row in block for key in row.estimates)
    counts = sorted({len(runs) for setting, runs in groups.items() if setting.method != REAL})
    seeds = " to ".join(str(count) for count in dict.fromkeys([*counts[:1], *counts[-1:]]))
    one = counts[-1:] in ([], [1])
    means = "one seed each" if one else f"means over {seeds} seeds"
    made = [estimates(runs) for setting, runs in groups.items() if setting.method != REAL]
    return Table(f"{subject}: {means}{_interval(made, columns, one)}.", headings, columns, blocks)


def _interval(made: Sequence[Mapping[str, Estimate]], columns: Sequence[Measure], one: bool) -> str:
    """Describe the intervals of a table, and the columns with other ones."""
    if any(found.of_too_few for row in made for found in row.values()):
        return ", of too few timelines for intervals or ranks"
    kinds = {each: {row[each.key].bootstrapped for row in made if each.key in row} for each in columns}
    if not any(True in found for found in kinds.values()):
        return "" if one else " ± 95% confidence intervals (t distribution)"
    text = f" ± 95% confidence intervals (bootstrap over timelines{'' if one else ' and seeds'}"
    if alone := [each for each, found in kinds.items() if found == {False}]:
        text += (
            f"; {', '.join(each.heading for each in alone)}: {'none' if one else 'over seeds alone, t distribution'}"
        )
    if mixed := [each for each, found in kinds.items() if len(found) > 1]:
        text += f"; {', '.join(each.heading for each in mixed)}: some rows {'without' if one else 'over seeds alone'}"
    return f"{text})"


def _is_best(block: Sequence[Row], row: Row, measure: Measure) -> bool:
    if measure.better == "real":
        return False  # readers compare with real motion, which is in the table
    compared = [other.estimates[measure.key] for other in block if other.competes and measure.key in other.estimates]
    if any(each.of_too_few for each in compared):
        return False
    means = [float(measure.format(estimate.mean)) for estimate in compared]
    best = max(means) if measure.better == "higher" else min(means)
    return len(means) > 1 and float(measure.format(row.estimates[measure.key].mean)) == best


def _plain(measure: Measure, value: Estimate, best: bool) -> str:
    half = "" if value.half is None else f" ± {measure.format(value.half)}"
    return f"{measure.format(value.mean)}{half}{'*' if best else ' '}"


def _typeset(measure: Measure, value: Estimate, best: bool) -> str:
    mean = measure.format(value.mean)
    marked = rf"\mathbf{{{mean}}}" if best else mean
    return f"${marked}$" if value.half is None else rf"${marked} \pm {measure.format(value.half)}$"


def _line(cells: Sequence[str], wide: Sequence[int], labels: int) -> str:
    aligned = [
        f"{cell:<{w}}" if n < labels else f"{cell:>{w}}" for n, (cell, w) in enumerate(zip(cells, wide, strict=True))
    ]
    return "  ".join(aligned).rstrip()


def _latex_line(cells: Sequence[str]) -> str:
    return " & ".join(cells) + r" \\"


def _escaped(text: str) -> str:
    return "".join(_SPECIAL.get(sign, sign) for sign in text)
