"""The table of formats, and the functions that read and write by it. Nothing is left half written."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stmc.formats.bvh_reader import load_bvh
from stmc.formats.bvh_writer import save_bvh
from stmc.formats.glb import save_glb
from stmc.formats.mujoco import save_csv, save_mjcf
from stmc.formats.npz import load_npz, save_npz
from stmc.io.files import write_whole
from stmc.motion.body_model import Skeleton
from stmc.motion.motion import Motion
from stmc.timeline import Timeline


@dataclass(frozen=True)
class Format:
    """A kind of file that a motion becomes, and all that commands, the studio and the docs say about it."""

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
    """The program that `stmc sample` names for a file that newcomers may not know."""
    media_type: str = "application/octet-stream"
    options: tuple[str, ...] = ()
    check: Callable[[], object] | None = None
    """Raises `ModuleNotFoundError` where the format needs a package that is not installed."""
    drawn: bool = False
    """Whether every frame is drawn, which takes minutes."""

    @property
    def name(self) -> str:
        """The suffix without its dot."""
        return self.suffix[1:]

    def describe(self) -> dict[str, Any]:
        """The format as the studio's page knows it."""
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
    """Write a motion in the format of `path`'s suffix: `.npz` as AMASS has it, `.bvh` for animation software, `.glb`
    (a skinned figure) for animation software, game engines and the web, `.csv` (MuJoCo's `qpos`) and `.xml` (its model)
    for robotics.

    `skeleton`: the body to write, by default the one the motion moves (its own bones; the bundled rest pelvis).
    `fps`: the file's frame rate, by default the motion's own; rotations are resampled on the sphere. `timeline`: goes
    along where the format has a place for it (`.npz`, `.glb`, `.xml`). Folders are made; a file already there is
    replaced once the new one is whole. Another suffix is a `ValueError`.

    Examples:
        >>> [motion] = stmc.load().generate("walk # 0 # 1", steps=1)
        >>> stmc.write(motion, "walk.bvh", fps=30)
        >>> stmc.write(motion, "walk.glb", timeline=stmc.Timeline.parse("walk # 0 # 1"))
    """
    path = Path(path)
    write_as(format_of(path, FORMATS, "write"), motion, path, skeleton, fps, timeline)


def read(path: str | Path, skeleton: Skeleton | None = None) -> Motion:
    """The motion of an `.npz` that `write` or AMASS wrote, or of a `.bvh`: `write`'s, Mixamo's, Bandai's, CMU's, and
    others whose joints have such names.

    `skeleton` (by default the bundled one) is posed where an `.npz` has no joints; rotations of a `.bvh` of other
    joints than ours turn its bones to where the file's point. A `.bvh` does not say its unit: it is the metre,
    centimetre, millimetre, inch or CMU's in which the legs are 0.5 to 1.3 m long; y is up. Raises `ValueError` for
    another suffix and for what is missing inside.

    Examples:
        >>> [motion] = stmc.load().generate("walk # 0 # 1", steps=1)
        >>> stmc.write(motion, "walk.npz")
        >>> stmc.read("walk.npz")
        Motion(20 frames at 20 fps, 1.00 s)
    """
    path = Path(path)
    load = format_of(path, READABLE, "read").read
    return load(path, Skeleton.default() if skeleton is None else skeleton)


def format_of(path: Path, formats: Sequence[Format], act: str) -> Format:
    """The format of a path's suffix. Raises `ValueError` that names the path, the `act` and the choices."""
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
    """Write a motion in one format, whatever the suffix; all else as in `write`."""
    motion = motion if fps is None else motion.resampled(fps)
    if skeleton is None:
        skeleton = Skeleton.measured(motion.rotations, motion.joints)

    def fill(temporary: Path) -> None:
        with temporary.open("wb") as file:
            kind.write(motion, file, skeleton, timeline, **options)

    write_whole(path, fill)
