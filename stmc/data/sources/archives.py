"""Text files of a data set, from the `.tar.xz` it is published as (never unpacked to disk) or a folder.

Knows files and archives; knows no format.
"""

from __future__ import annotations

import lzma
import tarfile
from collections.abc import Iterator
from pathlib import Path, PurePosixPath


def read_texts(source: Path, kinds: tuple[str, ...]) -> Iterator[tuple[PurePosixPath, str]]:
    """The place and the text of every file whose suffix is one of `kinds`, one at a time.

    Raises `FileNotFoundError` where there is neither folder nor file, and `ValueError` for an archive that is damaged
    or breaks off.
    """
    if not source.exists():
        raise FileNotFoundError(f"{source} does not exist; it should be the dataset's .tar.xz or its unpacked folder")
    if source.is_file():
        yield from _archived(source, kinds)
        return
    for file in sorted(path for path in source.rglob("*") if path.suffix in kinds):
        yield PurePosixPath(file.relative_to(source).as_posix()), file.read_text(encoding="ascii", errors="replace")


def _archived(path: Path, kinds: tuple[str, ...]) -> Iterator[tuple[PurePosixPath, str]]:
    name = "its beginning"
    try:
        with lzma.open(path) as file:  # unlike tarfile's own stream, it notices an end that comes too early
            with tarfile.open(fileobj=file, mode="r|") as archive:
                for member in archive:
                    place = PurePosixPath(member.name)
                    if member.isfile() and place.suffix in kinds:
                        name = place.stem
                        yield place, archive.extractfile(member).read().decode("ascii", errors="replace")
            file.read()
    except (tarfile.TarError, lzma.LZMAError, EOFError) as error:
        raise ValueError(f"{path} is no .tar.xz, or a half or damaged one (read up to {name}): {error}") from error
