"""Export motions to all formats: those of `stmc.formats`, pages and films.

This module is quick to import; it imports drawing modules on demand.
"""

from __future__ import annotations

import tempfile
from functools import partial
from pathlib import Path
from typing import IO, Any

from stmc.formats import FORMATS, Format, format_of, write_as
from stmc.io.extras import require
from stmc.motion.body_model import Skeleton
from stmc.motion.motion import Motion
from stmc.timeline import Timeline


def _save_page(motion: Motion, file: IO[bytes], skeleton: Skeleton, timeline: Timeline | None, **options: Any) -> None:
    from stmc.viewing.web import render_html

    file.write(render_html(motion, timeline, **options).encode())


def _save_film(suffix: str, motion: Motion, file: IO[bytes], skeleton: Skeleton, timeline: Timeline | None) -> None:
    from stmc.viewing.film import render_film

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"film{suffix}"
        render_film(motion, path, timeline)
        file.write(path.read_bytes())


def _film(suffix: str, title: str, used_by: str, holds: str, *needs: str, **more: Any) -> Format:
    check = partial(require, "matplotlib", "PIL", *needs)
    return Format(suffix, title, used_by, holds, partial(_save_film, suffix), drawn=True, check=check, **more)


EXPORTS: tuple[Format, ...] = (
    *FORMATS,
    Format(
        ".html",
        "a page that plays the motion",
        "anybody with a browser",
        "a page that loads nothing: `stmc.render_html`",
        _save_page,
        opened_in="a browser",
        media_type="text/html",
        options=("title", "unknown", "constraints"),
    ),
    _film(".webp", "a film", "slides, chats, web pages", "a film: `stmc.render_film`", media_type="image/webp"),
    _film(".gif", "a film", "slides, chats", "a film in 256 colours", media_type="image/gif"),
    _film(
        ".mp4",
        "a video",
        "slides, players",
        "a film; needs `pip install 'stmc[film]'`",
        "imageio_ffmpeg",
        media_type="video/mp4",
    ),
)
"""The formats of `stmc sample` and of the studio."""

FILMS = tuple(each.suffix for each in EXPORTS if each.drawn)


def export(motion: Motion, path: Path, timeline: Timeline | None = None, **options: Any) -> None:
    """Write a motion in the format of `path`'s suffix, one of `EXPORTS`. A format ignores `options` that it lacks.

    Raises `ValueError` for another suffix, and `ModuleNotFoundError` for a format whose package is not installed.
    """
    kind = format_of(path, EXPORTS, "write")
    write_as(kind, motion, path, timeline=timeline, **{name: options[name] for name in kind.options if name in options})
