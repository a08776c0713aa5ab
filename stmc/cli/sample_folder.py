"""The output folder of `stmc sample`: the files of each motion beside a record of their request."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, count
from pathlib import Path
from typing import Any, NamedTuple

import stmc
from stmc.editing.generate_request import GenerateRequest, prompts_of
from stmc.io.bounds import check_pictures
from stmc.io.filenames import name_of_texts
from stmc.io.files import lock_file, scratch, sha256, write_text
from stmc.io.untrusted import MOST_BYTES, UnreadableError, load_json, read_text
from stmc.timeline import Timeline
from stmc.viewing.exports import CHARACTER_EXPORTS, EXPORTS, export
from stmc.viewing.web import Doubtful

FORMATS = ("npz", "bvh", "html")
"""Default formats without a character."""
CHOICES = tuple(dict.fromkeys((*FORMATS, *(each.name for each in (*EXPORTS, *CHARACTER_EXPORTS)))))


def default_formats(character: stmc.Character | None) -> tuple[str, ...]:
    """Return the formats of a motion for which none are asked: a character's own takes the place of `.bvh`."""
    return FORMATS if character is None else ("npz", character.formats[0][1:], "html")


class Job(NamedTuple):
    """One motion to sample: the name of its files, and a request for it alone."""

    name: str
    request: GenerateRequest

    @property
    def timeline(self) -> Timeline:
        """The timeline of the motion."""
        return self.request.timelines[0]

    @property
    def seed(self) -> int:
        """The seed of the motion."""
        return self.request.seeds[0]


@dataclass(frozen=True)
class MotionFolder:
    """A folder of motions.

    Args:
        path: The folder.
        formats: Formats of every motion.
        fps: Frame rate of the files; None: the motions' own.
        made_by: Entries of the records about the model and its files.
        character: Character of the formats that can show it; None: the library's own body.
    """

    path: Path
    formats: Sequence[str]
    fps: float | int | None
    made_by: Mapping[str, Any]
    character: stmc.Character | None = None

    def record(self, job: Job) -> dict[str, Any]:
        """Return everything that decides the content of a motion's files."""
        rate = {} if self.fps is None else {"fps": self.fps}
        return {**job.request.decides(), **rate, **self.made_by, "version": stmc.__version__}

    def is_finished(self, job: Job) -> bool:
        """Return whether the folder holds the motion of this request in all formats."""
        request, digests = self._recorded(job.name)
        return request == self.record(job) and set(self.formats) <= self._whole(job.name, digests)

    def check_lengths(self, jobs: Sequence[Job], fps: float | int) -> None:
        """Raise `BoundsError` if a motion of these jobs is too long for a format; `fps` is the model's frame rate."""
        frames = round(max(job.timeline.duration for job in jobs) * (self.fps or fps))
        for each in EXPORTS:
            if each.animated and each.name in self.formats:
                check_pictures(each.name, frames)

    def save(self, motion: stmc.Motion, job: Job, doubtful: Sequence[Doubtful] = ()) -> list[Path]:
        """Write the motion in all formats, with its record, and return the paths.

        Files are written aside and renamed under a lock, together with the record of their digests. Files of an earlier
        request are deleted.
        """
        motion = motion if self.fps is None else motion.resampled(self.fps)
        with scratch(self.path / job.name) as aside:
            made = [aside / f"{job.name}.{kind}" for kind in self.formats]
            for path in made:
                self._write(motion, path, job, doubtful)
            digests = {path.suffix[1:]: sha256(path) for path in made}
            with lock_file(self.path / f".{job.name}.lock", math.inf):
                request, former = self._recorded(job.name)
                kept = self._whole(job.name, former) if request == self.record(job) else set()
                for kind in former.keys() - kept:
                    (self.path / f"{job.name}.{kind}").unlink(missing_ok=True)
                (self.path / f"{job.name}.json").unlink(missing_ok=True)
                paths = [path.replace(self.path / path.name) for path in made]
                done = self.record(job) | {"files": {kind: former[kind] for kind in kept} | digests}
                write_text(self.path / f"{job.name}.json", json.dumps(done, indent=1, ensure_ascii=False) + "\n")
        return paths

    def _write(self, motion: stmc.Motion, path: Path, job: Job, doubtful: Sequence[Doubtful]) -> None:
        options = {"title": job.name, "doubtful": doubtful, "constraints": job.request.constraints, "fps": self.fps}
        export(motion, path, job.timeline, self.character, **options)

    def free_name(self, timeline: Timeline) -> str:
        """Return a name for a typed timeline, made of its texts.

        A number follows if the folder has motions of the same texts at other times or for other body parts.
        """
        base = name_of_texts(prompt.text for prompt in timeline.prompts)
        names = chain([base], (f"{base}-{number}" for number in count(2)))
        return next(name for name in names if self._prompts(name) in ([], [prompts_of(timeline)]))

    def _prompts(self, name: str) -> list[list]:
        """Return the distinct prompts in the records of this name, over all seeds."""
        paths = [path for path in self.path.glob(f"{name}_*.json") if path.stem[len(name) + 1 :].isdigit()]
        records = [read_record(path) for path in paths]
        prompts = [record["prompts"] for record in records if "prompts" in record]
        return [each for number, each in enumerate(prompts) if each not in prompts[:number]]

    def _recorded(self, name: str) -> tuple[dict | None, dict[str, str | None]]:
        """Return the request in a motion's record, and the SHA-256 of its files by format.

        A damaged or older record yields no request, and every format without a digest.
        """
        path = self.path / f"{name}.json"
        if not path.exists():
            return None, {}
        request = read_record(path)
        digests = request.pop("files", None)
        if not isinstance(digests, dict):
            return None, dict.fromkeys(CHOICES)
        return request, {kind: digests[kind] for kind in CHOICES if kind in digests}

    def _whole(self, name: str, digests: Mapping[str, str | None]) -> set[str]:
        """Return the formats whose files match their digests."""
        files = {kind: self.path / f"{name}.{kind}" for kind in digests}
        return {kind for kind, path in files.items() if path.is_file() and sha256(path) == digests[kind]}


def read_record(path: Path) -> dict:
    """Read the record beside a motion, within bounds; return an empty one if it is absent or unreadable."""
    try:
        record = load_json(read_text(path, MOST_BYTES))
    except (OSError, UnreadableError):
        return {}
    return record if isinstance(record, dict) else {}
