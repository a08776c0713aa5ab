"""Storage of the studio's characters: files of users, read as hostile, and their poses in stored motions.

This module knows files and bounds; how a character is read and moved is `stmc.formats.characters`' matter.
"""

from __future__ import annotations

import hashlib
import json
import shlex
import tempfile
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock, Semaphore
from typing import Any, Generic, TypeVar

import torch

from stmc.formats.characters import Character, CharacterError, read_character, retarget, stage_poses
from stmc.io.files import write_text, write_whole
from stmc.io.untrusted import UnreadableError, load_json, read_text, truncate
from stmc.motion.body import NUM_ROTATIONS
from stmc.motion.body_model import Skeleton
from stmc.motion.motion import Motion
from stmc.viewing.exports import exports_of
from stmc.viewing.studio.bodies import RECEIVED
from stmc.viewing.studio.request_errors import RequestError
from stmc.viewing.studio.responses import CharacterEntry, CharacterJoints
from stmc.viewing.studio.skeletons_json import JointMap, describe_joints, joint_map_of
from stmc.viewing.studio.storage import ID, check_poses, own_folder

MOST_CHARACTERS, MOST_CHARACTER_BYTES = 40, 2**30
"""Maximum number and bytes of stored characters."""

MOST_NAME = 60
"""Maximum number of letters of a character's name."""

_ROBOTS = (".urdf", ".xml")
"""Files of robots, whose motions are tables of joint angles."""

_FASTEST = 60
"""Frames per second that a stage shows."""

_RECORD, _MAP = 2**16, 2**15
"""Maximum bytes of a record beside a character, and of the joint map in it."""

_RECORD_KEYS = {"title", "suffix", "formats", "joint_map"}

Value = TypeVar("Value")


class _Recent(Generic[Value]):
    """The values that were used last, by name; for several threads."""

    def __init__(self, most: int) -> None:
        self._values: OrderedDict[str, Value] = OrderedDict()
        self._lock, self._most = Lock(), most

    def get(self, name: str, make: Callable[[], Value]) -> Value:
        """Return the value with this name, made if it is not held."""
        with self._lock:
            if name in self._values:
                self._values.move_to_end(name)
                return self._values[name]
        value = make()
        with self._lock:
            self._values[name] = value
            while len(self._values) > self._most:
                self._values.popitem(last=False)
        return value

    def forget(self, prefix: str) -> None:
        """Forget the values whose names begin so."""
        with self._lock:
            for name in [name for name in self._values if name.startswith(prefix)]:
                del self._values[name]


