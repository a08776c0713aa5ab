"""Text files of a data set, from its published `.tar.xz` (never unpacked to disk) or from a folder.

Reads regular files of bounded size, whatever the headers of an archive claim; independent of formats.
"""

from __future__ import annotations

import io
import lzma
import tarfile
from collections.abc import Collection, Iterator
from itertools import islice
from pathlib import Path, PurePosixPath

from stmc.io.untrusted import UnreadableError, read_bytes, truncate

MOST_BYTES = 32 * 2**20
"""Maximum size of one file; Bandai's are below 1 MB, and CMU's, three minutes at 120 fps, below 20 MB."""
MOST_MEMBERS = 100_000
"""Maximum number of files in an archive or a folder; Bandai's data set has some 3,100, CMU's some 2,500 per format."""
MOST_ARCHIVE = 16 * 2**30
"""Maximum unpacked size of an archive in bytes; Bandai's has some 1 GB, CMU's whole database some 4 GB per format."""


def read_texts(source: Path, kinds: Collection[str]) -> Iterator[tuple[PurePosixPath, str | UnreadableError]]:
    """Yield the path and text of every file with a suffix in `kinds`, one at a time.

    For files that are not regular or exceed `MOST_BYTES`, an error replaces the text. Raises `FileNotFoundError` if the
    source does not exist, and `ValueError` if an archive is damaged or truncated, or exceeds `MOST_MEMBERS` or
    `MOST_ARCHIVE`.
    """
    if not source.exists():
        raise FileNotFoundError(f"{source} does not exist; it should be the dataset's .tar.xz or its unpacked folder")
    yield from _archive(source, kinds) if source.is_file() else _folder(source, kinds)


def _archive(path: Path, kinds: Collection[str]) -> Iterator[tuple[PurePosixPath, str | UnreadableError]]:
    name, left = "its beginning", MOST_ARCHIVE
    try:
        with lzma.open(path) as file:  # unlike tarfile's own stream, it detects truncation
            unpacked = _Metered(file)
            with tarfile.open(fileobj=unpacked, mode="r|") as archive:
                for number, member in enumerate(archive):
                    left -= member.size
                    if number >= MOST_MEMBERS or left < 0:
                        limits = f"{MOST_MEMBERS:,} members or {MOST_ARCHIVE / 2**30:g} GiB"
                        raise ValueError(f"{path} unpacks to more than {limits} (read up to {name})")
                    # tarfile would keep all members; typeshed does not declare the attribute
                    archive.members.clear()  # type: ignore[attr-defined]
                    unpacked.left = member.size + _HEADERS
                    inner = PurePosixPath(member.name)
                    if inner.suffix in kinds:
                        name = truncate(inner.stem)
                        yield inner, _member(archive, member)
            unpacked.left = MOST_BYTES
            while unpacked.read(2**20):
                pass
    except (tarfile.TarError, lzma.LZMAError, EOFError) as error:
        raise ValueError(f"{path} is not a .tar.xz, or is truncated or damaged (read up to {name}): {error}") from error


def _member(archive: tarfile.TarFile, member: tarfile.TarInfo) -> str | UnreadableError:
    if not member.isreg():
        return UnreadableError("a member of the archive that is not a regular file")
    if member.size > MOST_BYTES:
        return UnreadableError(f"{member.size:,} bytes, more than {MOST_BYTES / 2**20:g} MiB")
    content = archive.extractfile(member)
    assert content is not None  # it is a regular file
    return content.read().decode("ascii", errors="replace")


_HEADERS = 2**20
"""Maximum number of bytes between two members, which tarfile reads at once."""


class _Metered(io.RawIOBase):
    """A file with a limited number of bytes `left` to read, whatever its headers claim."""

    def __init__(self, file: lzma.LZMAFile) -> None:
        super().__init__()
        self._file = file
        self.left = _HEADERS

    def read(self, size: int = -1, /) -> bytes:
        data = self._file.read(size)
        self.left -= len(data)
        if self.left < 0:
            raise tarfile.ReadError(f"headers of more than {_HEADERS / 2**20:g} MiB")
        return data


def _folder(path: Path, kinds: Collection[str]) -> Iterator[tuple[PurePosixPath, str | UnreadableError]]:
    files = sorted(islice((file for file in path.rglob("*") if file.suffix in kinds), MOST_MEMBERS + 1))
    if len(files) > MOST_MEMBERS:
        raise ValueError(f"{path} holds more than {MOST_MEMBERS:,} {' and '.join(sorted(kinds))} files, the limit")
    for file in files:
        inner = PurePosixPath(file.relative_to(path).as_posix())
        try:
            yield inner, read_bytes(file, MOST_BYTES).decode("ascii", errors="replace")
        except UnreadableError as error:
            yield inner, error
        except OSError as error:  # a dangling link, no permission
            yield inner, UnreadableError(f"cannot be read ({error.strerror})")
