"""Render motions as films without a display: animated images, or videos with ffmpeg."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from stmc.composing import Progress
from stmc.io.bounds import check_pictures
from stmc.io.extras import named_extra
from stmc.io.files import write_whole
from stmc.motion.body_model import Body
from stmc.motion.motion import Motion
from stmc.timeline import Timeline
from stmc.viewing.colours import ink, palette, part_colours, transition_seconds
from stmc.viewing.strip import Stage

_SIZE, _DPI = (4.8, 5.6), 100
"""Inches, and pixels per inch; both sides are even numbers of pixels, as videos require."""
_LINE = 0.052
"""Height of a line of text, as a fraction of the picture."""
_BOUNDS = 24
"""Number of frames that determine the bounds of the picture."""


def render_film(
    motion: Motion,
    path: str | Path,
    timeline: Timeline | None = None,
    fps: float | int | None = None,
    overlap: int | float | None = None,
    body: Body | None = None,
    progress: Progress | None = None,
) -> None:
    """Write a motion as a film of 480 by 560 pixels.

    `.webp` and `.gif` files are small, play anywhere, loop and have at most 1,200 pictures; `.mp4` has any number and
    plays once, and needs `pip install 'stmc[film]'`. Figure, floor and colours are those of `film_strip`, with the
    current texts below. About four pictures are drawn per second. Raises `ValueError` for another suffix and for too
    many pictures.

    Args:
        motion: Motion to show.
        path: File to write.
        timeline: Timeline whose prompts give colours and texts; None: a single colour.
        fps: Frame rate of the film; None: that of the motion.
        overlap: Length of transitions in seconds; None: as sampled.
        body: Body to draw; None: a mannequin.
        progress: Called with the pictures and `total`, their number, returns them, such as `tqdm`; an error that it
            raises leaves no file.

    Examples:
        >>> [motion] = stmc.load().generate("walk # 0 # 1", steps=1)
        >>> stmc.render_film(motion, "walk.webp", fps=5)
    """
    path = Path(path)
    writer = _WRITERS.get(path.suffix.lower())
    if writer is None:
        raise ValueError(f"{path}: cannot film as {path.suffix!r}; choose from {', '.join(_WRITERS)}")
    motion = motion if fps is None else motion.resampled(fps)
    overlap = transition_seconds(motion, overlap)
    colours = part_colours(timeline, motion.fps, motion.frames, overlap)
    shown = np.unique(np.linspace(0, motion.frames - 1, _BOUNDS).round().astype(int))
    pictures: Iterable[np.ndarray] = _pictures(Stage.of(motion, body, colours, shown), timeline)
    if progress is not None:
        pictures = progress(pictures, total=motion.frames)
    write_whole(path, writer(motion, pictures))


def _pictures(stage: Stage, timeline: Timeline | None) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    figure = Figure(figsize=_SIZE, dpi=_DPI)
    canvas = FigureCanvasAgg(figure)
    lines = 0 if timeline is None else max(_max_simultaneous(timeline), 1)
    axes = figure.add_axes((0.0, lines * _LINE, 1.0, 0.95 - lines * _LINE))
    for frame in range(stage.motion.frames):
        axes.clear()
        stage.paint(axes, frame)
        for text in list(figure.texts):
            text.remove()
        _texts(figure, timeline, (frame + 0.5) / stage.motion.fps)
        canvas.draw()
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _max_simultaneous(timeline: Timeline) -> int:
    """Return the maximum number of simultaneous prompts."""
    return max(
        sum(other.start <= prompt.start < other.end for other in timeline.prompts) for prompt in timeline.prompts
    )


def _texts(figure: Figure, timeline: Timeline | None, time: float) -> None:
    """Draw the current prompts, each on its colour."""
    if timeline is None:
        return
    pairs = zip(timeline.prompts, palette(len(timeline.prompts)), strict=True)
    holding = [(prompt.text, colour) for prompt, colour in pairs if prompt.start <= time < prompt.end]
    for line, (text, colour) in enumerate(holding):
        label = text if len(text) <= 60 else f"{text[:59]}…"
        box = {"facecolor": colour, "edgecolor": "none", "boxstyle": "round,pad=0.25"}
        style: dict[str, Any] = {"fontsize": 9, "color": ink(colour), "bbox": box, "parse_math": False}
        figure.text(0.5, (line + 0.6) * _LINE, label, ha="center", va="center", **style)


def _animation(kind: str, unit: int, motion: Motion, pictures: Iterable[np.ndarray]) -> Callable[[Path], None]:
    """Return a writer of animations; durations, in whole units of milliseconds, add up to that of the motion."""
    check_pictures(kind.lower(), motion.frames)
    ends = np.round(np.arange(motion.frames + 1) * 1000 / motion.fps / unit).astype(int) * unit

    def fill(temporary: Path) -> None:
        first, *others = (Image.fromarray(picture) for picture in pictures)
        times = np.diff(ends).tolist()
        first.save(temporary, kind, save_all=True, append_images=others, duration=times, loop=0, quality=80)

    return fill


def _video(motion: Motion, pictures: Iterable[np.ndarray]) -> Callable[[Path], None]:
    with named_extra():
        import imageio_ffmpeg  # not at the top: only videos need it
    size = tuple(round(side * _DPI) for side in _SIZE)

    def fill(temporary: Path) -> None:
        writer = imageio_ffmpeg.write_frames(
            str(temporary), size, fps=motion.fps, macro_block_size=2, output_params=["-f", "mp4", "-y"], quality=7
        )
        writer.send(None)
        try:
            for picture in pictures:
                writer.send(np.ascontiguousarray(picture))
        finally:
            writer.close()

    return fill


_WRITERS: Mapping[str, Callable[[Motion, Iterable[np.ndarray]], Callable[[Path], None]]] = {
    ".webp": partial(_animation, "WEBP", 1),
    ".gif": partial(_animation, "GIF", 10),
    ".mp4": _video,
}
