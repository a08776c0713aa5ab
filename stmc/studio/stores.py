"""What the studio keeps in its folder: motions, and the page's documents. Both are whole or not there.

Knows files and versions; knows nothing of what a document says.
"""

from __future__ import annotations

import json
import re
import secrets
import tempfile
from collections import OrderedDict
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock
from typing import Any

from stmc.export import read, write
from stmc.files import remove_leftovers, write_text
from stmc.loops import looped
from stmc.motion import Motion
from stmc.studio.refusals import Refused
from stmc.timeline import Timeline
from stmc.untrusted import UnreadableError, load_json, read_text
from stmc.viewing import render_film
from stmc.viewing.film_formats import FILMS
from stmc.viewing.web import render_html

ID = re.compile(r"[A-Za-z0-9_-]{1,40}")

MOST_MOTIONS = 400
"""Motions that are kept, beside those that documents name: the newest."""

MOST_DOCUMENT = 2**20
"""Bytes of a document."""

MOST_DOCUMENTS = 1000

REMEMBERED = 64
"""Motions held in memory."""

FORMATS = {
    "glb": "a skinned figure: Blender, Unity, Unreal, the web",
    "bvh": "a skeleton: Blender, Maya, MotionBuilder",
    "npz": "AMASS's arrays, and stmc's own",
    "csv": "MuJoCo's qpos, for robots",
    "xml": "MuJoCo's model of the figure",
    "html": "a page to look at and to share",
    "webp": "a film for pages and chats",
    "mp4": "a film",
}
"""What a motion can be taken away as."""

RECEIVED = (".npz", ".bvh")
"""Suffixes of motions that are brought along."""


def _named(identity: str) -> str:
    if not ID.fullmatch(identity):
        raise Refused(404, "there is no such thing")
    return identity


@dataclass(eq=False)
class Motions:
    """Motions by their names, as `.npz` in a folder, so that they outlive the server.

    Examples:
        >>> motions = stmc.studio.Motions("motions")
        >>> name = motions.add(stmc.load().generate("walk # 0 # 1", steps=1)[0])
        >>> motions.get(name)
        Motion(20 frames at 20 fps, 1.00 s)
    """

    folder: Path | str
    _held: OrderedDict[str, Motion] = field(default_factory=OrderedDict, repr=False)
    _lock: Lock = field(default_factory=Lock, repr=False)

    def __post_init__(self) -> None:
        self.folder = Path(self.folder)
        self.folder.mkdir(parents=True, exist_ok=True)
        remove_leftovers(self.folder)

    def add(self, motion: Motion) -> str:
        """Keeps a motion, and returns its name."""
        name = secrets.token_urlsafe(9)
        write(motion, self.folder / f"{name}.npz")
        self._hold(name, motion)
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
        motion = read(path)
        self._hold(name, motion)
        return motion

    def told(self, name: str) -> dict[str, Any]:
        """What the page knows of a motion: its name, seconds, frames, and frames a second."""
        motion = self.get(name)
        return {"id": name, "duration": motion.duration, "fps": motion.fps, "frames": motion.frames}

    def received(self, content: bytes, kind: str) -> str:
        """Keeps the motion of somebody's file with the suffix `kind`. Raises `Refused` where it is none."""
        if kind not in RECEIVED:
            raise Refused(422, f"a recorded motion is a {' or a '.join(RECEIVED)} file")
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"motion{kind}"
            path.write_bytes(content)
            try:
                motion = read(path)
            except ValueError as error:
                raise Refused(422, str(error).replace(str(path), "the file")) from None
        return self.add(motion)

    def exported(self, name: str, kind: str, timeline: Timeline | None, fps: float | int | None, loop: bool) -> bytes:
        """A motion as a file of one of `FORMATS`; a loop goes without the timeline, whose times are not the loop's.

        Raises `Refused` for other formats, for one that needs what is not installed, and for what cannot be a loop."""
        if kind not in FORMATS:
            raise Refused(404, f"no .{kind}: choose from {', '.join(FORMATS)}")
        motion = self.get(name)
        if loop:
            try:
                motion, timeline = looped(motion), None
            except ValueError as error:
                raise Refused(422, str(error)) from None
        motion = motion if fps is None else motion.resampled(fps)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"motion.{kind}"
            if kind == "html":
                write_text(path, render_html(motion, timeline, title=timeline.name if timeline else "motion"))
            elif path.suffix in FILMS:
                try:
                    render_film(motion, path, timeline)
                except ModuleNotFoundError as error:
                    raise Refused(501, str(error)) from None
            else:
                write(motion, path, timeline=timeline)
            return path.read_bytes()

    def prune(self, named: str) -> None:
        """Removes the oldest beyond `MOST_MOTIONS`, but for those whose names stand in the text."""
        paths = sorted(self.folder.glob("*.npz"), key=lambda path: path.stat().st_mtime, reverse=True)
        for path in paths[MOST_MOTIONS:]:
            if path.stem not in named:
                path.unlink(missing_ok=True)

    def _hold(self, name: str, motion: Motion) -> None:
        with self._lock:
            self._held[name] = motion
            while len(self._held) > REMEMBERED:
                self._held.popitem(last=False)


@dataclass(eq=False)
class Documents:
    """The page's documents, each with a version that counts its changes: whoever changes one says which version it
    began with, so that of two tabs none overwrites the other unknowingly.

    Examples:
        >>> documents = stmc.studio.Documents("documents")
        >>> documents.put("walk", 0, {"name": "A walk"})
        1
        >>> documents.get("walk")["content"]
        {'name': 'A walk'}
    """

    folder: Path | str
    _lock: Lock = field(default_factory=Lock, repr=False)

    def __post_init__(self) -> None:
        self.folder = Path(self.folder)
        self.folder.mkdir(parents=True, exist_ok=True)
        remove_leftovers(self.folder)

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
        with self._lock:
            path = self._path(name)
            now = self.get(name) if path.exists() else {"version": 0, "content": None}
            if now["version"] != base and now["content"] is not None:
                raise Refused(409, "the document was changed elsewhere meanwhile", **now)
            if not path.exists() and sum(1 for _ in self.folder.glob("*.json")) >= MOST_DOCUMENTS:
                raise Refused(507, f"there are {MOST_DOCUMENTS} documents; delete some")
            version = max(base, now["version"]) + 1
            write_text(path, json.dumps({"version": version, "content": content}, ensure_ascii=False))
            return version

    def delete(self, name: str) -> None:
        """A document that is not there is deleted already."""
        self._path(name).unlink(missing_ok=True)

    def texts(self) -> str:
        """All of them, to look for names in."""
        return "\n".join(path.read_text("utf-8", errors="replace") for path in self.folder.glob("*.json"))

    def _path(self, name: str) -> Path:
        return self.folder / f"{_named(name)}.json"