@dataclass(eq=False)
class Characters:
    """Characters of users, each under a name that follows from its bytes, so that the same file is stored once.

    A character is stored if its record, a `.json` file with its title, formats and joint map, is there beside its file.

    Examples:
        >>> characters = stmc.viewing.studio.Characters("characters")
        >>> [motion] = stmc.load().generate("walk # 0 # 1", steps=1)
        >>> stmc.write(motion, "hero.glb")
        >>> name = characters.receive(open("hero.glb", "rb").read(), "hero.glb")
        >>> characters.describe(name)["name"]
        'hero'
    """

    folder: Path | str
    _read: _Recent[Character] = field(default_factory=lambda: _Recent(4), repr=False)
    _poses: _Recent[bytes] = field(default_factory=lambda: _Recent(32), repr=False)
    _heavy: Semaphore = field(default_factory=lambda: Semaphore(2), repr=False)
    _lock: Lock = field(default_factory=Lock, repr=False)

    def __post_init__(self) -> None:
        self._folder = own_folder(self.folder)
        for path in self._files():
            if not path.with_suffix(".json").exists():  # a process was killed before it wrote the record
                path.unlink()

    def receive(self, content: bytes, filename: str) -> str:
        """Store the character of an uploaded file and return its name.

        A character that was stored before keeps its joint map. Raises `RequestError` for a file that is no character,
        and if there are too many.
        """
        suffix = Path(filename).suffix.lower()
        if suffix not in RECEIVED:
            raise RequestError(422, _refusal(filename, suffix))
        name = hashlib.sha256(content + suffix.encode()).hexdigest()[:32]
        with self._heavy:
            character = _read_content(content, suffix, {})
            _try_out(character)
        record = {"title": _title(filename), "suffix": suffix, "formats": list(character.formats)}
        with self._lock:
            self._check_quota(name, len(content))
            path = self._folder / f"{name}{suffix}"
            write_whole(path, lambda temporary: temporary.write_bytes(content))
            self._write_record(name, record | {"joint_map": self._stored_map(name)})
            path.chmod(0o600)
        return name

    def all(self) -> list[CharacterEntry]:
        """Describe all characters for the page, the last added first."""
        paths = sorted(self._files(), key=_modified, reverse=True)
        found = []
        for path in paths:
            try:
                found.append(self.describe(path.stem))
            except RequestError:
                continue
        return found

    def describe(self, name: str) -> CharacterEntry:
        """Describe a character for the page: its name, title, and the formats of a motion with it."""
        record = self._record(name)
        own = record["formats"]
        formats = [each.describe() | {"character": each.suffix in own} for each in exports_of(own)]
        return {"id": name, "name": record["title"], "formats": formats, "corrections": record["joint_map"]}

    def content(self, name: str) -> bytes:
        """Return the bytes of a character's file. Raises `RequestError` if there is no such character."""
        try:
            return (self._folder / f"{name}{self._record(name)['suffix']}").read_bytes()
        except FileNotFoundError:
            raise _missing() from None

    def get(self, name: str) -> Character:
        """Return the character with this name. Raises `RequestError` if it is missing or damaged."""
        return self._character(name, self._record(name))

    def joints(self, name: str) -> CharacterJoints:
        """Describe the joint map of a character. Raises `RequestError` if the character is missing or damaged."""
        record = self._record(name)
        return describe_joints(self._character(name, record), record["joint_map"])

    def correct(self, name: str, joint_map: JointMap) -> CharacterJoints:
        """Store corrections of a character's joint map in place of earlier ones, and describe the map.

        Raises `RequestError` if the character is missing, or if it cannot be moved with this map, which is not stored
        then.
        """
        record = self._record(name) | {"joint_map": joint_map}
        with self._heavy:
            character = self._character(name, record)
            _try_out(character)
        if len(json.dumps(joint_map)) > _MAP:
            raise RequestError(422, "joint map: the names of these joints are too long to be stored")
        with self._lock:
            self._write_record(name, self._record(name) | {"joint_map": joint_map})
        return describe_joints(character, joint_map)

    def poses(self, name: str, motion_name: str, motion: Motion) -> bytes:
        """Return a character's poses in a motion, as `stage_poses` writes them.

        Raises `RequestError` for a character that is missing, and for a motion that is too long for it.

        Args:
            name: Name of the character.
            motion_name: Name of the motion.
            motion: The motion.
        """

        def make() -> bytes:
            shown = motion if motion.fps <= _FASTEST else motion.resampled(_FASTEST)
            check_poses(shown, character)
            with self._heavy:
                return _posed(shown, character)

        record = self._record(name)
        character = self._character(name, record)
        return self._poses.get(f"{_key(name, record)}/{motion_name}", make)

    def delete(self, name: str) -> None:
        """Delete a character, if it exists."""
        path = self._record_path(name)
        with self._lock:
            path.unlink(missing_ok=True)
            for suffix in RECEIVED:
                path.with_suffix(suffix).unlink(missing_ok=True)
        self._read.forget(name)
        self._poses.forget(name)

    def _character(self, name: str, record: dict[str, Any]) -> Character:
        def make() -> Character:
            return _read_content(self.content(name), record["suffix"], record["joint_map"])

        return self._read.get(_key(name, record), make)

    def _stored_map(self, name: str) -> JointMap:
        try:
            return self._record(name)["joint_map"]
        except RequestError:
            return {}

    def _write_record(self, name: str, record: dict[str, Any]) -> None:
        path = self._record_path(name)
        write_text(path, json.dumps(record))
        path.chmod(0o600)

    def _check_quota(self, name: str, size: int) -> None:
        """Raise `RequestError` if another character does not fit."""
        if self._record_path(name).exists():
            return
        files = self._files()
        if len(files) >= MOST_CHARACTERS:
            raise RequestError(507, f"there are {MOST_CHARACTERS} characters; delete some")
        if sum(path.stat().st_size for path in files) + size > MOST_CHARACTER_BYTES:
            most = MOST_CHARACTER_BYTES / 2**30
            raise RequestError(507, f"all characters would be larger than {most:g} GiB; delete some")

    def _files(self) -> list[Path]:
        return [path for path in self._folder.iterdir() if path.suffix in RECEIVED and path.is_file()]

    def _record(self, name: str) -> dict[str, Any]:
        try:
            record = load_json(read_text(self._record_path(name), _RECORD))
        except (FileNotFoundError, UnreadableError):
            raise _missing() from None
        shape = isinstance(record, dict) and record.keys() | {"joint_map"} == _RECORD_KEYS
        if not shape or record["suffix"] not in RECEIVED or not isinstance(record["formats"], list):
            raise _missing()
        joint_map = record.get("joint_map", {})  # records of before have none
        if not isinstance(joint_map, dict):
            raise _missing()
        try:
            return record | {"joint_map": joint_map_of(joint_map)}
        except RequestError:
            raise _missing() from None

    def _record_path(self, name: str) -> Path:
        if not ID.fullmatch(name):
            raise _missing()
        return self._folder / f"{name}.json"


