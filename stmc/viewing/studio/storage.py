"""Storage of the studio: motions and documents, written atomically.

This module knows files and versions; it does not know the contents of documents.
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
from stmc.formats.characters import Character
from stmc.io.bounds import BoundsError, check_metres, check_pictures
from stmc.io.files import lock_folder, remove_leftovers, write_text
from stmc.io.untrusted import UnreadableError, load_json, read_text
from stmc.motion.loops import looped
from stmc.motion.motion import Motion
from stmc.timeline import Timeline
from stmc.viewing.exports import EXPORTS, FILMS, export, exports_of
from stmc.viewing.studio.documents_json import MOST_SECONDS
from stmc.viewing.studio.request_errors import RequestError

ID = re.compile(r"[A-Za-z0-9_-]{1,40}")

MOST_MOTIONS, MOST_MOTION_BYTES = 400, 2**31
"""Maximum number and bytes of stored motions, the newest, not counting older ones that documents name."""

PRUNE_AFTER = 40
"""Number of new motions after which old ones are removed."""

MOST_FILM_FRAMES = 9000
"""Maximum number of frames of a film: five minutes at 30 frames per second."""

MOST_POSES = 2_000_000
"""Maximum number of frames times moving joints of a character."""

MOST_DOCUMENT = 2**20
"""Maximum size of a document in bytes."""

MOST_DOCUMENTS = 1000

REMEMBERED = 64
"""Maximum number of motions in memory."""

PATIENCE = 10.0
"""Maximum seconds to wait while another process writes a document."""


def private_folder(folder: Path | str) -> Path:
    """Make a folder that only its owner can read; an existing folder is unchanged."""
    folder = Path(folder)
    if not folder.is_dir():
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    return folder


def own_folder(folder: Path | str) -> Path:
    """Make or restrict a folder so that only its owner can read it, and remove leftovers of killed processes."""
    folder = private_folder(folder)
    folder.chmod(0o700)
    remove_leftovers(folder)
    return folder


def _check_identity(identity: str) -> str:
    if not ID.fullmatch(identity):
        raise RequestError(404, "nothing is stored under this identifier")
    return identity


@dataclass(eq=False)
class Motions:
    """Motions by name, stored as `.npz` in a folder, so that they outlive the server.

    Examples:
        >>> motions = stmc.viewing.studio.Motions("motions")
        >>> name = motions.add(stmc.load().generate("walk # 0 # 1", steps=1)[0])
        >>> motions.get(name)
        Motion(20 frames at 20 fps, 1.00 s)
    """

    folder: Path | str
    named: Callable[[], str] = str
    """Function that returns a text with the names of all motions to keep, however old: that of the documents."""
    _recent: OrderedDict[str, Motion] = field(default_factory=OrderedDict, repr=False)
    _lock: Lock = field(default_factory=Lock, repr=False)
    _film: Lock = field(default_factory=Lock, repr=False)
    _heavy: Semaphore = field(default_factory=lambda: Semaphore(2), repr=False)
    _added: int = field(default=0, repr=False)

    def __post_init__(self) -> None:
        self._folder = own_folder(self.folder)

    def add(self, motion: Motion) -> str:
        """Store a motion and return its name; regularly remove old ones."""
        name = secrets.token_urlsafe(9)
        path = self._folder / f"{name}.npz"
        write(motion, path)
        path.chmod(0o600)
        self._hold(name, motion)
        self._added += 1
        if self._added % PRUNE_AFTER == 0:
            self.prune()
        return name

    def get(self, name: str) -> Motion:
        """Return the motion with this name. Raises `RequestError` if it is missing or damaged."""
        with self._lock:
            if name in self._recent:
                self._recent.move_to_end(name)
                return self._recent[name]
        path = self._folder / f"{_check_identity(name)}.npz"
        if not path.exists():
            raise RequestError(404, "that motion is no longer stored; generate it again")
        try:
            motion = read(path)
        except ValueError as error:
            raise RequestError(422, f"that motion is damaged: {str(error).replace(str(path), 'its file')}") from None
        _check_bounds(motion)
        self._hold(name, motion)
        return motion

    def describe(self, name: str) -> dict[str, Any]:
        """Describe a motion for the page: its name, seconds, frames, and frames per second."""
        motion = self.get(name)
        return {"id": name, "duration": motion.duration, "fps": motion.fps, "frames": motion.frames}

    def receive(self, content: bytes, kind: str) -> str:
        """Store the motion of an uploaded file with the suffix `kind`. Raises `RequestError` if the file is invalid."""
        readable = [each.suffix for each in READABLE]
        if kind not in readable:
            raise RequestError(422, f"a recorded motion must be a {' or a '.join(readable)} file")
        with self._heavy, tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"motion{kind}"
            path.write_bytes(content)
            try:
                motion = read(path)
            except ValueError as error:
                raise RequestError(422, str(error).replace(str(path), "the file")) from None
        _check_bounds(motion)
        return self.add(motion)

    def export(
        self,
        name: str,
        kind: str,
        timeline: Timeline | None,
        fps: float | int | None,
        loop: bool,
        constraints: Sequence[Constraint] = (),
        character: Character | None = None,
    ) -> bytes:
        """Export a motion as the bytes of a file.

        Raises:
            RequestError: For unknown formats, for missing packages, and for motions that cannot be looped, resampled or
                written.

        Args:
            name: Name of the motion.
            kind: Name of a format in `exports_of(character.formats)`.
            timeline: Timeline of the motion, or None; a loop has none, since it has other times.
            fps: Frame rate; None: that of the motion.
            loop: Whether to make the motion a loop.
            constraints: Constraints to draw; a loop has none.
            character: Character that moves in the formats that it can be written as, or None.
        """
        names = [each.name for each in exports_of(() if character is None else character.formats)]
        if kind not in names:
            raise RequestError(404, f"no .{kind}: choose from {', '.join(names)}")
        motion = self.variant(name, fps, loop)
        timeline, constraints = (None, ()) if loop else (timeline, constraints)
        try:
            if f".{kind}" in FILMS:
                return self._film_of(motion, kind, timeline)
            with self._heavy:
                return _file_of(motion, kind, timeline, constraints, character)
        except RequestError:
            raise
        except (ValueError, OverflowError) as error:
            raise RequestError(422, str(error)) from None

    def variant(self, name: str, fps: float | int | None, loop: bool) -> Motion:
        """Return a motion at another frame rate, or as a loop.

        Raises `RequestError` for a motion that is missing, or that cannot be looped or resampled.

        Args:
            name: Name of the motion.
            fps: Frame rate; None: that of the motion.
            loop: Whether to make the motion a loop.
        """
        motion = self.get(name)
        try:
            motion = looped(motion) if loop else motion
            return motion if fps is None else motion.resampled(fps)
        except (ValueError, OverflowError) as error:
            raise RequestError(422, str(error)) from None

    def _film_of(self, motion: Motion, kind: str, timeline: Timeline | None) -> bytes:
        """Render one film at a time, since each takes a processor for minutes."""
        check_film(motion, kind)
        if not self._film.acquire(blocking=False):
            raise RequestError(429, "another film is being rendered; wait until it is done")
        try:
            return _file_of(motion, kind, timeline)
        finally:
            self._film.release()

    def prune(self) -> None:
        """Remove the oldest motions beyond `MOST_MOTIONS` or `MOST_MOTION_BYTES`, except those in `named`.

        The folder belongs to one server at a time, so no other server shows a removed motion.
        """
        files = [(path.stat(), path) for path in self._folder.glob("*.npz") if path.is_file()]
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
            self._recent[name] = motion
            while len(self._recent) > REMEMBERED:
                self._recent.popitem(last=False)


def _check_bounds(motion: Motion) -> None:
    """Raise `RequestError` for a motion that is too long or too far away for the studio."""
    if motion.duration > MOST_SECONDS:
        raise RequestError(422, f"{motion.duration:g} s: {MOST_SECONDS} at most in the studio")
    try:
        check_metres("the motion", float(motion.translation.abs().max()))
    except BoundsError as error:
        raise RequestError(422, str(error)) from None


def check_film(motion: Motion, kind: str) -> None:
    """Raise `RequestError` for a motion that is too long for a film of the format `kind`."""
    if motion.frames > MOST_FILM_FRAMES:
        raise RequestError(422, f"{motion.frames} frames: a film has {MOST_FILM_FRAMES} at most; lower the frame rate")
    try:
        if any(each.name == kind and each.animated for each in EXPORTS):
            check_pictures(kind, motion.frames)
    except BoundsError as error:
        raise RequestError(422, str(error)) from None


def check_poses(motion: Motion, character: Character) -> None:
    """Raise `RequestError` for a motion that is too long for a character."""
    joints = len(character.rig.driven)
    if motion.frames * joints > MOST_POSES:
        most = MOST_POSES // joints
        raise RequestError(422, f"{motion.frames} frames: {most} at most of this character; lower the frame rate")


def _file_of(
    motion: Motion,
    kind: str,
    timeline: Timeline | None,
    constraints: Sequence[Constraint] = (),
    character: Character | None = None,
) -> bytes:
    if character is not None:
        check_poses(motion, character)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"motion.{kind}"
        try:
            title = timeline.name if timeline else "motion"
            export(motion, path, timeline, character, title=title, constraints=constraints)
        except ModuleNotFoundError as error:
            raise RequestError(501, str(error)) from None
        return path.read_bytes()


@dataclass(eq=False)
class Documents:
    """Documents of the page, each with a version that counts its changes.

    A change names the version that it is based on, so that no tab overwrites the changes of another unknowingly.

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
        self._folder = own_folder(self.folder)

    def all(self) -> list[dict[str, Any]]:
        """List name, version and time of readable documents, the last changed first."""
        found = []
        for path in self._folder.glob("*.json"):
            try:
                document = self.get(path.stem)
                name, changed = str(document["content"].get("name", "")), path.stat().st_mtime
            except (RequestError, OSError):
                continue
            found.append({"id": path.stem, "name": name, "version": document["version"], "changed": changed})
        return sorted(found, key=lambda each: -each["changed"])

    def get(self, name: str) -> dict[str, Any]:
        """Return version and content of a document. Raises `RequestError` if it is missing or damaged."""
        try:
            document = load_json(read_text(self._path(name), 2 * MOST_DOCUMENT))
        except FileNotFoundError:
            raise RequestError(404, "there is no such document") from None
        except (UnreadableError, OSError) as error:
            raise RequestError(422, f"the document is damaged: {error}") from None
        shape = isinstance(document, dict) and document.keys() == {"version", "content"}
        if not shape or not isinstance(document["version"], int) or not isinstance(document["content"], dict):
            raise RequestError(422, "the document is damaged: version or content is missing")
        return document

    def put(self, name: str, base: int, content: dict[str, Any]) -> int:
        """Save a document and return its new version.

        Raises:
            RequestError: With status 409 and the newer document if it was changed meanwhile; for one that is too large.

        Args:
            name: Name of the document.
            base: Version that the change is based on; 0: none.
            content: New content.
        """
        text = json.dumps(content, ensure_ascii=False, allow_nan=False)
        if len(text.encode()) > MOST_DOCUMENT:
            raise RequestError(413, f"the document is larger than {MOST_DOCUMENT / 2**20:g} MiB")
        with self._lock, lock_folder(self._folder, PATIENCE):  # threads, and other processes
            path = self._path(name)
            now: dict[str, Any] = self.get(name) if path.exists() else {"version": 0, "content": None}
            if now["version"] != base and now["content"] is not None:
                raise RequestError(409, "the document was changed elsewhere meanwhile", **now)
            if not path.exists() and sum(1 for _ in self._folder.glob("*.json")) >= MOST_DOCUMENTS:
                raise RequestError(507, f"there are {MOST_DOCUMENTS} documents; delete some")
            version = max(base, now["version"]) + 1
            write_text(path, json.dumps({"version": version, "content": content}, ensure_ascii=False))
            path.chmod(0o600)
            return version

    def delete(self, name: str) -> None:
        """Delete a document, if it exists."""
        self._path(name).unlink(missing_ok=True)

    def texts(self) -> str:
        """Return the texts of all readable documents, to search for names."""
        found = []
        for path in self._folder.glob("*.json"):
            try:
                found.append(read_text(path, 2 * MOST_DOCUMENT))
            except (UnreadableError, OSError):
                continue
        return "\n".join(found)

    def _path(self, name: str) -> Path:
        return self._folder / f"{_check_identity(name)}.json"
