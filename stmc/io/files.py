"""Files that are whole or absent, whenever the process is killed, and folders that one process writes at a time.

Knows nothing of what is in them.
"""

from __future__ import annotations

import errno
import hashlib
import logging
import math
import os
import re
import secrets
import shutil
import socket
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

if os.name == "nt":
    import _winapi

logger = logging.getLogger(__name__)

LOCK = ".lock"
"""The file by which a folder is locked; it is gone when the process that wrote there has ended by itself."""

_HOST = hashlib.sha256(socket.gethostname().encode()).hexdigest()[:8]
_TOKEN = secrets.token_hex(4)  # a container that is started again gives the same number to another process
_TEMPORARY = re.compile(r"\..*\.([0-9a-f]{8})-(\d+)-([0-9a-f]{8})-\d+\.tmp")
_NO_LOCKS = {errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.EINVAL}
"""Errors of a file system that has no locks."""
_SYNCHRONIZE, _RUNS = 0x00100000, 0x102
"""On Windows: the right to wait for a process, and the answer about one that runs."""
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
    """Keep every other process from whatever the lock file `path` stands for; make its folder. Raises as `locked`."""
    from filelock import FileLock, Timeout  # not above: it is slow to import

    path.parent.mkdir(parents=True, exist_ok=True)
    wait = -1 if math.isinf(patience) else patience
    lock = FileLock(path, timeout=wait, poll_interval=_PAUSE, thread_local=False, fallback_to_soft=False)
    try:
        lock.acquire()
    except Timeout:
        message = f"{path.parent} is being written by {_owner(path)}; wait for its end, or choose another folder"
        raise FolderInUse(message) from None
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise
        logger.warning("%s: two runs at once would not be noticed, this file system has no locks", path.parent)
        logger.debug("the lock", exc_info=error)
    try:
        _sign(path)
        yield
    finally:
        with suppress(OSError):  # on Windows nobody can remove an open file, and the lock's release removes it
            path.unlink()
        lock.release()


def _sign(path: Path) -> None:
    """Write the owner into a lock file. The first byte stays free: on Windows others cannot read a locked byte."""
    with path.open("r+b", buffering=0) as file:
        file.seek(1)
        file.write(f"process {os.getpid()} on host {socket.gethostname()}\n".encode())


def _owner(path: Path) -> str:
    """Return the owner that a lock file names, or "another process" if it names none."""
    with suppress(OSError), path.open("rb", buffering=0) as file:
        file.seek(1)
        return file.read(200).decode(errors="replace").partition("\n")[0] or "another process"
    return "another process"  # its owner removed it in the meantime


def _is_alive(process: int, token: str) -> bool:
    return token == _TOKEN if process == os.getpid() else _exists(process)


def _exists(process: int) -> bool:
    """Whether a process of this machine runs."""
    try:
        if os.name != "nt":
            os.kill(process, 0)
            return True
        handle = _winapi.OpenProcess(_SYNCHRONIZE, False, process)  # os.kill would end the process here
        try:
            return _winapi.WaitForSingleObject(handle, 0) == _RUNS
        finally:
            _winapi.CloseHandle(handle)
    except PermissionError:  # somebody else's
        return True
    except (OSError, OverflowError):
        return False


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
