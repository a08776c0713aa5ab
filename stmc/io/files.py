"""Files that are whole or absent, whenever the process is killed, and folders that one process writes at a time.

Knows nothing of what is in them.
"""

from __future__ import annotations

import errno
import hashlib
import logging
import os
import re
import secrets
import shutil
import socket
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

import psutil

if os.name == "nt":
    import msvcrt
else:
    import fcntl

logger = logging.getLogger(__name__)

LOCK = ".lock"
"""The file by which a folder is locked; it is gone when the process that wrote there has ended by itself."""

_HOST = hashlib.sha256(socket.gethostname().encode()).hexdigest()[:8]
_TOKEN = secrets.token_hex(4)  # a container that is started again gives the same number to another process
_TEMPORARY = re.compile(r"\..*\.([0-9a-f]{8})-(\d+)-([0-9a-f]{8})-\d+\.tmp")
_LOCKED_BYTE = 2**30  # far behind what is written: on Windows a locked byte cannot be read by others
_FULL = 2**20
_PAUSE = 0.2


class FolderInUse(ValueError):
    """Another process is writing to a folder; the message says which process, on which machine."""


def write_whole(path: Path, write: Callable[[Path], object]) -> None:
    """Lets `write` fill a temporary file beside `path`, and renames it only once its bytes are on the disk.

    Where `write` fails, nothing is left behind and a file that was there stays; a full disk is an `OSError` that says
    so. Folders are made. The file has the mode that `open` would give it, also where `write` made one of its own.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = _temporary(path)
    try:
        temporary.touch()
        mode = temporary.stat().st_mode
        write(temporary)
        if temporary.stat().st_mode != mode:  # safetensors lets nobody else read what it writes
            temporary.chmod(mode)
        with temporary.open("rb+") as file:  # Windows flushes only what it could write
            os.fsync(file.fileno())
        temporary.replace(path)
        _sync_folder(path.parent)
    except Exception as error:
        if _is_full(error, path.parent):
            message = "the disk is full; with more room, the same command goes on"
            raise OSError(errno.ENOSPC, message, str(path)) from error
        raise
    finally:
        temporary.unlink(missing_ok=True)


def write_whole_folder(path: Path, write: Callable[[Path], object]) -> None:
    """Lets `write` make a temporary folder beside `path`, which must not exist or be empty, and renames it at the end.

    Where `write` fails, nothing is left behind; what killed processes left beside `path` goes, too.
    """
    if path.parent.is_dir():
        _remove(path.parent, os.listdir(path.parent))
    temporary = _temporary(path)
    try:
        write(temporary)
        if path.exists():
            path.rmdir()
        temporary.rename(path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def write_text(path: Path, text: str) -> None:
    """`write_whole` of a text, in UTF-8 and with the same line ends everywhere."""
    write_whole(path, lambda temporary: temporary.write_text(text, encoding="utf-8", newline="\n"))


@contextmanager
def scratch(path: Path) -> Iterator[Path]:
    """A temporary folder beside `path`, which goes at the end; a killed process's goes with `remove_leftovers`."""
    temporary = _temporary(path)
    try:
        temporary.mkdir(parents=True)
        yield temporary
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def sha256(path: Path) -> str:
    """The SHA-256 of a file's content, in hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def probe(folder: Path) -> None:
    """Makes a folder and writes to it, to find out before long work whether that can be done. Raises `OSError`."""
    if folder.exists() and not folder.is_dir():
        raise NotADirectoryError(errno.ENOTDIR, "is not a directory", str(folder))
    write_whole(folder / "probe", lambda temporary: temporary.write_bytes(b"probe"))
    (folder / "probe").unlink(missing_ok=True)


def remove_leftovers(folder: Path) -> None:
    """Removes the temporary files and folders below `folder` whose process was killed: to be called where a run begins.

    Those of other machines stay, since nobody here knows what is alive there.
    """
    for place, folders, names in os.walk(folder):
        _remove(Path(place), [*folders, *names])


def _remove(folder: Path, names: Iterable[str]) -> None:
    for found in filter(None, map(_TEMPORARY.fullmatch, names)):
        if found[1] == _HOST and not _is_alive(int(found[2]), found[3]):
            left = folder / found[0]
            if left.is_dir() and not left.is_symlink():
                shutil.rmtree(left, ignore_errors=True)
            else:
                left.unlink(missing_ok=True)  # another process may begin at the same time


def _temporary(path: Path) -> Path:
    """The name beside `path` by which a leftover is known, and whose it is."""
    return path.with_name(f".{path.name[:32]}.{_HOST}-{os.getpid()}-{_TOKEN}-{threading.get_ident()}.tmp")


@contextmanager
def locked(folder: Path, patience: float | int = 0.0) -> Iterator[None]:
    """Keeps every other process from `folder` as long as it asks for the lock, too; makes the folder, and removes what
    killed processes left in it.

    The operating system holds the lock: it ends with the process, however that ends. Raises `FolderInUse` after so many
    seconds of `patience` with another process. On file systems without locks there is a warning and no protection.
    """
    with held(Path(folder) / LOCK, patience):
        remove_leftovers(folder)
        yield


@contextmanager
def held(path: Path, patience: float | int = 0.0) -> Iterator[None]:
    """Keeps every other process from whatever the lock file `path` stands for; makes its folder. Raises as `locked`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    file = _lock_within(path, patience)
    try:
        file.truncate(0)
        file.write(f"process {os.getpid()} on host {socket.gethostname()}".encode())
        file.flush()
        yield
    finally:
        if os.name == "nt":  # where nobody can remove an open file
            file.close()
        with suppress(OSError):
            path.unlink()
        file.close()


def _lock_within(path: Path, patience: float | int) -> BinaryIO:
    last = time.monotonic() + patience
    while True:
        try:
            return _lock(path)
        except FolderInUse:
            if time.monotonic() >= last:
                raise
            time.sleep(_PAUSE)


def _lock(path: Path) -> BinaryIO:
    """The lock file, opened and locked."""
    while True:
        file = path.open("ab+")
        try:
            _ask_for_lock(file)
        except (BlockingIOError, PermissionError) as error:
            with file:
                file.seek(0)
                owner = file.read(200).decode(errors="replace") or "another process"
            raise FolderInUse(
                f"{path.parent} is being written by {owner}; wait for its end, or choose another folder"
            ) from error
        except OSError as error:
            logger.warning("%s: two runs at once would not be noticed, this file system has no locks", path.parent)
            logger.debug("the lock", exc_info=error)
            return file
        if os.name == "nt" or _is_at(file, path):
            return file
        file.close()  # its owner removed it in the meantime


def _ask_for_lock(file: BinaryIO) -> None:
    if os.name == "nt":
        file.seek(_LOCKED_BYTE)
        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
    else:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _is_at(file: BinaryIO, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except FileNotFoundError:
        return False


def _is_alive(process: int, token: str) -> bool:
    return token == _TOKEN if process == os.getpid() else psutil.pid_exists(process)


def _is_full(error: Exception, folder: Path) -> bool:
    """Whether a write failed because nothing more fits; torch and safetensors have errors of their own for it."""
    if isinstance(error, OSError):
        return error.errno == errno.ENOSPC
    return shutil.disk_usage(folder).free < _FULL


def _sync_folder(folder: Path) -> None:
    """Makes a new name in a folder last through a power cut, where there is a way to."""
    if os.name != "nt":
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            with suppress(OSError):  # not every file system can
                os.fsync(descriptor)
        finally:
            os.close(descriptor)
