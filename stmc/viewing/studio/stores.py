"""What the studio keeps in its folder: motions, and the page's documents. Both are whole or not there.

Knows files and versions; knows nothing of what a document says.
"""

from __future__ import annotations

import json
import re
import secrets
import tempfile
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock, Semaphore
from typing import Any

from stmc.editing.constraints import Constraint
from stmc.formats import READABLE, read, write
from stmc.io.bounds import BoundsError, check_metres
from stmc.io.files import locked, remove_leftovers, write_text
from stmc.io.untrusted import UnreadableError, load_json, read_text
from stmc.motion.loops import looped
from stmc.motion.motion import Motion
from stmc.timeline import Timeline
from stmc.viewing.exports import EXPORTS, FILMS, export
from stmc.viewing.studio.documents_json import MOST_SECONDS
from stmc.viewing.studio.refusals import Refused

ID = re.compile(r"[A-Za-z0-9_-]{1,40}")

MOST_MOTIONS, MOST_MOTION_BYTES = 400, 2**31
"""Motions that are kept, and their bytes on the disk, beside those that documents name: the newest."""

PRUNE_AFTER = 40
"""New motions after which old ones are looked for again."""

MOST_FILM_FRAMES = 9000
"""Frames of a film, which are drawn one by one: five minutes at 30 a second."""

MOST_DOCUMENT = 2**20
"""Bytes of a document."""

MOST_DOCUMENTS = 1000

REMEMBERED = 64
"""Motions held in memory."""

PATIENCE = 10.0
"""Seconds for which one process waits until another has written a document."""


def private_folder(folder: Path | str) -> Path:
    """Make a folder that only its owner can look into; one that is there stays as it is."""
    folder = Path(folder)
    if not folder.is_dir():
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    return folder


def _own_folder(folder: Path | str) -> Path:
    """The same, also where an earlier version made it for everybody; what killed processes left there goes."""
    folder = private_folder(folder)
    folder.chmod(0o700)
    remove_leftovers(folder)
    return folder


def _named(identity: str) -> str:
    if not ID.fullmatch(identity):
        raise Refused(404, "there is no such thing")
    return identity


