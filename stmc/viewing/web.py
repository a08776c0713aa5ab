"""A motion as one page to look at in a browser: viser's recording, and the timeline below it, in step with it."""

from __future__ import annotations

import html
import json
import tempfile
import time
import webbrowser
from collections.abc import Mapping, Sequence
from contextlib import suppress
from importlib.resources import files
from pathlib import Path

from stmc.motion.body_model import Body
from stmc.motion.motion import Motion
from stmc.motion.skins import skin_of
from stmc.text.vocabulary import Recognition
from stmc.timeline import Prompt, Timeline
from stmc.viewing.colours import NEUTRAL, ink, owners, palette, part_colours, transition_seconds, transitions

_ALONE = (
    '<meta http-equiv="Content-Security-Policy" content="default-src data: blob:; '
    "script-src 'unsafe-inline' 'unsafe-eval' blob:; style-src 'unsafe-inline'\">"
)
"""Has the browser refuse whatever does not come with the page itself."""


_PAGE, _READ_WITHIN = "stmc-view-", 3600.0
"""Of the pages that `view` opens: how their files' names begin, and the seconds within which browsers read them."""

_FOLLOW = '<button id="stmc-follow" type="button" aria-pressed="false">follow</button>'


def render_html(
    motion: Motion,
    timeline: Timeline | None = None,
    title: str = "",
    overlap: int | float | None = None,
    body: Body | None = None,
    unknown: Sequence[Recognition] = (),
) -> str:
    """A self-contained HTML page (some 1.5 MB, and as much again for every minute) that loads nothing from anywhere and
    opens from a file.

    It plays the motion in a loop with every body part in the colour of the prompt it obeys (neutral in gaps and in the
    middle of transitions, which last `overlap` seconds; None: as long as those that the motion was sampled with), on a
    floor with the pelvis' path. With a `timeline` (by whose name the page is called unless `title` says otherwise) it
    shows the texts that hold, and the tracks with a cursor that can be dragged. "#t=2.5" behind the page's address
    opens it paused at 2.5 seconds. The camera sees the whole motion in a window of any shape, or follows the body: a
    button says which, and the page follows by itself where the body would be too small to see.

    The body is a mannequin with the motion's own bones, or the mesh of `body`. Prompts that are `unknown` to the model
    (see `Model.doubtful`) bear a mark, with the nearest known ones as its tooltip.

    Examples:
        >>> [motion] = stmc.load().generate("walk # 0 # 1", steps=1)
        >>> html = stmc.render_html(motion, title="A walk")
        >>> "<title>A walk</title>" in html
        True
    """
    from stmc.viewing.scene import record  # not above: viser is slow to import

    title = title or (timeline.name if timeline is not None else "")
    overlap = transition_seconds(motion, overlap)
    colours = part_colours(timeline, motion.fps, motion.frames, overlap)
    content = record(motion, skin_of(motion, body), colours)
    assets = files("stmc") / "assets"
    style, script = ((assets / f"page.{kind}").read_text("utf-8") for kind in ("css", "js"))
    below = "" if timeline is None else _tracks(timeline, motion, overlap, {each.text: each.advice for each in unknown})
    heading = f'<div id="stmc-heading"><h1>{html.escape(title)}</h1><p>{_chips(timeline)}</p>{_FOLLOW}</div>'
    for old, new in (
        ("<head>", f"<head>{_ALONE}"),
        ("<title>Viser</title>", f"<title>{html.escape(title or 'motion')}</title>"),
        ("<body>", f'<body data-duration="{motion.duration:.4f}" data-view="{html.escape(_view(motion))}">'),
        ("</body>", f"<style>{style}</style>{heading}{below}<script>{script}</script></body>"),
    ):
        assert content.count(old) == 1, (old, content.count(old))  # else viser's page is not the one we know
        content = content.replace(old, new)
    return content


