"""Preparation of any data set: validation first, then conversion in pieces, in parallel.

The result of a piece is a cache of its own, complete or absent on disk, so that a killed run resumes. Depends on
caches; independent of formats and bodies.
"""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import torch

from stmc.data.cache import Cache, is_current, merge_caches

Watch = Callable[[Iterable, int], Iterable]
"""(items, number of items) → the same items; displays progress."""
Job = tuple[Any, ...]
"""A function and its arguments for another process; all of them can be pickled."""


class LayoutError(ValueError):
    """A folder without the layout of its data set; the message names the expected and the actual content."""


@runtime_checkable
class Preparation(Protocol):
    """The conversion of a data set to a cache."""

    def check(self) -> None:
        """Check the folders before anything is converted. Raises `LayoutError` if one is wrong."""
        ...

    def fingerprint(self) -> str:
        """Compute a digest of everything that the cache depends on."""
        ...

    def prepared(self, scratch: Path, workers: int, watch: Watch) -> Cache:
        """Build the whole cache, without its fingerprint.

        Args:
            scratch: Folder that keeps the pieces of a killed run.
            workers: Number of processes.
            watch: Displays progress.

        Raises:
            ValueError: If no clip can be used.
        """
        ...


def find_source(source: str | Path, expected: str) -> Path:
    """Return the path of a data set, with `~` expanded.

    Raises `LayoutError`, with the `expected` content, if it does not exist.
    """
    path = Path(source).expanduser()
    if not path.exists():
        raise LayoutError(f"source={source} does not exist; it should be {expected}")
    return path


@dataclass(frozen=True)
class Piece:
    """A unit of conversion.

    Args:
        name: Name for messages.
        fingerprint: Digest of its inputs.
        convert: Function that can be pickled; raises `ValueError` if the piece cannot be used.
    """

    name: str
    fingerprint: str
    convert: Callable[[], Cache]


def convert_pieces(
    pieces: Iterable[Piece],
    total: int,
    scratch: Path,
    workers: int,
    watch: Watch,
    skipped: Sequence[tuple[str, str]] = (),
) -> Cache:
    """Convert pieces to one cache, in their order; pieces in `scratch` are not converted again.

    Pieces are created one at a time, so that they need not be in memory together. The cache lists what was `skipped`
    before or during the iteration, and every piece that failed, with the reason.

    Args:
        pieces: The pieces.
        total: Maximum number of pieces, for the progress.
        scratch: Folder of the converted pieces.
        workers: Number of processes.
        watch: Displays progress.
        skipped: Names of omitted clips, with the reasons; may grow while pieces are created.

    Raises:
        ValueError: If no clip remains.
    """
    caches, unused, folders = [], list[tuple[str, str]](), deque[Path]()

    def jobs() -> Iterator[tuple[str, Job | None]]:
        for piece in pieces:
            folders.append(folder := scratch / piece.fingerprint[:32])
            yield piece.name, None if is_current(folder, piece.fingerprint) else (write_piece, piece, folder)

    for name, reason in watch(in_parallel(jobs(), workers), total):
        folder = folders.popleft()
        if isinstance(reason, str):
            unused.append((name, reason))
        else:
            caches.append(Cache.read(folder))
    skipped = [*skipped, *unused, *(row for cache in caches for row in cache.skipped)]
    if not any(cache.clips for cache in caches):
        first = f"; the first: {skipped[0][0]}: {skipped[0][1]}" if skipped else ""
        raise ValueError(f"no clip could be used; {len(skipped)} were skipped{first}")
    return replace(merge_caches(caches), skipped=tuple(skipped))


def in_parallel(jobs: Iterable[tuple[str, Job | None]], workers: int) -> Iterator[tuple[str, Any]]:
    """Run jobs in parallel; yield each name with the result or the message of its `ValueError`, in order.

    A job of None has the result None. The worker processes end with this process, however it ends.
    """
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=context, initializer=_begin_worker) as pool:
        waiting: deque[tuple[str, Future | None]] = deque()
        for name, job in jobs:
            waiting.append((name, None if job is None else pool.submit(*job)))
            if len(waiting) > 16 * workers:  # bounds the memory of waiting arguments and results
                yield _result(*waiting.popleft())
        while waiting:
            yield _result(*waiting.popleft())


def _begin_worker() -> None:
    torch.set_num_threads(1)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """End a worker when its parent ends.

    A worker waits for its next job at a pipe that it holds open itself, so that it would survive a killed parent
    forever. This works on every platform.
    """
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def write_piece(piece: Piece, folder: Path) -> None:
    """Convert a piece and write its cache to `folder`. Raises the `ValueError` of a piece that cannot be used."""
    replace(piece.convert(), fingerprint=piece.fingerprint).write(folder)


def _result(name: str, future: Future | None) -> tuple[str, Any]:
    try:
        return name, None if future is None else future.result()
    except ValueError as error:
        return name, str(error)
