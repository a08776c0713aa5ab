"""Files that are complete or absent even if the process is killed, and folders that one process writes at a time.

Independent of the files' content.
"""

from __future__ import annotations

import errno
import hashlib
import itertools
import logging
import math
import os
import re
import secrets
import shutil
import socket
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

if sys.platform == "win32":
    import _winapi

logger = logging.getLogger(__name__)

LOCK = ".lock"
"""The lock file of a folder; a process that ends normally removes it."""
_HOST = hashlib.sha256(socket.gethostname().encode()).hexdigest()[:8]
_TOKEN = secrets.token_hex(4)  # a restarted container reuses process numbers
_NUMBERS = itertools.count()  # long names that begin alike, one written while another is, must not meet
_TEMPORARY = re.compile(r"\..*\.([0-9a-f]{8})-(\d+)-([0-9a-f]{8})-\d+\.tmp")
_NO_LOCKS = {errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.EINVAL}
"""Errors of a file system without locks."""
_SYNCHRONIZE, _RUNS = 0x00100000, 0x102
"""Windows' access right to wait for a process, and its answer for a running process."""
_FULL = 2**20
_PAUSE = 0.2


class FolderInUse(ValueError):
    """Another process is writing to a folder; the message names the process and its machine."""


def write_whole(path: Path, write: Callable[[Path], object]) -> None:
    """Have `write` fill a temporary file beside `path`, and rename it once its bytes are on the disk.

    If `write` fails, no new file is left and an existing one stays; a full disk raises an `OSError` that says so.
    Parent folders are created. The file has the mode that `open` would give it, even if `write` replaced the file.
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
            message = "the disk is full; free some space and run the same command again"
            raise OSError(errno.ENOSPC, message, str(path)) from error
        raise
    finally:
        temporary.unlink(missing_ok=True)


def write_whole_folder(path: Path, write: Callable[[Path], object]) -> None:
    """Have `write` create a temporary folder beside `path`, and rename it at the end. `path` must be absent or empty.

    If `write` fails, no folder is left. Leftovers of killed processes beside `path` are removed as well.
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
    """Write a text with `write_whole`, in UTF-8 and with the same line ends on every system."""
    write_whole(path, lambda temporary: temporary.write_text(text, encoding="utf-8", newline="\n"))


@contextmanager
def scratch(path: Path) -> Iterator[Path]:
    """Provide a temporary folder beside `path`; `remove_leftovers` removes those of killed processes."""
    temporary = _temporary(path)
    try:
        temporary.mkdir(parents=True)
        yield temporary
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def sha256(path: Path) -> str:
    """Return the SHA-256 of a file's content, in hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def probe(folder: Path) -> None:
    """Create a folder and write to it, to detect problems before long work. Raises `OSError`."""
    if folder.exists() and not folder.is_dir():
        raise NotADirectoryError(errno.ENOTDIR, "is not a directory", str(folder))
    write_whole(folder / "probe", lambda temporary: temporary.write_bytes(b"probe"))
    (folder / "probe").unlink(missing_ok=True)


def remove_leftovers(folder: Path) -> None:
    """Remove temporary files and folders of killed processes below `folder`. Call it at the beginning of a run.

    Those of other machines stay, since their processes cannot be checked.
    """
    for path, folders, names in os.walk(folder):
        _remove(Path(path), [*folders, *names])


def _remove(folder: Path, names: Iterable[str]) -> None:
    for match in filter(None, map(_TEMPORARY.fullmatch, names)):
        if match[1] == _HOST and not _is_alive(int(match[2]), match[3]):
            leftover = folder / match[0]
            if leftover.is_dir() and not leftover.is_symlink():
                shutil.rmtree(leftover, ignore_errors=True)
            else:
                leftover.unlink(missing_ok=True)  # another process may remove it at the same time


def _temporary(path: Path) -> Path:
    """Name a temporary file beside `path` that identifies its process and machine; no two calls give the same name."""
    return path.with_name(f".{path.name[:32]}.{_HOST}-{os.getpid()}-{_TOKEN}-{next(_NUMBERS)}.tmp")


@contextmanager
def lock_folder(folder: Path, patience: float | int = 0.0) -> Iterator[None]:
    """Lock a folder against other processes that use this lock. Creates the folder, and removes leftovers in it.

    The operating system releases the lock when the process ends, however it ends. Raises `FolderInUse` if another
    process still holds the lock after `patience` seconds. File systems without locks give a warning and no protection.
    """
    with lock_file(Path(folder) / LOCK, patience):
        remove_leftovers(folder)
        yield


@contextmanager
def lock_file(path: Path, patience: float | int = 0.0) -> Iterator[None]:
    """Hold the lock file `path` against other processes; create its folder. Raises as `lock_folder`."""
    from filelock import FileLock, Timeout  # imported late: it is slow to import

    path.parent.mkdir(parents=True, exist_ok=True)
    wait = -1 if math.isinf(patience) else patience
    lock = FileLock(path, timeout=wait, poll_interval=_PAUSE, thread_local=False, fallback_to_soft=False)
    try:
        lock.acquire()
    except Timeout:
        message = f"{path.parent} is in use by {_owner(path)}; wait until it ends, or choose another folder"
        raise FolderInUse(message) from None
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise
        logger.warning("%s: this file system has no locks, so two runs at once would not be noticed", path.parent)
        logger.debug("error of the lock", exc_info=error)
    try:
        _sign(path)
        yield
    finally:
        with suppress(OSError):  # Windows cannot remove an open file; releasing the lock removes it there
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
    return "another process"  # the owner removed the file in the meantime


def _is_alive(process: int, token: str) -> bool:
    return token == _TOKEN if process == os.getpid() else _exists(process)


def _exists(process: int) -> bool:
    """Tell whether a process of this machine is running."""
    try:
        if sys.platform == "win32":
            handle = _winapi.OpenProcess(_SYNCHRONIZE, False, process)  # os.kill would end the process here
            try:
                return _winapi.WaitForSingleObject(handle, 0) == _RUNS
            finally:
                _winapi.CloseHandle(handle)
        os.kill(process, 0)
        return True
    except PermissionError:  # a process of another user
        return True
    except (OSError, OverflowError):
        return False


def _is_full(error: Exception, folder: Path) -> bool:
    """Tell whether a write failed for lack of space; torch and safetensors raise their own errors then."""
    if isinstance(error, OSError):
        return error.errno == errno.ENOSPC
    return shutil.disk_usage(folder).free < _FULL


def _sync_folder(folder: Path) -> None:
    """Make a new name in a folder survive a power failure, if the system supports it."""
    if os.name != "nt":
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            with suppress(OSError):  # not every file system supports it
                os.fsync(descriptor)
        finally:
            os.close(descriptor)
