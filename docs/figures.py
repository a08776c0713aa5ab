"""Draws the figures of these pages that follow from the library alone: `python docs/figures.py` fills docs/figures/.

Each is a plan, drawn by `stmc.plot_plan`, or the picture of a timeline; the results' charts are scripts/evaluate.py's.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np

import stmc
from stmc.composing.methods import TEACH_CONTEXT_SECONDS
from stmc.timeline.planning import Plan, cross_fade, handshake, look_back, multi_diffusion, reweighted

FOLDER = Path(__file__).parent / "figures"
FPS = 20
DOTS_PER_INCH = 110

TIMELINE = stmc.Timeline.parse(
    "walk forwards # 0 # 4 # legs\nturn left # 4 # 7 # legs\nraise the right arm # 1.5 # 5.5 # right arm"
)
"""The timeline of all pages: two tracks, four edges."""


def half_cosine(plan: Plan) -> Plan:
    """The rule that extending/rule.md makes."""

    def weigh(shown: np.ndarray, transitions: np.ndarray) -> None:
        for transition, before, after in zip(transitions, shown, shown[1:], strict=False):
            [frames] = transition.nonzero()
            way = 0.5 - 0.5 * np.cos(np.pi * (np.arange(len(frames)) + 0.5) / len(frames))
            before[frames] *= 1 - way
            after[frames] *= way
        shown /= shown.sum(axis=0)
        transitions[:] = 0

    return reweighted(plan, weigh)


def layout(rule: Callable[[Plan], Plan] | None = None, overlap: int = 20, timeline: stmc.Timeline = TIMELINE) -> Plan:
    """A plan with transitions of a second, which are easier to see than the usual half."""
    plan = stmc.plan(timeline, fps=FPS, overlap=overlap)
    return plan if rule is None else rule(plan)


def plans() -> dict[str, Plan]:
    """Every figure of a plan, by the name of its file."""
    single = stmc.single_track(TIMELINE, fps=FPS)
    one = stmc.one_text(TIMELINE, 10.0)
    gap = stmc.Timeline.parse("walk forwards # 0 # 3 # legs\nbow # 5 # 8 # spine # head")
    return {
        "stmc_paper": layout(),
        "stmc": layout(cross_fade),
        "multi_diffusion": layout(multi_diffusion),
        "double_take": layout(handshake),
        "half_cosine": layout(half_cosine),
        "sinc": layout(overlap=0),
        "single_track": layout(timeline=single),
        "teach": look_back(layout(overlap=0, timeline=single), round(TEACH_CONTEXT_SECONDS * FPS)),
        "one_text": layout(overlap=0, timeline=one),
        "gap": layout(timeline=gap),
        "long_prompt": stmc.plan(
            stmc.Timeline.parse("walk forwards # 0 # 25"), fps=FPS, overlap=20, longest=200
        ),
    }  # fmt: skip


def main() -> None:
    FOLDER.mkdir(exist_ok=True)
    for name, plan in plans().items():
        drawing = stmc.plot_plan(plan, FPS, width=8.5)
        drawing.savefig(FOLDER / f"{name}.png", dpi=DOTS_PER_INCH, metadata={"Software": None})


if __name__ == "__main__":
    main()
