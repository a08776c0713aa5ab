"""The paper's tables from records, as text and LaTeX: means ± 95 % intervals, each column's best marked.

Knows rows and columns; how a mean and its interval are found is `intervals`' matter.
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
    difference,
    refuse_other_differences,
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
    """Labels on the left, numbers on the right. Only rows that compete can be the best: real motion does not."""

    labels: tuple[str, ...]
    estimates: Mapping[str, Estimate]
    competes: bool = True


@dataclass(frozen=True)
class Table:
    """Blocks of rows; the best mean of a column is marked in each block, all that look the same when rounded."""

    caption: str
    headings: tuple[str, ...]
    measures: tuple[Measure, ...]
    blocks: tuple[tuple[Row, ...], ...]

    def text(self) -> str:
        """Aligned columns; the best have a *."""
        heads = [*self.headings, *(f"{self._heading(each)} {each.arrow} " for each in self.measures)]
        bodies = [[[*row.labels, *self._cells(block, row, _plain)] for row in block] for block in self.blocks]
        wide = [max(len(cells[column]) for cells in chain([heads], *bodies)) for column in range(len(heads))]
        rule = "-" * (sum(wide) + 2 * (len(wide) - 1))
        lines = [self.caption, rule, _line(heads, wide, len(self.headings))]
        for body in bodies:
            lines += [rule, *(_line(cells, wide, len(self.headings)) for cells in body)]
        return "\n".join([*lines, rule]) + "\n"

    def latex(self) -> str:
        """A `table` that needs the package booktabs; the best are bold."""
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
        """With the unit, and with what would be there by chance, where the rows say it."""
        levels = [row.estimates[measure.chance].mean for row in chain(*self.blocks) if measure.chance in row.estimates]
        told = f"by chance {measure.shown(sum(levels) / len(levels))}" if levels else ""
        behind = "; ".join(filter(None, (measure.unit, told)))
        return f"{measure.heading} ({behind})" if behind else measure.heading

    def _cells(self, block: Sequence[Row], row: Row, show) -> list[str]:
        return [
            show(measure, row.estimates[measure.key], row.competes and _is_best(block, row, measure))
            if measure.key in row.estimates
            else "–"
            for measure in self.measures
        ]


def comparison_table(results: Iterable[Result]) -> Table:
    """Table 1: a block for the ground truth and one for each denoiser, its methods in the paper's order; a method that
    stitches from several moments on has a row for each.

    Raises `ResultError` where a denoiser has a method with several other settings: a comparison is of one each.
    """
    groups = by_setting(results)
    _refuse_ambiguous(groups)
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
    """A row for each of the values that the settings `varied` take (names of `SETTINGS`), with everything else
    the same; varied by the overlap it is Table A.1.

    Raises `ResultError` for a name that is no setting's, for records that differ in others, and for none that has one.
    """
    if unknown := [name for name in varied if name not in SETTINGS]:
        raise ResultError(f"unknown setting {unknown[0]!r}; choose from {', '.join(SETTINGS)}")
    groups = by_setting(result for result in results if any(result.setting.value(name) is not None for name in varied))
    if not groups:
        raise ResultError(f"no record has {' or '.join(varied)}")
    refuse_other_differences(groups, varied)
    rows = [
        Row(tuple(_value(setting.value(name)) for name in varied), estimates(runs))
        for setting, runs in sorted(groups.items(), key=lambda group: _order(group[0], varied))
    ]
    names = [SETTINGS[name] for name in varied]
    headings = tuple(name[0].upper() + name[1:] for name in names)
    return _table(f"Influence of {' and '.join(names)}", headings, (tuple(rows),), groups)


def _order(setting: Setting, varied: Sequence[str]) -> tuple:
    """Numbers by value, names by the alphabet, what is not said first."""
    values = (setting.value(name) for name in varied)
    return tuple((value is not None, value or 0) if not isinstance(value, str) else (True, value) for value in values)


def _value(value: str | float | int | None) -> str:
    return "–" if value is None else value if isinstance(value, str) else f"{value:g}"


def _refuse_ambiguous(groups: Mapping[Setting, Sequence[Result]]) -> None:
    seen: dict[tuple[str, str, float | int | None], Setting] = {}
    for setting in groups:
        other = seen.setdefault((setting.denoiser, setting.method, setting.sampling.stitch_from), setting)
        if other != setting:
            name = f"{setting.method} of {setting.denoiser or 'no denoiser'}"
            raise ResultError(f"{name} is there with {difference(other, setting)}; choose one")


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
    """What ± is, in words, and of which columns it is something else."""
    if any(found.of_too_few for row in made for found in row.values()):
        return ", of too few timelines for intervals or ranks"
    kinds = {each: {row[each.key].bootstrapped for row in made if each.key in row} for each in columns}
    if not any(True in found for found in kinds.values()):
        return "" if one else " ± 95% confidence intervals (t distribution)"
    told = f" ± 95% confidence intervals (bootstrap over timelines{'' if one else ' and seeds'}"
    if alone := [each for each, found in kinds.items() if found == {False}]:
        told += (
            f"; {', '.join(each.heading for each in alone)}: {'none' if one else 'over seeds alone, t distribution'}"
        )
    if mixed := [each for each, found in kinds.items() if len(found) > 1]:
        told += f"; {', '.join(each.heading for each in mixed)}: some rows {'without' if one else 'over seeds alone'}"
    return f"{told})"


def _is_best(block: Sequence[Row], row: Row, measure: Measure) -> bool:
    if measure.better == "real":
        return False  # what is nearest is for the reader to see: real motion stands in the table
    compared = [other.estimates[measure.key] for other in block if other.competes and measure.key in other.estimates]
    if any(each.of_too_few for each in compared):
        return False
    means = [float(measure.shown(estimate.mean)) for estimate in compared]
    best = max(means) if measure.better == "higher" else min(means)
    return len(means) > 1 and float(measure.shown(row.estimates[measure.key].mean)) == best


def _plain(measure: Measure, value: Estimate, best: bool) -> str:
    half = "" if value.half is None else f" ± {measure.shown(value.half)}"
    return f"{measure.shown(value.mean)}{half}{'*' if best else ' '}"


def _typeset(measure: Measure, value: Estimate, best: bool) -> str:
    mean = measure.shown(value.mean)
    marked = rf"\mathbf{{{mean}}}" if best else mean
    return f"${marked}$" if value.half is None else rf"${marked} \pm {measure.shown(value.half)}$"


def _line(cells: Sequence[str], wide: Sequence[int], labels: int) -> str:
    aligned = [
        f"{cell:<{w}}" if n < labels else f"{cell:>{w}}" for n, (cell, w) in enumerate(zip(cells, wide, strict=True))
    ]
    return "  ".join(aligned).rstrip()


def _latex_line(cells: Sequence[str]) -> str:
    return " & ".join(cells) + r" \\"


def _escaped(text: str) -> str:
    return "".join(_SPECIAL.get(sign, sign) for sign in text)
