"""Ground-truth motions, identified by the name of their recording and seconds within it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from stmc.data.cache import Cache, CacheError
from stmc.data.sources.amass.amass_recordings import Recordings, read_recording, repose, strip_mirror_prefix
from stmc.motion.body_model import Skeleton, load_body
from stmc.motion.motion import Motion
from stmc.motion.representation import Representation

ReferenceMotions = Callable[[str, float, float], Motion]
"""(recording, start, end) → the motion in between: frames `int(fps * start)` to `int(fps * end)`, with times in seconds
as in timelines."""


def cache_reference_motions(cache: Cache, representation: Representation) -> ReferenceMotions:
    """Look up the clips of a prepared data set. The function raises `CacheError` if a clip is missing."""
    clips = {clip.name: clip for clip in cache.clips}

    def look_up(name: str, start: float, end: float) -> Motion:
        if name not in clips:
            raise CacheError(f"no clip {name!r} among {len(clips)} clips such as {next(iter(clips), None)!r}")
        clip = clips[name]
        motion = representation.decode(cache.features[clip.start : clip.end], cache.fps, cache.skeleton)
        return _excerpt(motion, name, start, end)

    return look_up


def amass_reference_motions(folder: str | Path, fps: float | int, body: str | Path | None = None) -> ReferenceMotions:
    """Look up the recordings of a folder of AMASS; `M/KIT/3/…` is the mirror image of `KIT/3/…`, as in motions.txt.

    Args:
        folder: Folder of AMASS.
        fps: Frame rate of the motions.
        body: Folder of SMPL-H, whose bones are used; None uses the default skeleton.

    Raises:
        LayoutError: As in `data.amass`.
        RecordingError: As in `data.amass`.
        ValueError: If a recording is missing.
    """
    recordings = Recordings(Path(folder).expanduser())
    skeleton = Skeleton.default() if body is None else load_body(Path(body).expanduser(), "smplh").skeleton

    def look_up(name: str, start: float, end: float) -> Motion:
        bare, mirrored = strip_mirror_prefix(name)
        path = recordings.find(bare)
        if path is None:
            raise ValueError(
                f"{folder}: no recording {bare!r}; recordings are, for example, {', '.join(recordings.examples)}"
            )
        motion = repose(read_recording(path, skeleton).resampled(fps), skeleton, mirrored)
        return _excerpt(motion, name, start, end)

    return look_up


def _excerpt(motion: Motion, name: str, start: float, end: float) -> Motion:
    # a whole number of frames divided by the frame rate may be slightly too small
    first, last = (int(round(seconds * motion.fps, 6)) for seconds in (start, end))
    if not 0 <= first < last <= len(motion) + 1:
        raise ValueError(f"{name}: seconds {start:g} to {end:g} exceed the motion of {motion.duration:g} seconds")
    return motion.trimmed(first, min(last, len(motion)))
