"""Times of the stages of a computation that has no timers: its functions are replaced by timed ones for a while."""

from __future__ import annotations

import functools
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from threading import Lock, local
from typing import Any, NamedTuple
from unittest.mock import patch


class Seam(NamedTuple):
    """A function that begins a stage: an attribute of a module or a class."""

    owner: Any
    attribute: str
    stage: str


class StageTimer:
    """Seconds of stages, each without the stages inside it. Threads have stages of their own.

    Args:
        clock: Seconds of a clock that never goes back.

    Examples:
        >>> timer = StageTimer(clock=iter([0.0, 2.0, 3.0, 7.0]).__next__)
        >>> with timer.stage("denoise"):
        ...     with timer.stage("encode"):
        ...         pass
        >>> timer.take()
        {'denoise': 6.0, 'encode': 1.0}
    """

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self._clock, self._own, self._lock = clock, local(), Lock()
        self._seconds = defaultdict[str, float](float)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Count the time of this context as that of a stage, and not as that of the stage around it."""
        around = getattr(self._own, "name", None)
        self._enter(name)
        try:
            yield
        finally:
            self._enter(around)

    def timed(self, function: Callable[..., Any], stage: str) -> Callable[..., Any]:
        """Return a function that does the same as a stage."""

        @functools.wraps(function)
        def call(*args: Any, **settings: Any) -> Any:
            with self.stage(stage):
                return function(*args, **settings)

        return call

    @contextmanager
    def watching(self, seams: Sequence[Seam]) -> Iterator[None]:
        """Replace functions by timed ones while this context lasts. Raises `AttributeError` for a missing function."""
        with ExitStack() as stack:
            for owner, attribute, stage in seams:
                timed = self.timed(getattr(owner, attribute), stage)
                is_bound = isinstance(owner, type) and hasattr(getattr(owner, attribute), "__self__")  # a class method
                stack.enter_context(patch.object(owner, attribute, staticmethod(timed) if is_bound else timed))
            yield

    def take(self) -> dict[str, float]:
        """Return the seconds of all stages, those that began first come first, and begin again."""
        with self._lock:
            seconds, self._seconds = dict(self._seconds), defaultdict(float)
        return seconds

    def _enter(self, name: str | None) -> None:
        """End the current stage of this thread and begin another; None: none."""
        now, ended = self._clock(), getattr(self._own, "name", None)
        if ended is not None:
            with self._lock:
                self._seconds[ended] += now - self._own.since
        self._own.name, self._own.since = name, now
