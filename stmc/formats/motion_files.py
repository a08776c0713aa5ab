"""Which file a motion becomes: the suffix decides. Nothing is left half written."""

from __future__ import annotations

from pathlib import Path

from stmc.formats.bvh_reader import load_bvh
from stmc.formats.bvh_writer import save_bvh
from stmc.formats.glb import save_glb
from stmc.formats.mujoco import save_csv, save_mjcf
from stmc.formats.npz import load_npz, save_npz
from stmc.io.files import write_whole
from stmc.motion.body_model import Skeleton
from stmc.motion.motion import Motion
from stmc.timeline import Timeline

_WRITERS = {".npz": save_npz, ".bvh": save_bvh, ".glb": save_glb, ".csv": save_csv, ".xml": save_mjcf}
_READERS = {".npz": load_npz, ".bvh": load_bvh}


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
    save = _WRITERS.get(path.suffix.lower())
    if save is None:
        raise ValueError(f"{path}: cannot write {path.suffix!r} files; choose from {', '.join(_WRITERS)}")
    motion = motion if fps is None else motion.resampled(fps)
    if skeleton is None:
        skeleton = Skeleton.measured(motion.rotations, motion.joints)

    def fill(temporary: Path) -> None:
        with temporary.open("wb") as file:
            save(motion, file, skeleton, timeline)

    write_whole(path, fill)


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
    load = _READERS.get(path.suffix.lower())
    if load is None:
        raise ValueError(f"{path}: cannot read {path.suffix!r} files; choose from {', '.join(_READERS)}")
    return load(path, Skeleton.default() if skeleton is None else skeleton)