def _refusal(filename: str, suffix: str) -> str:
    """Return a sentence about a file that has no mesh to show, with the command that moves it if there is one."""
    if suffix not in (*_ROBOTS, ".bvh"):
        return f"a character must be a {', a '.join(RECEIVED[:-1])} or a {RECEIVED[-1]} file"
    kinds = "robots" if suffix in _ROBOTS else "skeletons"
    name = shlex.quote(_title(filename) + Path(filename).suffix)
    command = f"stmc sample timeline.json outputs/ character={name}"
    return f"the studio shows no {kinds}; to move this one, export the timeline and run `{command}`"


def _missing() -> RequestError:
    return RequestError(404, "that character is no longer stored; add its file again")


def _key(name: str, record: dict[str, Any]) -> str:
    """Return the key of what is computed for a character with its joint map."""
    return f"{name}/{json.dumps(record['joint_map'], sort_keys=True)}"


def _read_content(content: bytes, suffix: str, joint_map: JointMap) -> Character:
    """Read a character. Raises `RequestError` with a sentence about the file or the joint map."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"character{suffix}"
        path.write_bytes(content)
        try:
            return read_character(path, joint_map)
        except CharacterError as error:
            raise RequestError(422, str(error).replace(str(path), "the file")) from None


def _try_out(character: Character) -> None:
    """Raise `RequestError` if the character cannot be moved or written."""
    rotations = torch.eye(3).repeat(1, NUM_ROTATIONS, 1, 1)
    still = Motion.posed(rotations, torch.zeros(1, 3), 20, Skeleton.default())
    try:
        _posed(still, character)
        retarget(still, character).content(character.formats[0])
    except ValueError as error:
        raise RequestError(422, f"the file: {truncate(str(error), 200)}") from None


def _posed(motion: Motion, character: Character) -> bytes:
    return stage_poses(retarget(motion, character), motion)


def _title(filename: str) -> str:
    """Return the name of a file as a title: what can be printed of it, without the suffix."""
    stem = "".join(letter for letter in Path(filename).stem if letter.isprintable())
    return " ".join(stem.split())[:MOST_NAME] or "character"


def _modified(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except FileNotFoundError:
        return 0.0
