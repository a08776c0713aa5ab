"""What preparing a data set is, whichever it is: checked first, then converted piece by piece, in parallel.

A piece's result is a cache of its own, whole or absent on the disk, so that a run that was killed resumes.
Knows caches; knows no format and no body.
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

from stmc.data.cache import Cache, fresh, merged

Watch = Callable[[Iterable, int], Iterable]
"""Shows progress: (what there is to do, how much) → the same, watched."""

Job = tuple[Any, ...]
"""A function and what it is given, for another process: all of it can be pickled."""


class LayoutError(ValueError):
    """A folder that is not laid out as its data set's; the message says what was expected and what was found."""


@runtime_checkable
class Preparation(Protocol):
    """A data set on its way to a cache."""

    def check(self) -> None:
        """Looks at the folders, before anything is converted. Raises `LayoutError` for a wrong one."""
        ...

    def fingerprint(self) -> str:
        """A name for everything that the cache depends on."""
        ...

    def prepared(self, scratch: Path, workers: int, watch: Watch) -> Cache:
        """The whole cache, without its fingerprint. `scratch` keeps the pieces of a run that was killed.

        Raises `ValueError` where not one clip can be used.
        """
        ...


def find_source(source: str | Path, expected: str) -> Path:
    """Where a data set lies, `~` expanded. Raises `LayoutError`, which says what is `expected`, where nothing does."""
    path = Path(source).expanduser()
    if not path.exists():
        raise LayoutError(f"source={source} does not exist; it should be {expected}")
    return path


@dataclass(frozen=True)
class Piece:
    """Something to convert on its own. `fingerprint` names its inputs; `convert` can be pickled, and raises
    `ValueError` for a piece that cannot be used."""

    name: str
    fingerprint: str
    convert: Callable[[], Cache]


def converted(
    pieces: Iterable[Piece],
    total: int,
    scratch: Path,
    workers: int,
    watch: Watch,
    skipped: Sequence[tuple[str, str]] = (),
) -> Cache:
    """All pieces, `total` of them at most, as one cache, in their order; pieces that are in `scratch` already are not
    converted again. A piece is asked for when its turn comes, so that they need not be in memory together.

    The cache names what was `skipped` before or while pieces were made, and every piece that was now, with the reason.
    Raises `ValueError` where no clip is left.
    """
    caches, unused, folders = [], list[tuple[str, str]](), deque[Path]()

    def jobs() -> Iterator[tuple[str, Job | None]]:
        for piece in pieces:
            folders.append(folder := scratch / piece.fingerprint[:32])
            yield piece.name, None if fresh(folder, piece.fingerprint) else (write_piece, piece, folder)

    for name, reason in watch(in_parallel(jobs(), workers), total):
        folder = folders.popleft()
        if isinstance(reason, str):
            unused.append((name, reason))
        else:
            caches.append(Cache.read(folder))
    skipped = [*skipped, *unused, *(row for cache in caches for row in cache.skipped)]
    if not any(cache.clips for cache in caches):
        first = f"; the first: {skipped[0][0]}: {skipped[0][1]}" if skipped else ""
        raise ValueError(f"not one clip could be used, {len(skipped)} were skipped{first}")
    return replace(merged(caches), skipped=tuple(skipped))


def in_parallel(jobs: Iterable[tuple[str, Job | None]], workers: int) -> Iterator[tuple[str, Any]]:
    """Every job's name, and what its function returned (no job: None) or the message of its `ValueError`, in their
    order. The workers end with this process, however it ends."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=context, initializer=_begin_worker) as pool:
        waiting: deque[tuple[str, Future | None]] = deque()
        for name, job in jobs:
            waiting.append((name, None if job is None else pool.submit(*job)))
            if len(waiting) > 16 * workers:  # bounds the memory that what they are given and return waits in
                yield _result(*waiting.popleft())
        while waiting:
            yield _result(*waiting.popleft())


def _begin_worker() -> None:
    torch.set_num_threads(1)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """A worker waits for its next job at a pipe that it holds open itself, so a parent that was killed leaves it there
    for ever; this waits for the parent, on every platform, and takes the worker along."""
    multiprocessing.parent_process().join()
    os._exit(1)


def write_piece(piece: Piece, folder: Path) -> None:
    """Converts a piece and writes its cache to `folder`. Raises the `ValueError` of a piece that cannot be used."""
    replace(piece.convert(), fingerprint=piece.fingerprint).write(folder)


def _result(name: str, future: Future | None) -> tuple[str, Any]:
    try:
        return name, None if future is None else future.result()
    except ValueError as error:
        return name, str(error)
