"""Turns of sampling: one thread samples at a time, and jobs give way to streams between their steps.

This module knows threads; it knows no models.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from threading import Condition


class Turns:
    """Turns of sampling; those of streams come first, since somebody watches them.

    Examples:
        >>> turns = stmc.viewing.studio.Turns()
        >>> with turns.job():
        ...     turns.give_way()
    """

    def __init__(self) -> None:
        self._changed, self._taken, self._streams = Condition(), False, 0

    @contextmanager
    def job(self) -> Iterator[None]:
        """Hold a turn of a job; it begins once nothing samples and no stream waits."""
        self._take()
        try:
            yield
        finally:
            self._leave()

    @contextmanager
    def stream(self) -> Iterator[None]:
        """Hold a turn of a stream; it begins once nothing samples."""
        with self._changed:
            self._streams += 1
            self._changed.wait_for(lambda: not self._taken)
            self._streams -= 1
            self._taken = True
        try:
            yield
        finally:
            self._leave()

    def give_way(self) -> None:
        """Interrupt the turn of a job while streams wait for theirs."""
        if self._streams:
            self._leave()
            self._take()

    def _take(self) -> None:
        with self._changed:
            self._changed.wait_for(lambda: not self._taken and not self._streams)
            self._taken = True

    def _leave(self) -> None:
        with self._changed:
            self._taken = False
            self._changed.notify_all()
