"""Single motions by the name of their recording and seconds within it: where ground truth comes from."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from stmc.data.cache import Cache, CacheError
from stmc.data.sources.amass.amass_recordings import Recordings, read_recording, reposed, unmirrored
from stmc.motion.body_model import Skeleton, load_body
from stmc.motion.motion import Motion
from stmc.motion.representation import Representation

ReferenceMotions = Callable[[str, float, float], Motion]
"""(recording, start, end) → what it shows in between: frames from `int(fps * start)` to `int(fps * end)`, which are
seconds, as in timelines."""


def cache_reference_motions(cache: Cache, representation: Representation) -> ReferenceMotions:
    """The clips of a prepared data set. Raises `CacheError` for a clip that is not there."""
    clips = {clip.name: clip for clip in cache.clips}

    def shown(name: str, start: float, end: float) -> Motion:
        if name not in clips:
            raise CacheError(f"no clip {name!r} among {len(clips)}, such as {next(iter(clips), None)!r}")
        clip = clips[name]
        motion = representation.decode(cache.features[clip.start : clip.end], cache.fps, cache.skeleton)
        return _between(motion, name, start, end)

    return shown


def amass_reference_motions(folder: str | Path, fps: float | int, body: str | Path | None = None) -> ReferenceMotions:
    """The recordings of a folder of AMASS at `fps`, on the bones of SMPL-H's folder `body` (None: the default
    skeleton's); `M/KIT/3/…` is the mirror image of `KIT/3/…`, as in STMC's motions.txt.

    Raises `LayoutError` and `RecordingError` as `data.amass` does, `ValueError` for a recording that is not there.
    """
    recordings = Recordings(Path(folder).expanduser())
    skeleton = Skeleton.default() if body is None else load_body(Path(body).expanduser(), "smplh").skeleton

    def shown(name: str, start: float, end: float) -> Motion:
        bare, mirrored = unmirrored(name)
        path = recordings.find(bare)
        if path is None:
            raise ValueError(f"{folder}: no recording {bare!r}; there are such as {', '.join(recordings.examples)}")
        motion = reposed(read_recording(path, skeleton).resampled(fps), skeleton, mirrored)
        return _between(motion, name, start, end)

    return shown


def _between(motion: Motion, name: str, start: float, end: float) -> Motion:
    # a whole number of frames that was divided by their rate may come back from it a hair below
    first, last = (int(round(seconds * motion.fps, 6)) for seconds in (start, end))
    if not 0 <= first < last <= len(motion) + 1:
        raise ValueError(f"{name}: seconds {start:g} to {end:g} of a motion of {motion.duration:g} seconds")
    return motion.trimmed(first, min(last, len(motion)))
