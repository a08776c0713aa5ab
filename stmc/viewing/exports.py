"""Export motions to all formats: those of `stmc.formats`, pages and films.

This module is quick to import; it imports drawing modules on demand.
"""

from __future__ import annotations

import tempfile
from collections.abc import Collection
from functools import partial
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from stmc.formats import FORMATS, Format, format_of, write_as
from stmc.io.extras import require
from stmc.motion.body_model import Skeleton
from stmc.motion.motion import Motion
from stmc.timeline import Timeline

if TYPE_CHECKING:  # slow to import
    from stmc.formats.characters import Character


def _save_page(motion: Motion, file: IO[bytes], skeleton: Skeleton, timeline: Timeline | None, **options: Any) -> None:
    from stmc.viewing.web import render_html

    file.write(render_html(motion, timeline, **options).encode())


def _save_film(suffix: str, motion: Motion, file: IO[bytes], skeleton: Skeleton, timeline: Timeline | None) -> None:
    from stmc.viewing.film import render_film

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"film{suffix}"
        render_film(motion, path, timeline)
        file.write(path.read_bytes())


def _save_character(
    suffix: str,
    motion: Motion,
    file: IO[bytes],
    skeleton: Skeleton,
    timeline: Timeline | None,
    character: Character,
    fps: float | int | None = None,
) -> None:
    from stmc.formats.characters import retarget

    file.write(retarget(motion, character, fps).content(suffix))


def _character(suffix: str, title: str, used_by: str, holds: str, **more: Any) -> Format:
    return Format(suffix, title, used_by, holds, partial(_save_character, suffix), options=("character", "fps"), **more)


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
        options=("title", "doubtful", "constraints"),
    ),
    _film(
        ".webp",
        "a film",
        "slides, chats, web pages",
        "a film of at most 1,200 pictures (a minute at 20 fps): `stmc.render_film`",
        media_type="image/webp",
        animated=True,
    ),
    _film(".gif", "a film", "slides, chats", "the same in 256 colours", media_type="image/gif", animated=True),
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

CHARACTER_EXPORTS: tuple[Format, ...] = (
    _character(
        ".glb",
        "your character",
        "Blender, Unity, Unreal, the web",
        "the character's own file with the animation",
        media_type="model/gltf-binary",
    ),
    _character(
        ".vrm",
        "your VRM avatar",
        "programs for VRM avatars",
        "the avatar's own file with the animation",
        media_type="model/gltf-binary",
    ),
    _character(
        ".vrma",
        "a VRM Animation",
        "any VRM avatar",
        "the motion alone, of a humanoid with the character's proportions",
        media_type="model/gltf-binary",
    ),
    _character(
        ".bvh",
        "your character's skeleton",
        "Blender, Maya, MotionBuilder",
        "the character's own joints, axes and unit",
    ),
    _character(
        ".csv",
        "your robot's joints",
        "MuJoCo, controllers",
        "`qpos` of MuJoCo, or the joints of a URDF",
        media_type="text/csv",
    ),
)
"""The formats that show a character; it decides by its `formats` which of them it can be written as."""

FILMS = tuple(each.suffix for each in EXPORTS if each.drawn)


def exports_of(suffixes: Collection[str] = ()) -> tuple[Format, ...]:
    """Return all formats of a motion whose character has these `Character.formats`; none: of a motion alone."""
    own = [each for each in CHARACTER_EXPORTS if each.suffix in suffixes]
    return (*own, *(each for each in EXPORTS if each.suffix not in suffixes))


def export(
    motion: Motion,
    path: Path,
    timeline: Timeline | None = None,
    character: Character | None = None,
    **options: Any,
) -> None:
    """Write a motion in the format of `path`'s suffix, of a character if the format shows it.

    A format ignores `options` that it lacks.

    Args:
        motion: Motion to write.
        path: File to write; its suffix is one of `exports_of(character.formats)`.
        timeline: Timeline of the motion, or None.
        character: Character that moves in the formats that it can be written as; None: our body in all of them.
        **options: Options of formats, by their names.

    Raises `ValueError` for another suffix, and `ModuleNotFoundError` for a format whose package is not installed.
    """
    options |= {} if character is None else {"character": character}
    kind = format_of(path, exports_of(() if character is None else character.formats), "write")
    write_as(kind, motion, path, timeline=timeline, **{name: options[name] for name in kind.options if name in options})
