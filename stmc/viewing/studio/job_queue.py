"""Jobs of the studio that emit events and can be cancelled, and queues that run them one after the other.

This module knows neither motions nor HTTP.
"""

from __future__ import annotations

import asyncio
import logging
import secrets
from collections import OrderedDict, deque
from collections.abc import AsyncIterator, Callable, Iterable, Iterator
from dataclasses import dataclass, field
from threading import Condition, Lock, Thread
from typing import Any

from stmc.viewing.studio.request_errors import RequestError, request_error

logger = logging.getLogger(__name__)

MOST_WAITING = 32
"""Maximum number of waiting jobs of a queue."""

MOST_FINISHED = 200
"""Number of jobs to remember."""

ENDS = ("done", "failed", "cancelled")

Event = tuple[str, dict[str, Any]]
"""Kind of an event, and its details."""


class Cancelled(Exception):
    """Signal to end a job at its next `check`."""


@dataclass(eq=False)
class Job:
    """Work that emits events to the job itself. Only the last job of a `tab` of the browser waits."""

    work: Callable[[Job], None] = field(repr=False)
    tab: str = ""
    name: str = field(default_factory=lambda: secrets.token_urlsafe(9))
    events: list[Event] = field(default_factory=list)
    cancelled: bool = False
    _listeners: list[tuple[asyncio.AbstractEventLoop, asyncio.Queue]] = field(default_factory=list)
    _lock: Lock = field(default_factory=Lock)

    @property
    def ended(self) -> bool:
        """Whether the job has ended."""
        return bool(self.events) and self.events[-1][0] in ENDS

    def check(self) -> None:
        """Raise `Cancelled` if the job was cancelled."""
        if self.cancelled:
            raise Cancelled

    def emit(self, kind: str, **details: Any) -> None:
        """Emit an event, from any thread; events after the end are ignored."""
        with self._lock:
            if self.ended:
                return
            if kind == "progress" and self.events and self.events[-1][0] == "progress":
                self.events.pop()  # late listeners need only the last one
            self.events.append((kind, details))
            for loop, queue in self._listeners:
                if not loop.is_closed():
                    loop.call_soon_threadsafe(queue.put_nowait, (kind, details))

    async def subscribe(self) -> AsyncIterator[Event]:
        """Yield past and future events up to the end."""
        queue: asyncio.Queue[Event] = asyncio.Queue()
        listener = (asyncio.get_running_loop(), queue)
        with self._lock:
            for event in self.events:
                queue.put_nowait(event)
            self._listeners.append(listener)
        try:
            while True:
                event = await queue.get()
                yield event
                if event[0] in ENDS:
                    return
        finally:
            with self._lock:
                self._listeners.remove(listener)


class JobQueue:
    """A queue of jobs, and the single thread that runs them."""

    def __init__(self, name: str) -> None:
        self._waiting: deque[Job] = deque()
        self._known: OrderedDict[str, Job] = OrderedDict()
        self._current: Job | None = None
        self._changed, self._closed = Condition(), False
        self._thread = Thread(target=self._run_all, name=name, daemon=True)
        self._thread.start()

    def __contains__(self, name: object) -> bool:
        with self._changed:
            return name in self._known

    def put(self, work: Callable[[Job], None], tab: str = "") -> Job:
        """Queue a job and cancel waiting jobs of the same tab. Raises `RequestError` if too many jobs wait."""
        job = Job(work, tab)
        with self._changed:
            for other in [each for each in self._waiting if tab and each.tab == tab]:
                self._waiting.remove(other)
                other.emit("cancelled")
            if len(self._waiting) >= MOST_WAITING:
                raise RequestError(429, f"{MOST_WAITING} jobs are already waiting")
            self._known[job.name] = job
            self._forget()
            self._waiting.append(job)
            job.emit("progress", stage="waiting", step=0, steps=0)
            self._changed.notify_all()
        return job

    def get(self, name: str) -> Job:
        """Return the job with this name. Raises `RequestError` if there is none."""
        with self._changed:
            if name not in self._known:
                raise RequestError(404, "there is no such job")
            return self._known[name]

    def cancel(self, name: str) -> None:
        """Cancel a job, at once if it waits and at its next `check` if it runs; an ended job is unchanged."""
        job = self.get(name)
        with self._changed:
            job.cancelled = True
            if job in self._waiting:
                self._waiting.remove(job)
                job.emit("cancelled")

    def wait(self) -> None:
        """Wait until all jobs have ended."""
        with self._changed:
            self._changed.wait_for(lambda: not self._waiting and self._current is None)

    def close(self) -> None:
        """Cancel all jobs and end the thread."""
        with self._changed:
            self._closed = True
            for job in [*self._waiting, *([self._current] if self._current else [])]:
                job.cancelled = True
            self._changed.notify_all()
        self._thread.join(timeout=60)

    def _forget(self) -> None:
        ended = [name for name, job in self._known.items() if job.ended]
        for name in ended[: max(0, len(self._known) - MOST_FINISHED)]:
            del self._known[name]

    def _run_all(self) -> None:
        while True:
            with self._changed:
                self._current = None
                self._changed.notify_all()
                self._changed.wait_for(lambda: self._closed or self._waiting)
                if self._closed:
                    for job in self._waiting:
                        job.emit("cancelled")
                    return
                job = self._current = self._waiting.popleft()
            _run(job)


def report_progress(report: Callable[[], None]) -> Callable[..., Iterator[Any]]:
    """Return a `Progress` that calls a function before each step and after the last."""

    def steps(items: Iterable[Any], total: int) -> Iterator[Any]:
        report()
        for item in items:
            yield item
            report()

    return steps


def _run(job: Job) -> None:
    """Run a job and emit its end; the queue continues after any error."""
    try:
        job.work(job)
    except Cancelled:
        job.emit("cancelled")
    except Exception as error:
        refusal = request_error(error)
        if refusal is None:
            logger.error("job %s", job.name, exc_info=error)
            refusal = RequestError(500, "something went wrong; see the terminal that runs the studio")
        job.emit("failed", error=str(refusal))
    else:
        job.emit("done")
