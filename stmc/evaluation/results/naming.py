"""Names of methods and measures in tables and charts, in the paper's order, with their better directions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal

from stmc.composing import METHODS
from stmc.composing.sampling import Sampling
from stmc.evaluation.results.result_records import Setting
from stmc.settings.records import field_infos

REAL = "ground_truth"

_ACRONYMS = {"ape": "APE"}
SETTINGS = {"method": "method", "denoiser": "denoiser"} | {
    name: " ".join(_ACRONYMS.get(word, word) for word in name.split("_")) + (f" ({each.unit})" if each.unit else "")
    for name, each in field_infos(Sampling).items()
}
"""Names of the settings, as within a sentence."""


@dataclass(frozen=True)
class Measure:
    """Presentation of a metric.

    `key` is its key in `Result.metrics`; `chance` is the key of its chance level, or empty. `better` is "real" if
    values near to that of real motion are better.
    """

    key: str
    heading: str
    better: Literal["higher", "lower", "real"]
    decimals: int
    unit: str = ""
    chance: str = ""

    @property
    def arrow(self) -> str:
        """An arrow up if higher is better, down if lower is, and to the right if near to real motion is."""
        return {"higher": "↑", "lower": "↓", "real": "→"}[self.better]

    def format(self, value: float) -> str:
        """Format a value with the decimals of the measure."""
        return f"{value:.{self.decimals}f}"


MEASURES = (
    Measure("shown", "Action success rate", "higher", 0, "%", chance="shown_chance"),
    Measure("timelines_shown", "Timelines with all prompts shown", "higher", 0, "%"),
    Measure("recall_1", "R@1", "higher", 1, "%"),
    Measure("recall_3", "R@3", "higher", 1, "%"),
    Measure("m2t", "TMR-Score M2T", "higher", 3),
    Measure("judge_recall_1", "R@1 (judge)", "higher", 1, "%"),
    Measure("judge_recall_3", "R@3 (judge)", "higher", 1, "%"),
    Measure("judge_m2t", "TMR-Score M2T (judge)", "higher", 3),
    Measure("m2m", "TMR-Score M2M", "higher", 3),
    Measure("fid", "FID (crops)", "lower", 3),
    Measure("fid_plus", "FID+", "lower", 3),
    Measure("transition", "Transition distance", "lower", 1, "cm"),
    Measure("sliding", "Foot sliding", "lower", 2, "cm"),
    Measure("hand_step", "Largest hand step", "real", 1, "cm"),
    Measure("hand_step_99", "Hand step (99 % of motions)", "real", 1, "cm"),
    Measure("r_precision", "R-prec", "higher", 3),
    Measure("subsequence_fid", "FID (subsequences)", "lower", 3),
    Measure("subsequence_diversity", "Div (subsequences)", "real", 2),
    Measure("mm_dist", "MM-Dist", "lower", 3),
    Measure("transition_fid", "FID (transitions)", "lower", 3),
    Measure("transition_diversity", "Div (transitions)", "real", 2),
    Measure("r_precision_1", "R-precision (top 1)", "higher", 3),
    Measure("r_precision_2", "R-precision (top 2)", "higher", 3),
    Measure("r_precision_3", "R-precision (top 3)", "higher", 3),
    Measure("motion_fid", "FID", "lower", 3),
    Measure("diversity", "Diversity", "real", 2),
    Measure("multimodality", "MultiModality", "higher", 2),
    Measure("peak_jerk", "PJ", "real", 4),
    Measure("area_under_jerk", "AUJ", "lower", 2),
)
"""Measures by geometry alone; those of STMC's Tables 1 and A.1 (section 4.2), with FID of crops and FID+ of whole
motions; then those of FlowMDM's Table 1 (section 4.1)."""


@dataclass(frozen=True)
class MethodRow:
    """Labels of a row of Table 1: its method, and the tracks ("Single" or "Multi") and crops that it uses."""

    label: str
    tracks: str = "–"
    crops: str = "–"


ROWS: Mapping[str, MethodRow] = {REAL: MethodRow("Ground truth")} | {
    name: MethodRow(method.label, method.tracks, method.crops) for name, method in METHODS.items()
}
"""Real motion and the methods, in order."""


def method_row(name: str) -> MethodRow:
    """Return the row of a method by its name; an unknown method is labelled with its name."""
    return ROWS.get(name, MethodRow(name))


def variant(setting: Setting) -> str:
    """Return the label of a setting's method, with the share of steps after which stitching starts."""
    label, start = method_row(setting.method).label, setting.sampling.stitch_from
    return f"{label}, from {start:.0%} on" if start else label


def place(setting: Setting) -> tuple[int, float]:
    """Return the sort key of a row: the order of `ROWS`, unknown methods last; then the start of stitching."""
    known = list(ROWS)
    start = float(setting.sampling.stitch_from or 0)
    return known.index(setting.method) if setting.method in ROWS else len(known), start


def measures(keys: Iterable[str]) -> tuple[Measure, ...]:
    """Return the known measures among `keys`, in the order of the columns."""
    found = set(keys)
    return tuple(measure for measure in MEASURES if measure.key in found)
