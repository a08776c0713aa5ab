"""AMASS: its SMPL-H and SMPL-X recordings as motions, and their places in a folder."""

from __future__ import annotations

import math
import re
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor

from stmc.data.cache import fingerprint
from stmc.data.preparation import LayoutError
from stmc.io.arrays import ArraysError, Header, npz_headers, read_npz
from stmc.io.bounds import LEAST_FPS, MOST_FPS, MOST_FRAMES, BoundsError, check_frames
from stmc.io.untrusted import truncate
from stmc.motion.body import NUM_ROTATIONS
from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import axis_angle_to_matrix
from stmc.motion.motion import Motion
from stmc.motion.representation import Representation

COLUMNS: Mapping[str, int] = {"smplh": 156, "smplx": 165}
"""Number of columns of `poses` for each kind of body. Both begin with the 66 of the root and the 21 body joints, in one
order; SMPL-X continues with jaw, eyes and fingers, SMPL-H with fingers only."""

RATES = ("mocap_framerate", "mocap_frame_rate")
"""Names of the frame rate in SMPL-H files and in SMPL-X files."""
MOST_VALUES = 20_000_000
"""Maximum number of values of `poses`: 17 minutes of SMPL-H at 120 frames per second."""
_LARGEST_VALUE = 1024
"""Maximum size in bytes of a frame rate or of a body's name."""

RENAMED: Mapping[str, str] = {
    "BioMotionLab_NTroje": "BMLrub", "DFaust_67": "DFaust", "MPI_HDM05": "HDM05", "MPI_Limits": "PosePrior",
    "MPI_mosh": "MoSh", "SSM_synced": "SSM", "TCD_handMocap": "TCDHands", "Transitions_mocap": "Transitions",
}  # fmt: skip
"""Data sets of AMASS: their names when HumanML3D and BABEL were made → their names in later downloads."""


class RecordingError(ValueError):
    """A file that is not a recording of AMASS, or a damaged one; the message describes its content."""


def read_recording(path: Path, skeleton: Skeleton) -> Motion:
    """Read a recording's body joints at its own frame rate, on `skeleton` (float64; z up, metres).

    The subject's shape is ignored, as published (`betas` zero). Raises `RecordingError` for other files in AMASS's
    folders, for damaged files, and for recordings that are empty, not finite, or without a plausible frame rate.
    """
    try:
        headers = npz_headers(path)
        _check_names(tuple(headers), path)
        _check_shapes(headers["poses"], headers["trans"])
        _check_small({name: headers[name] for name in (*RATES, "surface_model_type") if name in headers})
        arrays = read_npz(path, ["poses", "trans"], [*RATES, "surface_model_type"])
    except ArraysError as error:
        raise RecordingError(f"damaged: {error}") from error
    return motion_of(arrays, skeleton)


def motion_of(arrays: Mapping[str, np.ndarray], skeleton: Skeleton) -> Motion:
    """Build the motion of a file's arrays: `poses` [frames, columns], `trans` [frames, 3], and the frame rate.

    Raises `RecordingError` as `read_recording` does.
    """
    _check_shapes(*(Header(arrays[name].shape, arrays[name].dtype) for name in ("poses", "trans")))
    _check_kind(arrays)
    fps = _rate(arrays)
    try:
        check_frames(len(arrays["poses"]), fps)
    except BoundsError as error:
        raise RecordingError(f"too large: {error}") from error
    poses = arrays["poses"][:, : 3 * NUM_ROTATIONS].astype(np.float64)
    trans = arrays["trans"].astype(np.float64)
    for name, values in (("poses", poses), ("trans", trans)):
        invalid = np.flatnonzero(~np.isfinite(values).all(axis=1))
        if len(invalid):
            raise RecordingError(
                f"not finite: {name} from frame {invalid[0]} on, {len(invalid)} frames of {len(values)}"
            )
    angles = rearrange(torch.from_numpy(poses), "frames (joints axes) -> frames joints axes", axes=3)
    pelvis = torch.from_numpy(trans) + skeleton.offsets[0].double()
    return Motion.posed(axis_angle_to_matrix(angles), pelvis, fps, skeleton)


def _check_names(names: tuple[str, ...], path: Path) -> None:
    if "poses" in names and "trans" in names:
        return
    description = f"it has {truncate(', '.join(names), 200) or 'nothing'}"
    if "betas" in names and (path.stem == "shape" or path.stem.endswith("_stagei") or "markers_latent" in names):
        raise RecordingError(f"no motion: a subject's shape alone ({description})")
    if any("marker" in name for name in names):
        raise RecordingError(f"no motion: markers alone ({description})")
    raise RecordingError(f"no motion: poses and trans are missing ({description})")