@dataclass(eq=False)
class Motions:
    """Motions by their names, as `.npz` in a folder, so that they outlive the server.

    Examples:
        >>> motions = stmc.viewing.studio.Motions("motions")
        >>> name = motions.add(stmc.load().generate("walk # 0 # 1", steps=1)[0])
        >>> motions.get(name)
        Motion(20 frames at 20 fps, 1.00 s)
    """

    folder: Path | str
    named: Callable[[], str] = str
    """A text with the names of all motions that have to stay, however old: the documents'."""
    _held: OrderedDict[str, Motion] = field(default_factory=OrderedDict, repr=False)
    _lock: Lock = field(default_factory=Lock, repr=False)
    _film: Lock = field(default_factory=Lock, repr=False)
    _heavy: Semaphore = field(default_factory=lambda: Semaphore(2), repr=False)
    _added: int = field(default=0, repr=False)

    def __post_init__(self) -> None:
        self.folder = _own_folder(self.folder)

    def add(self, motion: Motion) -> str:
        """Keep a motion, and return its name; now and then the oldest go."""
        name = secrets.token_urlsafe(9)
        path = self.folder / f"{name}.npz"
        write(motion, path)
        path.chmod(0o600)
        self._hold(name, motion)
        self._added += 1
        if self._added % PRUNE_AFTER == 0:
            self.prune()
        return name

    def get(self, name: str) -> Motion:
        """Raises `Refused` for a name that no motion has."""
        with self._lock:
            if name in self._held:
                self._held.move_to_end(name)
                return self._held[name]
        path = self.folder / f"{_named(name)}.npz"
        if not path.exists():
            raise Refused(404, "that motion is no longer kept; make it anew")
        try:
            motion = read(path)
        except ValueError as error:
            raise Refused(422, f"that motion is damaged: {str(error).replace(str(path), 'its file')}") from None
        _check_bounds(motion)
        self._hold(name, motion)
        return motion

    def told(self, name: str) -> dict[str, Any]:
        """What the page knows of a motion: its name, seconds, frames, and frames a second."""
        motion = self.get(name)
        return {"id": name, "duration": motion.duration, "fps": motion.fps, "frames": motion.frames}

    def received(self, content: bytes, kind: str) -> str:
        """Keeps the motion of somebody's file with the suffix `kind`. Raises `Refused` where it is none."""
        readable = [each.suffix for each in READABLE]
        if kind not in readable:
            raise Refused(422, f"a recorded motion is a {' or a '.join(readable)} file")
        with self._heavy, tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"motion{kind}"
            path.write_bytes(content)
            try:
                motion = read(path)
            except ValueError as error:
                raise Refused(422, str(error).replace(str(path), "the file")) from None
        _check_bounds(motion)
        return self.add(motion)

    def exported(
        self,
        name: str,
        kind: str,
        timeline: Timeline | None,
        fps: float | int | None,
        loop: bool,
        constraints: Sequence[Constraint] = (),
    ) -> bytes:
        """A motion as a file of one of `EXPORTS`; a loop goes without the timeline and the constraints, whose times are
        not the loop's.

        Raises `Refused` for other formats, for one that needs what is not installed, and for what cannot be a loop, be
        brought to that frame rate, or be written in that format."""
        names = [each.name for each in EXPORTS]
        if kind not in names:
            raise Refused(404, f"no .{kind}: choose from {', '.join(names)}")
        motion = self.get(name)
        try:
            if loop:
                motion, timeline, constraints = looped(motion), None, ()
            if f".{kind}" in FILMS:
                return self._film_of(_at_rate(motion, fps), kind, timeline)
            with self._heavy:
                return _file_of(_at_rate(motion, fps), kind, timeline, constraints)
        except Refused:
            raise
        except (ValueError, OverflowError) as error:
            raise Refused(422, str(error)) from None

    def _film_of(self, motion: Motion, kind: str, timeline: Timeline | None) -> bytes:
        """One film at a time: each takes a processor for minutes."""
        if motion.frames > MOST_FILM_FRAMES:
            raise Refused(422, f"{motion.frames} frames: a film has {MOST_FILM_FRAMES} at most; lower the frame rate")
        if not self._film.acquire(blocking=False):
            raise Refused(429, "another film is being drawn; wait for its end")
        try:
            return _file_of(motion, kind, timeline)
        finally:
            self._film.release()

    def prune(self) -> None:
        """Remove the oldest beyond `MOST_MOTIONS` or `MOST_MOTION_BYTES`, but for those that `named` names.

        The folder belongs to one server at a time, so that nothing goes which another one shows."""
        files = [(path.stat(), path) for path in self.folder.glob("*.npz") if path.is_file()]
        old, total = [], 0
        for number, (status, path) in enumerate(sorted(files, key=lambda each: each[0].st_mtime, reverse=True)):
            total += status.st_size
            if number >= MOST_MOTIONS or total > MOST_MOTION_BYTES:
                old.append(path)
        named = self.named() if old else ""
        for path in old:
            if path.stem not in named:
                path.unlink(missing_ok=True)

    def _hold(self, name: str, motion: Motion) -> None:
        with self._lock:
            self._held[name] = motion
            while len(self._held) > REMEMBERED:
                self._held.popitem(last=False)


def _at_rate(motion: Motion, fps: float | int | None) -> Motion:
    return motion if fps is None else motion.resampled(fps)


def _check_bounds(motion: Motion) -> None:
    """Raise `Refused` for a motion longer or farther away than the studio makes any."""
    if motion.duration > MOST_SECONDS:
        raise Refused(422, f"{motion.duration:g} s: {MOST_SECONDS} at most in the studio")
    try:
        check_metres("the motion", float(motion.translation.abs().max()))
    except BoundsError as error:
        raise Refused(422, str(error)) from None