def view(
    motion: Motion,
    timeline: Timeline | None = None,
    title: str = "",
    overlap: int | float | None = None,
    body: Body | None = None,
    height: int = 640,
) -> None:
    """Show the page of `render_html`: below the notebook's cell (`height` pixels tall), or in the web browser.

    Examples:
        >>> [motion] = stmc.load().generate("walk # 0 # 1", steps=1)
        >>> stmc.view(motion, title="A walk")
    """
    content = render_html(motion, timeline, title, overlap, body)
    if _in_notebook():
        from IPython.display import HTML, display

        display(HTML(html_frame(content, height)))
        return
    _remove_old_pages()
    with tempfile.NamedTemporaryFile("w", prefix=_PAGE, suffix=".html", delete=False, encoding="utf-8") as file:
        file.write(content)
    webbrowser.open(Path(file.name).as_uri())


def _remove_old_pages() -> None:
    """Remove the pages of earlier calls, which browsers have read by now."""
    for path in Path(tempfile.gettempdir()).glob(f"{_PAGE}*.html"):
        with suppress(OSError):  # another user's
            if path.lstat().st_mtime < time.time() - _READ_WITHIN:
                path.unlink()


def html_frame(content: str, height: int = 640) -> str:
    """A page inside another: an HTML element that holds all of `content`."""
    style = f"width:100%;height:{height}px;border:1px solid #e6e8ec;border-radius:6px"
    return f'<div><iframe srcdoc="{html.escape(content)}" style="{style}"></iframe></div>'


def _in_notebook() -> bool:
    try:
        from IPython import get_ipython
    except ImportError:
        return False
    return hasattr(get_ipython(), "kernel")


def _view(motion: Motion) -> str:
    """What the page's camera has to know: where it sees everything, and the pelvis' path over the floor, ten times a
    second (m)."""
    from stmc.viewing.scene import cameras  # not above: viser is slow to import

    step = max(1, int(motion.fps / 10))
    path = motion.translation[::step, :2].double().cpu().numpy().round(3).tolist()
    return json.dumps({"cameras": cameras(motion), "path": path, "rate": motion.fps / step}, separators=(",", ":"))


def _chips(timeline: Timeline | None) -> str:
    """The texts that hold, each shown only while it does."""
    if timeline is None:
        return ""
    return "".join(
        f'<span {_while(prompt)} style="{_paint(colour)}" hidden>{html.escape(prompt.text)}</span>'
        for prompt, colour in zip(timeline.prompts, palette(len(timeline.prompts)), strict=True)
    )


def _tracks(timeline: Timeline, motion: Motion, overlap: int | float, advice: Mapping[str, str]) -> str:
    """The rows below the scene: tracks of prompts, the five body parts, seconds. `advice`: for texts that have some."""
    colours = palette(len(timeline.prompts))
    bars: list[list[str]] = [[] for _ in timeline.tracks]
    for prompt, row, colour in zip(timeline.prompts, timeline.rows, colours, strict=True):
        text, told = html.escape(prompt.text), html.escape(advice.get(prompt.text, prompt.text))
        kind = "bar unknown" if prompt.text in advice else "bar"
        style = _place(prompt.start, prompt.end, motion.duration) + _paint(colour)
        bars[row].append(f'<div class="{kind}" {_while(prompt)} title="{told}" style="{style}">{text}</div>')
    rows = [_row(f"track {row + 1}" if len(bars) > 1 else "prompts", "row", pieces) for row, pieces in enumerate(bars)]
    rows.append('<div class="gap"></div>')
    for part, spans in owners(timeline, motion.fps, motion.frames).items():
        pieces = [
            _span("span", start, end, motion, f"background:{NEUTRAL if owner is None else colours[owner]}")
            for owner, start, end in spans
        ]
        pieces += [_span("span change", start, end, motion) for start, end in transitions(spans, motion.fps, overlap)]
        rows.append(_row(part, "row part", pieces))
    return f'<div id="stmc-tracks">{"".join(rows)}<div id="stmc-time"></div>{_ruler(motion.duration)}</div>'


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
    return f'<div class="row ruler">{marks}<div id="stmc-cursor"></div></div>'


def _place(start: int | float, end: int | float, duration: int | float) -> str:
    start, end = min(start, duration), min(end, duration)
    return f"left:{100 * start / duration:.3f}%;width:{100 * (end - start) / duration:.3f}%;"


def _paint(colour: str) -> str:
    return f"background:{colour};color:{ink(colour)};"