def _check_shapes(poses: Header, trans: Header) -> None:
    numeric = all(array.dtype.kind in "fiu" for array in (poses, trans))
    if not numeric or len(poses.shape) != 2 or trans.shape != (poses.shape[0], 3):
        raise RecordingError(
            f"wrong shape: poses {poses.shape} {poses.dtype} and trans {trans.shape} {trans.dtype}; they should be "
            "numbers, (frames, columns) and (frames, 3)"
        )
    if poses.shape[0] > MOST_FRAMES:
        raise RecordingError(f"too large: {poses.shape[0]} frames are more than {MOST_FRAMES:,}, the limit of a motion")
    if not poses.shape[0]:
        raise RecordingError("empty: zero frames")
    columns = poses.shape[1]
    legal = ", ".join(f"{kind} {count}" for kind, count in COLUMNS.items())
    if columns == 72:
        raise RecordingError(f"wrong variant: poses has 72 columns, as SMPL's without hands; AMASS's have {legal}")
    if columns not in COLUMNS.values():
        raise RecordingError(f"wrong variant: poses has {columns} columns; AMASS's have {legal}")
    if poses.shape[0] * columns > MOST_VALUES:
        raise RecordingError(f"too large: {poses.shape[0]} frames of {columns} columns exceed {MOST_VALUES:,} values")


def _check_small(headers: Mapping[str, Header]) -> None:
    """Raise `RecordingError` if an array that should be one value takes more than `_LARGEST_VALUE` bytes."""
    for name, (shape, dtype) in headers.items():
        if math.prod(shape) * dtype.itemsize > _LARGEST_VALUE:
            raise RecordingError(
                f"wrong shape: {name} has shape {shape} of {truncate(str(dtype))}; it should be one value"
            )


def _check_kind(arrays: Mapping[str, np.ndarray]) -> None:
    """Raise `RecordingError` if a file names another kind of body than it contains."""
    columns, legal = arrays["poses"].shape[1], ", ".join(f"{kind} {count}" for kind, count in COLUMNS.items())
    kind = _text(arrays["surface_model_type"]) if "surface_model_type" in arrays else None
    if kind is not None and COLUMNS.get(kind) != columns:
        raise RecordingError(f"mislabelled: surface_model_type {kind!r}, but poses has {columns} columns ({legal})")


def _rate(arrays: Mapping[str, np.ndarray]) -> float:
    name = next((name for name in RATES if name in arrays), None)
    if name is None:
        raise RecordingError(f"no frame rate: neither {' nor '.join(RATES)} among {', '.join(arrays)}")
    value = arrays[name]
    if value.size != 1 or value.dtype.kind not in "fiu" or not LEAST_FPS <= float(value.reshape(())) <= MOST_FPS:
        raise RecordingError(f"absurd frame rate: {name} is {value!r}; expected {LEAST_FPS} to {MOST_FPS} per second")
    return float(value.reshape(()))


def _text(value: np.ndarray) -> str:
    text = value.reshape(-1)[0] if value.size == 1 else value
    return text.decode("latin1") if isinstance(text, bytes) else str(text)


def repose(motion: Motion, skeleton: Skeleton, mirrored: bool = False) -> Motion:
    """Pose `skeleton` again with a resampled recording, or with its mirror image, as in the published preparation.

    Bones keep their lengths, and those of a mirror image are not mirrored. The published code interpolates axis-angle
    vectors, `Motion.resampled` on the sphere: the results are nearly equal, except for a vector whose sign flips
    between frames.

    Args:
        motion: The recording.
        skeleton: Skeleton to pose.
        mirrored: Whether to mirror the recording.
    """
    version = motion.mirrored() if mirrored else motion
    return Motion.posed(version.rotations, version.translation, version.fps, skeleton)


def strip_mirror_prefix(path: str) -> tuple[str, bool]:
    """Strip the `M/` of a mirror image from an annotation's path; return the path and whether it was there."""
    name = path.replace("\\", "/").removeprefix("./")
    return name.removeprefix("M/"), name.startswith("M/")


