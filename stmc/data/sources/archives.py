"""Text files of a data set, from the `.tar.xz` it is published as (never unpacked to disk) or from a folder.

Reads regular files of bounded size, whatever an archive's headers promise; knows no format.
"""

from __future__ import annotations

import lzma
import tarfile
from collections.abc import Collection, Iterator
from itertools import islice
from pathlib import Path, PurePosixPath

from stmc.io.untrusted import UnreadableError, cut, read_bytes

MOST_BYTES = 32 * 2**20
"""Of one file; the largest of Bandai's is below 1 MB, and of CMU's, three minutes at 120 frames per second, 20 MB."""

MOST_MEMBERS = 100_000
"""Of an archive or a folder; Bandai's data set has some 3,100, CMU's some 2,500 in each of its formats."""

MOST_ARCHIVE = 16 * 2**30
"""Bytes of all that an archive unpacks to; Bandai's has some 1 GB, CMU's whole database some 4 GB in each format."""


def read_texts(source: Path, kinds: Collection[str]) -> Iterator[tuple[PurePosixPath, str | UnreadableError]]:
    """The place and the text of every file whose suffix is one of `kinds`, one at a time; of what is no regular file,
    or one of more than `MOST_BYTES`, the error in place of a text.

    Raises `FileNotFoundError` where there is neither folder nor file, and `ValueError` for an archive that is damaged
    or breaks off, and for more than `MOST_MEMBERS` or `MOST_ARCHIVE`.
    """
    if not source.exists():
        raise FileNotFoundError(f"{source} does not exist; it should be the dataset's .tar.xz or its unpacked folder")
    yield from _archive(source, kinds) if source.is_file() else _folder(source, kinds)


def _archive(path: Path, kinds: Collection[str]) -> Iterator[tuple[PurePosixPath, str | UnreadableError]]:
    name, left = "its beginning", MOST_ARCHIVE
    try:
        with lzma.open(path) as file:  # unlike tarfile's own stream, it notices an end that comes too early
            unpacked = _Metered(file)
            with tarfile.open(fileobj=unpacked, mode="r|") as archive:
                for number, member in enumerate(archive):
                    left -= member.size
                    if number >= MOST_MEMBERS or left < 0:
                        limits = f"{MOST_MEMBERS:,} members or {MOST_ARCHIVE / 2**30:g} GiB"
                        raise ValueError(f"{path} unpacks to more than {limits} (read up to {name})")
                    archive.members.clear()  # tarfile keeps all it has seen
                    unpacked.left = member.size + _HEADERS
                    place = PurePosixPath(member.name)
                    if place.suffix in kinds:
                        name = cut(place.stem)
                        yield place, _member(archive, member)
            unpacked.left = MOST_BYTES
            while unpacked.read(2**20):
                pass
    except (tarfile.TarError, lzma.LZMAError, EOFError) as error:
        raise ValueError(f"{path} is not a .tar.xz, or a half or damaged one (read up to {name}): {error}") from error


def _member(archive: tarfile.TarFile, member: tarfile.TarInfo) -> str | UnreadableError:
    if not member.isreg():
        return UnreadableError("a member of the archive that is not a regular file")
    if member.size > MOST_BYTES:
        return UnreadableError(f"{member.size:,} bytes, more than {MOST_BYTES / 2**20:g} MiB")
    return archive.extractfile(member).read().decode("ascii", errors="replace")


_HEADERS = 2**20
"""Bytes that may stand between two members; tarfile reads them at once."""


class _Metered:
    """A file from which only so many bytes are `left` to be read, whatever its headers promise."""

    def __init__(self, file: lzma.LZMAFile) -> None:
        self._file = file
        self.left = _HEADERS

    def read(self, size: int) -> bytes:
        content = self._file.read(size)
        self.left -= len(content)
        if self.left < 0:
            raise tarfile.ReadError(f"headers of more than {_HEADERS / 2**20:g} MiB")
        return content


def _folder(path: Path, kinds: Collection[str]) -> Iterator[tuple[PurePosixPath, str | UnreadableError]]:
    files = sorted(islice((file for file in path.rglob("*") if file.suffix in kinds), MOST_MEMBERS + 1))
    if len(files) > MOST_MEMBERS:
        raise ValueError(f"{path} holds more than {MOST_MEMBERS:,} {' and '.join(sorted(kinds))} files, the limit")
    for file in files:
        place = PurePosixPath(file.relative_to(path).as_posix())
        try:
            yield place, read_bytes(file, MOST_BYTES).decode("ascii", errors="replace")
        except UnreadableError as error:
            yield place, error
        except OSError as error:  # a dangling link, no permission
            yield place, UnreadableError(f"cannot be read ({error.strerror})")
