"""AMASS as TEACH's authors distribute it for BABEL: recordings at 30 fps in `train.pth.tar` and `val.pth.tar`.

FlowMDM was trained on them. The files are joblib pickles, of which no code is executed. Independent of annotations and
features.
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from stmc.data.preparation import LayoutError
from stmc.data.sources.amass.amass_recordings import SmplRecording, motion_of, recording_key
from stmc.io.arrays import ArraysError, read_joblib
from stmc.motion.body_model import Skeleton
from stmc.motion.motion import Motion
from stmc.motion.representation import Representation

FILES = ("train.pth.tar", "val.pth.tar")


@dataclass(frozen=True)
class TeachRecording(SmplRecording):
    """One recording of TEACH, with the arrays of `amass_recordings.motion_of`."""

    arrays: Mapping[str, np.ndarray]

    @property
    def fingerprint(self) -> str:
        """Digest of its arrays."""
        state = hashlib.sha256()
        for name, array in self.arrays.items():
            state.update(repr((name, array.shape, array.dtype.str)).encode() + array.tobytes())
        return state.hexdigest()

    def recorded(self, skeleton: Skeleton) -> Motion:
        """Return the motion at 30 fps."""
        return motion_of(self.arrays, skeleton)


class TeachRecordings:
    """The recordings in a folder with `train.pth.tar` and `val.pth.tar` (one is enough), by AMASS's paths.

    A duplicate recording is taken from the first file. See `annotated_amass.RecordingSource`. Raises `LayoutError` if
    neither file exists.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = Path(folder)
        self._files = [path for path in (self._folder / name for name in FILES) if path.is_file()]
        if not self._files:
            raise LayoutError(f"source={folder}: expected {' and '.join(FILES)}, as in TEACH's babel-smplh-30fps-male")

    @cached_property
    def _entries(self) -> dict[tuple[str, ...], dict[str, np.ndarray | str]]:
        """Entries by `recording_key`; the arrays stay on disk."""
        try:
            entries = [
                entry for file in self._files for entry in read_joblib(file, ["poses", "trans", "fps"], ["fname"])
            ]
        except ArraysError as error:
            raise LayoutError(str(error)) from error
        return {recording_key(entry["fname"].removesuffix(".npz")): entry for entry in reversed(entries)}

    def check(self, paths: Collection[str], representation: Representation) -> None:
        """Raise `LayoutError` if none of `paths` exists, or a file has another format."""
        if not any(recording_key(path) in self._entries for path in paths):
            examples = [str(entry["fname"]) for entry in list(self._entries.values())[-3:]]
            raise LayoutError(
                f"source={self._folder} has none of the {len(paths)} annotated recordings; expected, for instance, "
                f"{next(iter(paths))}, found {', '.join(examples) or 'nothing'}"
            )

    def inputs(self, paths: Collection[str]) -> list[Path]:
        """Return both files."""
        return self._files

    def read(self, paths: Collection[str]) -> Iterator[tuple[str, TeachRecording | str]]:
        """Yield every path with its recording, or the reason for its absence."""
        for path in paths:
            entry = self._entries.get(recording_key(path))
            if entry is None:
                yield path, f"not in {' or '.join(file.name for file in self._files)}: {path}"
            else:
                yield path, _copy(entry)


def _copy(entry: Mapping[str, np.ndarray | str]) -> TeachRecording:
    """Copy a recording from disk, with AMASS's name of the frame rate."""
    names = {"poses": "poses", "trans": "trans", "fps": "mocap_framerate"}
    return TeachRecording({new: np.array(entry[old]) for old, new in names.items()})