class SmplRecording(ABC):
    """Common parts of all recordings on AMASS's bodies; see `annotated_amass.Recording`."""

    split: str | None = None

    @abstractmethod
    def recorded(self, skeleton: Skeleton) -> Motion:
        """Return the motion at its own frame rate. Raises `RecordingError`."""

    def motion(self, skeleton: Skeleton, fps: float | int) -> Motion:
        """Return the recording at `fps`.

        A frame represents the middle of its time (`geometry.sampling_positions`), and both rates cover the same
        seconds. Raises `RecordingError`, and `ValueError` if the recording is too short.
        """
        recorded = self.recorded(skeleton)
        try:
            return recorded.resampled(fps)
        except ValueError as error:
            raise ValueError(f"too short: {error}") from error

    def features(self, motion: Motion, representation: Representation) -> Float[Tensor, "frames features"]:
        """Compute features, as published: the floor is at the lowest joint of the whole recording."""
        return representation.encode(motion)


@dataclass(frozen=True)
class AmassRecording(SmplRecording):
    """One recording of AMASS."""

    path: Path

    @property
    def fingerprint(self) -> str:
        """Digest of the file."""
        return fingerprint([self.path], [])

    def recorded(self, skeleton: Skeleton) -> Motion:
        """Read the recording with `read_recording`."""
        return read_recording(self.path, skeleton)


class Recordings:
    """The recordings in a folder of AMASS, by the paths in annotations; see `annotated_amass.RecordingSource`.

    Data set, subject and recording are compared, whatever the folders above them, under old and new names of the data
    sets and with the endings of either release (`_poses`, `_stageii`). If both releases exist, SMPL-H's file is used.
    Raises `LayoutError` if the folder does not exist or holds no recording.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder = Path(folder)
        if not folder.is_dir():
            raise LayoutError(
                f"source={folder} is not a directory; it should hold AMASS's data sets: ACCAD/, BMLmovi/, CMU/ …"
            )
        files = sorted(path for path in folder.rglob("*.npz") if path.is_file())
        self._files: dict[tuple[str, ...], Path] = {}
        for path in sorted(files, key=lambda path: (path.stem.endswith("_stageii"), path)):
            self._files.setdefault(recording_key(path.relative_to(folder).with_suffix("").as_posix()), path)
        if not files:
            raise LayoutError(f"source={folder} holds no .npz file, but {_describe_folder(folder)}")

    @property
    def examples(self) -> list[str]:
        """Some existing paths."""
        return ["/".join(path.parts[-3:]) for path in list(self._files.values())[:3]]

    def find(self, path: str) -> Path | None:
        """Return the file of AMASS's path (`KIT/3/kick_high_left02_poses`, see `strip_mirror_prefix`), or None."""
        return self._files.get(recording_key(path))

    def check(self, paths: Collection[str], representation: Representation) -> None:
        """Raise `LayoutError` if none of `paths` exists."""
        if not self.inputs(paths):
            raise LayoutError(
                f"source={self._folder} has none of the {len(paths)} annotated recordings; expected, for instance, "
                f"{next(iter(paths))}.npz, found {', '.join(self.examples)}"
            )

    def inputs(self, paths: Collection[str]) -> list[Path]:
        """Return the files of the existing paths."""
        return [file for file in map(self.find, paths) if file is not None]

    def read(self, paths: Collection[str]) -> Iterator[tuple[str, AmassRecording | str]]:
        """Yield every path with its recording, or the reason for its absence."""
        for path in paths:
            file = self.find(path)
            yield path, f"no file: {path}.npz" if file is None else AmassRecording(file)


def recording_key(path: str) -> tuple[str, ...]:
    """Return the parts of a recording's path that are the same in all releases."""
    parts = [part.replace(" ", "_") for part in path.split("/")][-3:]
    parts[-1] = re.sub(r"_(poses|stageii)$", "", parts[-1])
    return RENAMED.get(parts[0], parts[0]).replace("_", "").lower(), *parts[1:]


def _describe_folder(folder: Path) -> str:
    """Describe the content of a folder without recordings, and the remedy."""
    ends = {"".join(path.suffixes[-2:]).lower() for path in folder.rglob("*") if path.is_file()}
    if {".tar.bz2", ".tar.xz", ".zip"} & ends:
        return "archives; unpack them there"
    if ".npy" in ends:
        return "HumanML3D's .npy files; AMASS's own .npz files are needed (or data=humanml3d_processed)"
    names = sorted(path.name for path in folder.iterdir())[:8]
    return f"only {', '.join(names)}" if names else "nothing at all"
