"""Pages that play a motion in a browser: the studio's stage with a synchronised timeline below."""

from __future__ import annotations

import base64
import html
import tempfile
import time
import webbrowser
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from stmc.editing.constraints import KINDS, Constraint, Pose
from stmc.formats.glb import Animation, glb_of
from stmc.motion.body import BodyPart
from stmc.motion.body_model import Body
from stmc.motion.motion import Motion
from stmc.motion.skins import Skin, skin_of
from stmc.timeline import Prompt, Timeline
from stmc.viewing.bundle import as_json, assemble
from stmc.viewing.colours import (
    NEUTRAL,
    ink,
    owned_seconds,
    owners,
    palette,
    transition_seconds,
    transitions,
)

_PAGE, _READ_WITHIN = "stmc-view-", 3600.0
"""Prefix of the files that `view` opens, and seconds within which browsers read them."""


@runtime_checkable
class Doubtful(Protocol):
    """Protocol of a prompt that may not show, such as a `Recognition`."""

    @property
    def text(self) -> str: ...

    @property
    def advice(self) -> str: ...


def render_html(
    motion: Motion,
    timeline: Timeline | None = None,
    title: str = "",
    overlap: int | float | None = None,
    body: Body | None = None,
    doubtful: Sequence[Doubtful] = (),
    constraints: Sequence[Constraint] = (),
) -> str:
    """Render a motion as a self-contained HTML page (at most 2 MB for a minute at 20 frames per second).

    The page loads nothing and opens from a file. It plays the motion in a loop, on a floor with the path of the pelvis.
    Body parts have the colours of their prompts, and are neutral in gaps and in the middle of transitions. The page
    shows the current texts, and the tracks with a cursor that can be dragged. "#t=2.5" at the end of the page's address
    opens it paused at 2.5 seconds. The camera follows the body; a button fixes it so that it sees the whole motion.

    Args:
        motion: Motion to show.
        timeline: Timeline of the motion; None: no texts, tracks and colours of prompts.
        title: Title of the page; by default the name of the timeline.
        overlap: Length of transitions in seconds; None: as sampled.
        body: Body whose mesh is shown; None: a mannequin with the motion's own bones.
        doubtful: Prompts to mark because they may not show, with advice as tooltips (see `Model.doubtful` and
            `stmc.evaluation.verification.find_missed`).
        constraints: Constraints to draw.

    Examples:
        >>> [motion] = stmc.load().generate("walk # 0 # 1", steps=1)
        >>> html = stmc.render_html(motion, title="A walk")
        >>> "<title>A walk</title>" in html
        True
    """
    title = title or (timeline.name if timeline is not None else "")
    overlap = transition_seconds(motion, overlap)
    marks = [_mark(f"c{number}", constraint, motion) for number, constraint in enumerate(constraints)]
    advice = {each.text: each.advice for each in doubtful}
    texts = {
        "title": html.escape(title or "motion"),
        "heading": html.escape(title),
        "now": _chips(timeline),
        "tracks": _tracks(timeline, motion, overlap, advice, marks) if timeline is not None or marks else "",
        "motion": as_json(_data(motion, timeline, overlap, skin_of(motion, body)) | {"marks": marks}),
    }
    return assemble("page.html", "page.js", ("stage.css", "page.css"), texts)


def view(
    motion: Motion,
    timeline: Timeline | None = None,
    title: str = "",
    overlap: int | float | None = None,
    body: Body | None = None,
    height: int = 640,
    constraints: Sequence[Constraint] = (),
) -> None:
    """Show the page of `render_html` in a notebook's output, or in the web browser.

    Args:
        motion: Motion to show.
        timeline: Timeline of the motion, or None.
        title: Title of the page; by default the name of the timeline.
        overlap: Length of transitions in seconds; None: as sampled.
        body: Body whose mesh is shown; None: a mannequin.
        height: Height in a notebook, in pixels.
        constraints: Constraints to draw.

    Examples:
        >>> [motion] = stmc.load().generate("walk # 0 # 1", steps=1)
        >>> stmc.view(motion, title="A walk")
    """
    content = render_html(motion, timeline, title, overlap, body, (), constraints)
    if _in_notebook():
        from IPython.display import HTML, display

        display(HTML(html_frame(content, height)))
        return
    _remove_old_pages()
    with tempfile.NamedTemporaryFile("w", prefix=_PAGE, suffix=".html", delete=False, encoding="utf-8") as file:
        file.write(content)
    webbrowser.open(Path(file.name).as_uri())


def _remove_old_pages() -> None:
    """Remove the pages of earlier calls, which browsers have already read."""
    for path in Path(tempfile.gettempdir()).glob(f"{_PAGE}*.html"):
        with suppress(OSError):  # belongs to another user
            if path.lstat().st_mtime < time.time() - _READ_WITHIN:
                path.unlink()


def html_frame(content: str, height: int = 640) -> str:
    """Embed a whole page, `content`, in an HTML element."""
    style = f"width:100%;height:{height}px;border:1px solid #e6e8ec;border-radius:6px"
    return f'<div><iframe srcdoc="{html.escape(content)}" style="{style}"></iframe></div>'


def _in_notebook() -> bool:
    try:
        from IPython import get_ipython
    except ImportError:
        return False
    return hasattr(get_ipython(), "kernel")


