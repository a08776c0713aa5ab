"""What methods and measures are called in tables and charts, in the paper's order, and which direction is better."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from stmc.results.records import Setting

REAL = "ground_truth"

ALONE = "independent"
"""Every prompt as a motion of its own: what composing could at best keep, no rival of its own (appendix E)."""

HEADINGS = {
    "method": "Method",
    "denoiser": "Denoiser",
    "steps": "Steps",
    "sampler": "Sampler",
    "overlap": "Overlap (s)",
    "guidance": "Guidance",
    "spread": "Spread of the noise",
    "late": "Stitching from (share of steps)",
    "absolute": "Absolute (share of steps)",
}
"""What the settings are called."""


@dataclass(frozen=True)
class Measure:
    """A metric as it is shown: `key` in `Result.metrics`, its heading, the better direction, the decimals."""

    key: str
    heading: str
    better: Literal["higher", "lower", "real"]
    decimals: int
    unit: str = ""

    @property
    def arrow(self) -> str:
        """Up where more is better, down where less is, to the right where real motion's value is."""
        return {"higher": "↑", "lower": "↓", "real": "→"}[self.better]

    def shown(self, value: float) -> str:
        """A value with the decimals it is shown with."""
        return f"{value:.{self.decimals}f}"


MEASURES = (
    Measure("shown", "Shown", "higher", 0, "%"),
    Measure("recall_1", "R@1", "higher", 1, "%"),
    Measure("recall_3", "R@3", "higher", 1, "%"),
    Measure("m2t", "TMR-Score M2T", "higher", 3),
    Measure("m2m", "TMR-Score M2M", "higher", 3),
    Measure("fid", "FID", "lower", 3),
    Measure("fid_plus", "FID+", "lower", 3),
    Measure("transition", "Transition distance", "lower", 1, "cm"),
    Measure("r_precision", "R-prec", "higher", 3),
    Measure("subsequence_fid", "FID", "lower", 3),
    Measure("subsequence_diversity", "Div", "real", 2),
    Measure("mm_dist", "MM-Dist", "lower", 3),
    Measure("transition_fid", "FID (transitions)", "lower", 3),
    Measure("transition_diversity", "Div (transitions)", "real", 2),
    Measure("peak_jerk", "PJ", "real", 4),
    Measure("area_under_jerk", "AUJ", "lower", 2),
)
"""What geometry alone can see; the columns of STMC's Table 1 and A.1 (section 4.2), FID of crops and FID+ of whole
motions; then those of FlowMDM's Table 1 (section 4.1). "real": the nearer to real motion's, the better."""


@dataclass(frozen=True)
class Method:
    """A row of Table 1: its label, and what it is given of a timeline ("Single" or "Multi" tracks, and crops each)."""

    label: str
    tracks: str = "–"
    crops: str = "–"


METHODS = {
    REAL: Method("Ground truth"),
    "one_text": Method("One text", "Single", "Single"),
    "single_track": Method("DiffCollage", "Single", "Multi"),
    ALONE: Method("Prompts alone", "Multi", "Multi"),
    "sinc": Method("SINC w/o Lerp", "Multi", "Multi"),
    "sinc_lerp": Method("SINC w/ Lerp", "Multi", "Multi"),
    "sinc_slerp": Method("SINC w/ Slerp", "Multi", "Multi"),
    "multi_diffusion": Method("MultiDiffusion", "Multi", "Multi"),
    "double_take": Method("DoubleTake", "Multi", "Multi"),
    "stmc": Method("STMC", "Multi", "Multi"),
    "stmc_soft": Method("STMC, soft", "Multi", "Multi"),
    "flow_mdm": Method("FlowMDM", "Multi", "None"),
}
"""In the order of Table 1's rows, and others beside those that they are nearest to."""


def method(name: str) -> Method:
    """The method of that name; one that the paper does not have is called by its own name."""
    return METHODS.get(name, Method(name))


def variant(setting: Setting) -> str:
    """The method's label, with the share of the steps from which on it stitches."""
    label = method(setting.method).label
    return f"{label}, from {setting.late:.0%} on" if setting.late else label


def place(setting: Setting) -> tuple[int, float]:
    """Where a row stands among others: in the order of `METHODS`, those that it does not have last; the later a method
    stitches, the later."""
    known = list(METHODS)
    return known.index(setting.method) if setting.method in METHODS else len(known), float(setting.late or 0)


def measures(keys: Iterable[str]) -> tuple[Measure, ...]:
    """The known measures among `keys`, in the order of the columns."""
    found = set(keys)
    return tuple(measure for measure in MEASURES if measure.key in found)