def _file_of(motion: Motion, kind: str, timeline: Timeline | None, constraints: Sequence[Constraint] = ()) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"motion.{kind}"
        try:
            title = timeline.name if timeline else "motion"
            export(motion, path, timeline, title=title, constraints=constraints)
        except ModuleNotFoundError as error:
            raise Refused(501, str(error)) from None
        return path.read_bytes()


@dataclass(eq=False)
class Documents:
    """The page's documents, each with a version that counts its changes: whoever changes one says which version it
    began with, so that of two tabs none overwrites the other unknowingly.

    Examples:
        >>> documents = stmc.viewing.studio.Documents("documents")
        >>> documents.put("walk", 0, {"name": "A walk"})
        1
        >>> documents.get("walk")["content"]
        {'name': 'A walk'}
    """

    folder: Path | str
    _lock: Lock = field(default_factory=Lock, repr=False)

    def __post_init__(self) -> None:
        self.folder = _own_folder(self.folder)

    def all(self) -> list[dict[str, Any]]:
        """Name, version and time of each, the last changed first; what cannot be read is left out."""
        found = []
        for path in self.folder.glob("*.json"):
            try:
                document = self.get(path.stem)
                name, changed = str(document["content"].get("name", "")), path.stat().st_mtime
            except (Refused, OSError):
                continue
            found.append({"id": path.stem, "name": name, "version": document["version"], "changed": changed})
        return sorted(found, key=lambda each: -each["changed"])

    def get(self, name: str) -> dict[str, Any]:
        """Its version and content. Raises `Refused` where there is none, or it is damaged."""
        try:
            document = load_json(read_text(self._path(name), 2 * MOST_DOCUMENT))
        except FileNotFoundError:
            raise Refused(404, "there is no such document") from None
        except (UnreadableError, OSError) as error:
            raise Refused(422, f"the document is damaged: {error}") from None
        shape = isinstance(document, dict) and document.keys() == {"version", "content"}
        if not shape or not isinstance(document["version"], int) or not isinstance(document["content"], dict):
            raise Refused(422, "the document is damaged: version and content needed")
        return document

    def put(self, name: str, base: int, content: dict[str, Any]) -> int:
        """Replaces the document that had the version `base` (0: none), and returns the new version. Raises `Refused`
        (409), with the newer one, where it was changed meanwhile, and for one that is too large."""
        text = json.dumps(content, ensure_ascii=False, allow_nan=False)
        if len(text.encode()) > MOST_DOCUMENT:
            raise Refused(413, f"the document is larger than {MOST_DOCUMENT / 2**20:g} MiB")
        with self._lock, locked(self.folder, PATIENCE):  # threads, and other processes
            path = self._path(name)
            now = self.get(name) if path.exists() else {"version": 0, "content": None}
            if now["version"] != base and now["content"] is not None:
                raise Refused(409, "the document was changed elsewhere meanwhile", **now)
            if not path.exists() and sum(1 for _ in self.folder.glob("*.json")) >= MOST_DOCUMENTS:
                raise Refused(507, f"there are {MOST_DOCUMENTS} documents; delete some")
            version = max(base, now["version"]) + 1
            write_text(path, json.dumps({"version": version, "content": content}, ensure_ascii=False))
            path.chmod(0o600)
            return version

    def delete(self, name: str) -> None:
        """A document that is not there is deleted already."""
        self._path(name).unlink(missing_ok=True)

    def texts(self) -> str:
        """All that can be read, to look for names in."""
        found = []
        for path in self.folder.glob("*.json"):
            try:
                found.append(read_text(path, 2 * MOST_DOCUMENT))
            except (UnreadableError, OSError):
                continue
        return "\n".join(found)

    def _path(self, name: str) -> Path:
        return self.folder / f"{_named(name)}.json"
