"""Sampling jobs of the studio: a queue whose jobs emit events and can be cancelled.

This module knows motions and generation requests; it knows no HTTP and no pages.
"""

from __future__ import annotations

import asyncio
import itertools
import logging
import secrets
from collections import OrderedDict, deque
from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from threading import Condition, Lock, Thread
from typing import Any, NamedTuple

from stmc.composing import Progress
from stmc.composing.sampling import Sampling
from stmc.editing.generate_request import GenerateRequest
from stmc.motion.motion import Motion
from stmc.viewing.studio.request_errors import RequestError, request_error
from stmc.viewing.studio.storage import Motions
from stmc.viewing.studio.turns import Turns

logger = logging.getLogger(__name__)

MOST_WAITING = 32
"""Maximum number of waiting jobs."""

MOST_FINISHED = 200
"""Number of jobs to remember."""

ENDS = ("done", "failed", "cancelled")

Event = tuple[str, dict[str, Any]]
"""Kind of an event, and its details."""


class Cancelled(Exception):
    """Signal to end a job before its next step."""


class Stage(NamedTuple):
    """A stage of a job: its name for the page, and its number of denoising steps."""

    name: str
    steps: int


PREVIEW = Stage("preview", 10)

FULL_STEPS = 50
"""Denoising steps of a motion, unless the model is one of few steps."""


def stages_by_quality(own_steps: int | None, steps: int) -> dict[str, tuple[Stage, ...]]:
    """Return the stages of a preview and of a motion in `steps` steps; a model of few steps needs no preview before it.

    `own_steps` is the number of steps that a model of few steps stores; None for other models.
    """
    full = Stage("full", steps)
    if own_steps is not None:
        return {"preview": (Stage("preview", steps),), "full": (full,)}
    return {"preview": (PREVIEW,), "full": (PREVIEW, full)}


OWN = Sampling(sampler="ddim")
"""Defaults of the studio for settings that a request leaves unset."""

Sample = Callable[[GenerateRequest, Progress], Sequence[Motion]]
"""`Model.sample`, or a function like it."""


@dataclass(eq=False)
class Job:
    """A request to sample, with its events.

    `stages` run one after the other, such as a preview and then the full motion. Only the last job of a `tab` of the
    browser waits.
    """

    request: GenerateRequest
    stages: tuple[Stage, ...] = (PREVIEW,)
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

    def tell(self, kind: str, **details: Any) -> None:
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

    async def heard(self) -> AsyncIterator[Event]:
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


class Jobs:
    """The queue and the single thread that runs its jobs with `sample`, a method of a model.

    Between their steps, jobs give way to streams with the same `turns`.

    Examples:
        >>> jobs = stmc.viewing.studio.Jobs(stmc.load().sample, stmc.viewing.studio.Motions("motions"))
        >>> job = jobs.add(stmc.GenerateRequest.read({"timelines": "walk # 0 # 1"}))
        >>> jobs.wait()
        >>> [kind for kind, details in job.events]
        ['progress', 'motion', 'done']
        >>> jobs.close()
    """

    def __init__(self, sample: Sample, motions: Motions, turns: Turns | None = None) -> None:
        self.sample, self.motions, self._turns = sample, motions, turns or Turns()
        self._waiting: deque[Job] = deque()
        self._known: OrderedDict[str, Job] = OrderedDict()
        self._current: Job | None = None
        self._changed, self._closed = Condition(), False
        self._thread = Thread(target=self._work, name="studio jobs", daemon=True)
        self._thread.start()

    def add(self, request: GenerateRequest, stages: tuple[Stage, ...] = (PREVIEW,), tab: str = "") -> Job:
        """Queue a job and cancel waiting jobs of the same tab. Raises `RequestError` if too many jobs wait.

        Args:
            request: Request to sample.
            stages: Stages of sampling.
            tab: Identifier of the browser tab; empty: none.
        """
        job = Job(request, stages, tab)
        with self._changed:
            for other in [each for each in self._waiting if tab and each.tab == tab]:
                self._waiting.remove(other)
                other.tell("cancelled")
            if len(self._waiting) >= MOST_WAITING:
                raise RequestError(429, f"{MOST_WAITING} jobs are already waiting")
            self._known[job.name] = job
            self._forget()
            self._waiting.append(job)
            job.tell("progress", stage="waiting", step=0, steps=0)
            self._changed.notify_all()
        return job

    def get(self, name: str) -> Job:
        """Return the job with this name. Raises `RequestError` if there is none."""
        with self._changed:
            if name not in self._known:
                raise RequestError(404, "there is no such job")
            return self._known[name]

    def cancel(self, name: str) -> None:
        """Cancel a job, at once if it waits and before its next step if it runs; an ended job is unchanged."""
        job = self.get(name)
        with self._changed:
            job.cancelled = True
            if job in self._waiting:
                self._waiting.remove(job)
                job.tell("cancelled")

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

    def _work(self) -> None:
        while True:
            with self._changed:
                self._current = None
                self._changed.notify_all()
                self._changed.wait_for(lambda: self._closed or self._waiting)
                if self._closed:
                    for job in self._waiting:
                        job.tell("cancelled")
                    return
                job = self._current = self._waiting.popleft()
            _guarded(job, self._work_off)

    def _work_off(self, job: Job) -> None:
        for stage in job.stages:
            for seed, motion in zip(job.request.seeds, self._sampled(job, stage), strict=True):
                told = self.motions.told(self.motions.add(motion))
                demands = [each.measure(motion) for each in job.request.constraints]
                job.tell("motion", seed=seed, stage=stage.name, motion=told, demands=demands)

    def _sampled(self, job: Job, stage: Stage) -> Sequence[Motion]:
        steps, made = stage.steps, itertools.count()

        def told() -> None:
            self._turns.give_way()
            if job.cancelled:
                raise Cancelled
            job.tell("progress", stage=stage.name, step=min(next(made), steps), steps=steps)

        sampling = Sampling(steps=steps).over(job.request.sampling).over(OWN)
        with self._turns.job():
            return self.sample(replace(job.request, sampling=sampling), _watched(told))


def _watched(told: Callable[[], None]) -> Callable[..., Iterator[Any]]:
    """Return a `progress` of `Model.generate` that calls a function before each step and after the last."""

    def steps(items: Iterable[Any], total: int) -> Iterator[Any]:
        told()
        for item in items:
            yield item
            told()

    return steps


def _guarded(job: Job, work: Callable[[Job], None]) -> None:
    """Run a job and emit its end; the queue continues after any error."""
    try:
        work(job)
    except Cancelled:
        job.tell("cancelled")
    except Exception as error:
        job.tell("failed", error=_explained(error, job))
    else:
        job.tell("done")


def _explained(error: Exception, job: Job) -> str:
    """Return the message of a failed job, which names the kinds of constraints that cannot be met."""
    refusal = request_error(error)
    if refusal is not None:
        return str(refusal)
    if job.request.constraints and isinstance(error, (ValueError, ArithmeticError)):
        kinds = sorted({each.name for each in job.request.constraints})
        return f"constraints ({', '.join(kinds)}) cannot be met here: {error}"
    logger.error("job %s", job.name, exc_info=error)
    return "something went wrong; see the terminal that runs the studio"
