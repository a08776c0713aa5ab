"""The table of formats, and the functions that read and write them. Files are complete or absent."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NotRequired, TypedDict

from stmc.formats.bvh_reader import load_bvh
from stmc.formats.bvh_writer import save_bvh
from stmc.formats.glb import save_glb
from stmc.formats.mujoco import save_csv, save_mjcf
from stmc.formats.npz import load_npz, save_npz
from stmc.io.files import write_whole
from stmc.motion.body_model import Skeleton
from stmc.motion.motion import Motion
from stmc.timeline import Timeline


class FormatEntry(TypedDict):
    """A format of motion files."""

    name: str
    about: str
    drawn: Annotated[bool, "whether it is a film, which takes minutes"]
    character: NotRequired[Annotated[bool, "of a character: whether the file shows it"]]


@dataclass(frozen=True)
class Format:
    """A file format of motions, with its descriptions for commands, the studio and the docs."""

    suffix: str
    title: str
    """The file in a few words: "a skeleton"."""
    used_by: str
    """Programs and people: "Blender, Maya, MotionBuilder"."""
    holds: str
    """The content, for the docs."""
    write: Callable[..., None]
    """A function of a motion, an open binary file, a skeleton, a timeline or None, and `options` by their names."""
    read: Callable[[Path, Skeleton], Motion] | None = None
    opened_in: str = ""
    """The program that `stmc sample` recommends for a file that may be unfamiliar."""
    media_type: str = "application/octet-stream"
    options: tuple[str, ...] = ()
    check: Callable[[], object] | None = None
    """A function that raises `ModuleNotFoundError` if the format needs a package that is not installed."""
    drawn: bool = False
    """Whether every frame is drawn, which takes minutes."""
    animated: bool = False
    """Whether the file is an animated image, whose number of pictures is limited; see `check_pictures`."""

    @property
    def name(self) -> str:
        """The suffix without its dot."""
        return self.suffix[1:]

    def describe(self) -> FormatEntry:
        """Describe the format for the studio's page."""
        return {"name": self.name, "about": f"{self.title}: {self.used_by}", "drawn": self.drawn}


FORMATS: tuple[Format, ...] = (
    Format(
        ".glb",
        "a skinned figure",
        "Blender, Unity, Unreal, Windows, the web",
        "a skinned figure with its animation; the timeline, in the scene's `extras`",
        save_glb,
        opened_in="Blender",
        media_type="model/gltf-binary",
    ),
    Format(
        ".bvh",
        "a skeleton",
        "Blender, Maya, MotionBuilder",
        "22 bones and their angles",
        save_bvh,
        load_bvh,
        opened_in="Blender",
    ),
    Format(
        ".npz",
        "AMASS's arrays",
        "SMPL, AMASS's readers",
        "SMPL-H's `poses` (156 columns, fingers unturned), `trans`, `betas`, `gender`, `mocap_framerate`; `joints`; the"
        " `timeline`",
        save_npz,
        load_npz,
    ),
    Format(
        ".csv",
        "MuJoCo's qpos",
        "MuJoCo, pandas, robots",
        "time, the pelvis' place, quaternions w x y z",
        save_csv,
    ),
    Format(
        ".xml",
        "MuJoCo's model",
        "MuJoCo",
        "the skeleton as a model, the frames as keyframes, the timeline as a text",
        save_mjcf,
    ),
)
"""The formats of `write`; those with a `read` are the formats of `read`."""

READABLE = tuple(each for each in FORMATS if each.read is not None)


def write(
    motion: Motion,
    path: str | Path,
    skeleton: Skeleton | None = None,
    fps: float | int | None = None,
    timeline: Timeline | None = None,
) -> None:
    """Write a motion in the format of the path's suffix.

    Formats are `.npz` in AMASS's layout, `.bvh` for animation software, `.glb` (a skinned figure) for animation
    software, game engines and the web, and `.csv` (MuJoCo's `qpos`) and `.xml` (its model) for robotics. Folders are
    created; an existing file is replaced once the new one is complete.

    Args:
        motion: Motion to write.
        path: File to write.
        skeleton: Body to write; by default that of the motion (its bones, with the bundled rest pelvis).
        fps: Frame rate of the file; by default that of the motion. Rotations are resampled on the sphere.
        timeline: Timeline to store with the motion, in `.npz`, `.glb` and `.xml` files.

    Raises:
        ValueError: For any other suffix.

    Examples:
        >>> [motion] = stmc.load().generate("walk # 0 # 1", steps=1)
        >>> stmc.write(motion, "walk.bvh", fps=30)
        >>> stmc.write(motion, "walk.glb", timeline=stmc.Timeline.parse("walk # 0 # 1"))
    """
    path = Path(path)
    write_as(format_of(path, FORMATS, "write"), motion, path, skeleton, fps, timeline)


def read(path: str | Path, skeleton: Skeleton | None = None) -> Motion:
    """Read a motion from an `.npz` file of `write` or AMASS, or from a `.bvh` file with common joint names.

    Common names are those of `write`, Mixamo, Bandai, CMU and similar. `skeleton` (by default the bundled one) is posed
    if an `.npz` file has no joints; for a `.bvh` file with other joints than SMPL's, its bones are turned to the
    directions of the file's. A `.bvh` file does not state its unit: it is the metre, centimetre, millimetre, inch or
    CMU's unit in which the legs are 0.5 to 1.3 m long; y is up. Raises `ValueError` for another suffix and for missing
    content.

    Examples:
        >>> [motion] = stmc.load().generate("walk # 0 # 1", steps=1)
        >>> stmc.write(motion, "walk.npz")
        >>> stmc.read("walk.npz")
        Motion(20 frames at 20 fps, 1.00 s)
    """
    path = Path(path)
    load = format_of(path, READABLE, "read").read
    assert load is not None
    return load(path, Skeleton.default() if skeleton is None else skeleton)


def format_of(path: Path, formats: Sequence[Format], act: str) -> Format:
    """Find the format of a path's suffix.

    Args:
        path: Path of a file.
        formats: Formats to choose from.
        act: Verb for the message, such as "read".

    Raises:
        ValueError: For any other suffix; the message names the path, the verb and the choices.
    """
    for kind in formats:
        if kind.suffix == path.suffix.lower():
            return kind
    choices = ", ".join(kind.suffix for kind in formats)
    raise ValueError(f"{path}: cannot {act} {path.suffix!r} files; choose from {choices}")


def write_as(
    kind: Format,
    motion: Motion,
    path: Path,
    skeleton: Skeleton | None = None,
    fps: float | int | None = None,
    timeline: Timeline | None = None,
    **options: Any,
) -> None:
    """Write a motion in one format, whatever the suffix.

    Args:
        kind: Format of the file.
        motion: Motion to write.
        path: File to write.
        skeleton: As in `write`.
        fps: As in `write`.
        timeline: As in `write`.
        **options: Options of the format.
    """
    motion = motion if fps is None else motion.resampled(fps)
    if skeleton is None:
        skeleton = Skeleton.measured(motion.rotations, motion.joints)

    def fill(temporary: Path) -> None:
        with temporary.open("wb") as file:
            kind.write(motion, file, skeleton, timeline, **options)

    write_whole(path, fill)
