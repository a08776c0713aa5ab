"""CMU's motion capture database as a `Preparation`; `catalogue` reads and converts its recordings.

Depends on the segments of the recordings and their actions.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from stmc.data.cache import TOUCHING, Cache, Clip, fingerprint
from stmc.data.preparation import Job, Watch, find_source, in_parallel
from stmc.data.sources.cmu import catalogue as cmu
from stmc.data.sources.contents import CONTENTS, describe, mirror_content
from stmc.data.sources.segments import Segment, read_segments, splits
from stmc.motion.body_model import Skeleton
from stmc.motion.motion import Motion
from stmc.motion.representation.smpl import SmplRepresentation

STYLE = "normal"
"""Style of all clips: CMU has no labels."""
CACHE_VERSION = 1
"""Version of the conversion of the same files. Raise it by one with every change that produces other features, clips or
texts: caches of earlier versions are then prepared again."""

Rows = list[tuple[list[Clip], Float[Tensor, "frames features"]]]
"""Parts of recordings, each with its clips, which may touch and overlap."""


@dataclass(frozen=True)
class CmuClips:
    """A `Preparation` of CMU's motion capture database, which takes a few minutes and does not resume.

    Args:
        source: Folder with subjects' `.asf` and `.amc` files, conversions to `.bvh`, or both, at any depth; or a
            `.tar.xz` of one.
        fps: Frame rate of the features.
    """

    source: str | Path
    fps: float | int

    def check(self) -> Path:
        """Return the archive or folder. Raises `LayoutError` if it does not exist."""
        return find_source(self.source, "a folder of recordings or a .tar.xz")

    def fingerprint(self) -> str:
        """Compute a digest of the files, the cache version, the segments and the frame rate."""
        assets = Path(__file__).parents[3] / "assets"
        inputs = [self.check(), *(assets / f"{name}.json" for name in ("contents", "segments", "skeleton"))]
        return fingerprint(inputs, [self.fps, CACHE_VERSION])

    def prepared(self, scratch: Path, workers: int, watch: Watch) -> Cache:
        """Build the cache; see `Preparation`.

        Recordings without segments are ignored; other unusable ones are named.
        """
        segments, left_out = read_segments("cmu"), list[tuple[str, str]]()

        def jobs() -> Iterator[tuple[str, Job]]:
            for source in cmu.read_sources(self.check()):
                if isinstance(source, tuple):
                    left_out.append(source)
                elif source.name in segments:
                    yield source.name, (convert, source, self.fps)

        converted = dict(watch(in_parallel(jobs(), workers), len(segments)))
        present = converted.keys() | {name for name, _ in left_out}
        left_out += [(name, "not among the recordings") for name in segments if name not in present]
        return gather(converted, self.fps, left_out)


def convert(source: cmu.Source, fps: float | int) -> Rows:
    """Convert the segments of one recording and their mirror images to 205 features on the default skeleton.

    Each part runs from one segment to the last one that touches the others. The recording is encoded as a whole, with
    heights above its own floor, because a segment without ground contact does not determine the floor. Raises
    `ValueError` if the recording is invalid.
    """
    skeleton = Skeleton(Skeleton.default().offsets.double())
    motion = cmu.read(source, skeleton, fps)
    rows: Rows = []
    for mirrored, version in ((False, motion), (True, motion.mirrored())):
        features = encode_above_floor(Motion.posed(version.rotations, version.translation, fps, skeleton))
        clips = []
        for number, segment in enumerate(read_segments("cmu")[source.name]):
            first, last = round(segment.start * fps), min(round(segment.end * fps), len(features))
            if last - first < 2:
                raise cmu.CmuError(f"{len(features) / fps:g} s are too short for a segment from {segment.start:g} s on")
            clips.append(replace(_clip(segment, number, mirrored), start=first, end=last))
        rows += [_part(part, features) for part in _touching(clips, fps)]
    return rows


def _touching(clips: Sequence[Clip], fps: float | int) -> Iterator[list[Clip]]:
    """Group the clips of one recording that continue each other."""
    part, end = list[Clip](), 0
    for clip in sorted(clips, key=lambda clip: clip.start):
        if part and clip.start - end > TOUCHING * fps:
            yield part
            part = []
        part.append(clip)
        end = max(clip.end, end)
    yield part


def _part(clips: list[Clip], features: Float[Tensor, "frames features"]) -> tuple[list[Clip], Tensor]:
    first, last = clips[0].start, max(clip.end for clip in clips)
    shifted = [replace(clip, start=clip.start - first, end=clip.end - first, recording=clips[0].name) for clip in clips]
    return shifted, features[first:last]


def encode_above_floor(motion: Motion) -> Float[Tensor, "frames features"]:
    """Compute features, with the height of the pelvis above the floor (z = 0) instead of the motion's lowest joint.

    Raises `CmuError` if they are not finite.
    """
    representation = SmplRepresentation()
    features = representation.encode(motion)
    features[:, representation.layout["root_height"]] = motion.translation[:, 2:]
    if not features.isfinite().all():
        raise cmu.CmuError("its features are not all finite")
    return features.float()


def gather(recordings: Mapping[str, Rows | str], fps: float | int, left_out: Sequence[tuple[str, str]] = ()) -> Cache:
    """Build the cache of all converted recordings, in the order of their names, without a fingerprint.

    Args:
        recordings: Rows of each recording, or the reason for its omission.
        fps: Frame rate of the features.
        left_out: Further omissions.

    Raises:
        ValueError: If no recording remains.
    """
    skipped = [*left_out, *((name, rows) for name, rows in recordings.items() if isinstance(rows, str))]
    converted = [rows for _, rows in sorted(recordings.items()) if not isinstance(rows, str)]
    if not converted:
        first = f"; the first: {skipped[0][0]}: {skipped[0][1]}" if skipped else ""
        raise ValueError(f"no recording could be used; {len(skipped)} were skipped{first}")
    clips, start = list[Clip](), 0
    for part, features in (row for rows in converted for row in rows):
        clips += [replace(clip, start=start + clip.start, end=start + clip.end) for clip in part]
        start += len(features)
    all_features = torch.cat([features for rows in converted for _, features in rows])
    texts = {clip.texts: describe(clip.content, clip.style) for clip in clips}
    return Cache(fps, "smpl", all_features, tuple(clips), texts, tuple(skipped))


def _clip(segment: Segment, number: int, mirrored: bool) -> Clip:
    """Create the clip of a segment, or of its mirror image, without its frames."""
    name, content = f"{segment.recording}/{number}", segment.content
    content = mirror_content(content) if mirrored else content
    return Clip(
        name=f"M/{name}" if mirrored else name,
        content=content,
        style=STYLE,
        texts=f"{content}/{STYLE}",
        parts=tuple(sorted(CONTENTS[content].parts)),
        cyclic=CONTENTS[content].cyclic,
        mirrored=mirrored,
        split=splits().get(segment.recording, "train"),
        start=0,
        end=1,
    )