def _data(motion: Motion, timeline: Timeline | None, overlap: int | float, skin: Skin) -> dict[str, Any]:
    """Return the data of the page's script, without marks."""
    figure = glb_of(skin, {"motion": Animation(motion)}, compact=True)
    owned: dict[str, dict[str, list]]
    if timeline is None:
        owned = {"owners": {part: [[0, 0.0, motion.duration]] for part in BodyPart}, "transitions": {}}
    else:
        owned = owned_seconds(timeline, motion.fps, motion.frames, overlap)
    return {
        "figure": base64.b64encode(figure).decode("ascii"),
        "duration": motion.duration,
        "heading": float(motion.heading[0]),
        "kinds": [kind.describe() for kind in KINDS],
        "colours": palette(1 if timeline is None else len(timeline.prompts)),
        **owned,
    }


def _mark(name: str, constraint: Constraint, motion: Motion) -> dict[str, Any]:
    """Return the JSON fields of a constraint for the stage; a hold is placed where the motion holds it."""
    anchored = constraint.anchored_at(Pose.of(motion))
    values = {
        key: value for key, value in vars(anchored).items() if isinstance(value, int | float | str | tuple | None)
    }
    return values | {"id": name, "kind": anchored.name, "name": constraint.name}


def _chips(timeline: Timeline | None) -> str:
    """Return the texts, each shown only during its prompt."""
    if timeline is None:
        return ""
    return "".join(
        f'<span {_while(prompt)} style="{_paint(colour)}" hidden>{html.escape(prompt.text)}</span>'
        for prompt, colour in zip(timeline.prompts, palette(len(timeline.prompts)), strict=True)
    )


def _tracks(
    timeline: Timeline | None,
    motion: Motion,
    overlap: int | float,
    advice: Mapping[str, str],
    marks: Sequence[Mapping[str, Any]],
) -> str:
    """Return the rows below the stage: tracks of prompts, the five body parts, constraints and a ruler."""
    rows = [] if timeline is None else [*_prompts(timeline, motion, advice), *_parts(timeline, motion, overlap)]
    rows += [_row(*_constraint_row(mark, motion)) for mark in marks]
    return f'<section id="tracks" aria-label="Timeline">{"".join(rows)}{_ruler(motion.duration)}</section>'


def _prompts(timeline: Timeline, motion: Motion, advice: Mapping[str, str]) -> list[str]:
    colours = palette(len(timeline.prompts))
    bars: list[list[str]] = [[] for _ in timeline.tracks]
    for prompt, row, colour in zip(timeline.prompts, timeline.rows, colours, strict=True):
        text, tooltip = html.escape(prompt.text), html.escape(advice.get(prompt.text, prompt.text))
        kind = "bar unknown" if prompt.text in advice else "bar"
        style = _place(prompt.start, prompt.end, motion.duration) + _paint(colour)
        bars[row].append(f'<div class="{kind}" {_while(prompt)} title="{tooltip}" style="{style}">{text}</div>')
    names = [f"track {row + 1}" if len(bars) > 1 else "prompts" for row in range(len(bars))]
    return [*(_row(name, "row", pieces) for name, pieces in zip(names, bars, strict=True)), '<div class="gap"></div>']


def _parts(timeline: Timeline, motion: Motion, overlap: int | float) -> Iterator[str]:
    colours = palette(len(timeline.prompts))
    for part, spans in owners(timeline, motion.fps, motion.frames).items():
        pieces = [
            _span("span", start, end, motion, f"background:{NEUTRAL if owner is None else colours[owner]}")
            for owner, start, end in spans
        ]
        pieces += [_span("span change", start, end, motion) for start, end in transitions(spans, motion.fps, overlap)]
        yield _row(part, "row part", pieces)


def _constraint_row(mark: Mapping[str, Any], motion: Motion) -> tuple[str, str, list[str]]:
    """Return name, class and span of a constraint's row."""
    start = mark.get("at", mark.get("start", 0.0))
    end = mark.get("end", start if "at" in mark else None)
    end = motion.duration if end is None and mark["kind"] != "target" else end or start
    name = " ".join([mark["name"], str(mark.get("joint", "")).replace("_", " ")]).strip()
    return html.escape(name), "row part demand", [_span("span", start * motion.fps, end * motion.fps, motion)]


def _row(name: str, kind: str, pieces: list[str]) -> str:
    return f'<div class="name">{name}</div><div class="{kind}">{"".join(pieces)}</div>'


def _span(kind: str, start: int | float, end: int | float, motion: Motion, style: str = "") -> str:
    place = _place(start / motion.fps, end / motion.fps, motion.duration)
    return f'<div class="{kind}" style="{place}{style}"></div>'


def _while(prompt: Prompt) -> str:
    return f'data-from="{prompt.start:.3f}" data-to="{prompt.end:.3f}"'


def _ruler(duration: int | float) -> str:
    step = next(step for step in (0.5, 1, 2, 5, 10, 20, 30, 60, 300, 1e9) if duration / step <= 16)
    ticks = (tick * step for tick in range(int(duration / step) + 1))
    marks = "".join(f'<b style="left:{100 * tick / duration:.3f}%">{tick:g}</b>' for tick in ticks)
    return f'<div></div><div class="row" id="ruler">{marks}</div><div id="cursor"></div>'


def _place(start: int | float, end: int | float, duration: int | float) -> str:
    start, end = min(start, duration), min(end, duration)
    return f"left:{100 * start / duration:.3f}%;width:{100 * (end - start) / duration:.3f}%;"


def _paint(colour: str) -> str:
    return f"background:{colour};color:{ink(colour)};"
