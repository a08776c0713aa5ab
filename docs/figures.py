"""Draw the figures of these pages that need nothing but the library.

`python docs/figures.py` draws the plans into docs/figures/ with `stmc.plot_plan`. `python docs/figures.py film` samples
the film at the top of the README with the bundled model and writes it to docs/assets/; `python docs/figures.py mtt
MTT.txt` does the same for the first ten timelines of MTT. `stmc evaluate` draws the charts of the results.
"""

import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

import stmc
from stmc.composing.methods import TEACH_CONTEXT_SECONDS
from stmc.timeline.planning import Plan, cross_fade, handshake, look_back, multi_diffusion, reweighted
from stmc.viewing.colours import palette, part_colours, transition_seconds
from stmc.viewing.strip import Stage
from stmc.viewing.timeline_figure import FAINT, INK, draw_tracks

FOLDER = Path(__file__).parent / "figures"
FPS = 20
DOTS_PER_INCH = 110
FILM = Path(__file__).parent / "assets" / "timeline.webp"
FILM_FPS, FILM_SEED = 12, 0
MTT_FILM = FILM.with_name("mtt.webp")
MTT_ROWS, MTT_COLUMNS, MTT_FPS = 2, 5, 6
FILM_TIMELINE = """
walk forwards # 0 # 3.5 # legs
wave the right hand # 0.6 # 3.3 # right arm
squat # 3.5 # 5.5
run # 5.5 # 9 # legs
wave the left hand # 6 # 8.7 # left arm
"""

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


def film() -> None:
    """Sample the README's film: a person above the tracks of the timeline, with a cursor that moves along them."""
    timeline = stmc.Timeline.parse(FILM_TIMELINE)
    [motion] = stmc.load().generate(timeline, seed=FILM_SEED, steps=50)
    first, *others = pictures(motion.resampled(FILM_FPS), timeline)
    first.save(FILM, save_all=True, append_images=others, duration=round(1000 / FILM_FPS), loop=0, quality=60, method=6)


def pictures(motion: stmc.Motion, timeline: stmc.Timeline) -> Iterator[Image.Image]:
    """Draw each frame of `motion` on the stage of `stmc.render_film`, above the tracks, at 640 by 620 pixels."""
    overlap = transition_seconds(motion, None)
    colours = part_colours(timeline, motion.fps, motion.frames, overlap)
    stage = Stage.of(motion, None, colours, np.arange(motion.frames))
    stage = replace(stage, frame=(1.85, -0.47, stage.frame[2]))
    figure = Figure(figsize=(6.4, 6.2), dpi=100)
    canvas = FigureCanvasAgg(figure)
    person, tracks = figure.add_axes((0.0, 0.355, 1.0, 0.615)), figure.add_axes((0.11, 0.085, 0.86, 0.265))
    draw_tracks(tracks, timeline, motion.fps, overlap)
    cursor = tracks.axvline(0.0, color=INK, linewidth=1.8)
    for frame in range(motion.frames):
        person.clear()
        stage.paint(person, frame)
        cursor.set_xdata([frame / motion.fps] * 2)
        canvas.draw()
        yield Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())


def film_mtt(file: str) -> None:
    """Sample the first ten timelines of MTT's `file`, with one seed, and film them side by side above their prompts."""
    timelines = stmc.Timeline.read_all(file)[: MTT_ROWS * MTT_COLUMNS]
    motions = stmc.load().generate(timelines, seed=FILM_SEED, steps=50)
    first, *others = draw_side_by_side([motion.resampled(MTT_FPS) for motion in motions], timelines)
    first.save(
        MTT_FILM, save_all=True, append_images=others, duration=round(1000 / MTT_FPS), loop=0, quality=38, method=6
    )


def draw_side_by_side(motions: list[stmc.Motion], timelines: list[stmc.Timeline]) -> Iterator[Image.Image]:
    """Draw each frame of all motions; prompts are in colour while they last, and shorter motions stop at their end."""
    figure = Figure(figsize=(10.5, 5.8), dpi=80)
    canvas, cells = FigureCanvasAgg(figure), []
    for number, (motion, timeline) in enumerate(zip(motions, timelines, strict=True)):
        left, low = number % MTT_COLUMNS / MTT_COLUMNS, 0.5 - number // MTT_COLUMNS / MTT_ROWS
        axes = figure.add_axes((left, low + 0.12, 1 / MTT_COLUMNS, 0.34))
        colours = part_colours(timeline, motion.fps, motion.frames, transition_seconds(motion, None))
        stage = Stage.of(motion, None, colours, np.arange(motion.frames))
        lines = [
            figure.text(left + 0.01, low + 0.09 - 0.032 * row, prompt.text, fontsize=6.3)
            for row, prompt in enumerate(timeline.prompts)
        ]
        cells.append((axes, stage, timeline, lines))
    for frame in range(max(motion.frames for motion in motions)):
        for axes, stage, timeline, lines in cells:
            seconds = frame / stage.motion.fps
            for line, prompt, colour in zip(lines, timeline.prompts, palette(len(lines)), strict=True):
                line.set_color(colour if prompt.start <= seconds < prompt.end else FAINT)
            if frame < stage.motion.frames:
                axes.clear()
                stage.paint(axes, frame)
        canvas.draw()
        yield Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())


def draw_stream() -> Figure:
    """Draw the window of a stream: observed frames, fading frames, the block, and the crops that it needs."""
    figure, axes = plt.subplots(figsize=(8.5, 2.7), layout="constrained")
    spans = [
        (3, "walk forwards", 0, 5, "#0072b2"), (3, "turn left", 5, 8, "#0072b2"),
        (2, "raise the right arm", 3, 6, "#e69f00"),
        (1, "out: observed", 0, 4, "#555555"), (1, "fades", 4, 5, "#999999"),
        (0, "block", 4, 6, "#009e73"), (0, "lookahead", 6, 7, "#8fd3bd"),
    ]  # fmt: skip
    for row, text, start, end, colour in spans:
        axes.barh(row, end - start, left=start, height=0.7, color=colour, edgecolor="white")
        axes.text((start + end) / 2, row, text, ha="center", va="center", color="white", fontsize=9)
    axes.axvline(4, ymax=0.9, color="black", linewidth=1.5)
    axes.text(4, 3.55, "cursor", ha="center", fontsize=9)
    axes.axvspan(0, 8, color="#0072b2", alpha=0.07)
    axes.text(8.05, 3.55, "window", ha="right", fontsize=9, color="#0072b2")
    axes.set(xlim=(-0.3, 10), ylim=(-0.5, 3.9), yticks=[], xlabel="seconds")
    axes.text(
        9, 1.5, "from the cursor on,\nprompts may be added,\nmoved and removed", ha="center", va="center", fontsize=9
    )
    axes.spines[["top", "left", "right"]].set_visible(False)
    return figure


def main() -> None:
    if sys.argv[1:] == ["film"]:
        film()
        return
    if sys.argv[1:2] == ["mtt"]:
        film_mtt(*sys.argv[2:])
        return
    FOLDER.mkdir(exist_ok=True)
    draw_stream().savefig(FOLDER / "stream.png", dpi=DOTS_PER_INCH, metadata={"Software": None})
    for name, plan in plans().items():
        drawing = stmc.plot_plan(plan, FPS, width=8.5)
        drawing.savefig(FOLDER / f"{name}.png", dpi=DOTS_PER_INCH, metadata={"Software": None})


if __name__ == "__main__":
    main()
