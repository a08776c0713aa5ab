"""Sampling jobs of the studio: their stages, and the queue that runs them.

This module knows motions and generation requests; it knows no HTTP and no pages.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

from torch.overrides import TorchFunctionMode

from stmc.composing import Progress
from stmc.composing.sampling import Sampling
from stmc.editing.generate_request import GenerateRequest
from stmc.motion.motion import Motion
from stmc.timeline import Timeline
from stmc.viewing.studio.job_queue import Job, JobQueue, report_progress
from stmc.viewing.studio.request_errors import RequestError, request_error
from stmc.viewing.studio.sampling_turns import Turns
from stmc.viewing.studio.storage import Motions
from stmc.viewing.web import Doubtful


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

FindMissed = Callable[[Timeline, Motion], Sequence[Doubtful]]
"""(timeline, motion) → prompts that the motion does not show."""


class CheckedOperations(TorchFunctionMode):
    """A context that calls `check` before every operation on tensors of this thread; an error of it ends the work.

    One denoising step of several long samples takes many seconds; none of its operations takes more than about one.
    """

    def __init__(self, check: Callable[[], None]) -> None:
        super().__init__()
        self._check = check

    def __torch_function__(
        self, func: Callable[..., Any], types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        self._check()
        return func(*args, **(kwargs or {}))


class Jobs(JobQueue):
    """The queue of requests to sample, which its thread runs with `sample`, a method of a model.

    Between their steps, jobs give way to streams with the same `turns`. Motions of the last stage are judged with
    `find_missed`; None: no motion is judged.

    Examples:
        >>> jobs = stmc.viewing.studio.Jobs(stmc.load().sample, stmc.viewing.studio.Motions("motions"))
        >>> job = jobs.add(stmc.GenerateRequest.read({"timelines": "walk # 0 # 1"}))
        >>> jobs.wait()
        >>> [kind for kind, details in job.events]
        ['progress', 'motion', 'done']
        >>> jobs.close()
    """

    def __init__(
        self, sample: Sample, motions: Motions, turns: Turns | None = None, find_missed: FindMissed | None = None
    ) -> None:
        self.sample, self.motions, self._turns, self._find_missed = sample, motions, turns or Turns(), find_missed
        super().__init__("studio jobs")

    def add(self, request: GenerateRequest, stages: tuple[Stage, ...] = (PREVIEW,), tab: str = "") -> Job:
        """Queue a job and cancel waiting jobs of the same tab. Raises `RequestError` if too many jobs wait.

        Args:
            request: Request to sample.
            stages: Stages that run one after the other, such as a preview and then the full motion.
            tab: Identifier of the browser tab; empty: none.
        """
        return self.put(partial(self._sample, request, stages), tab)

    def _sample(self, request: GenerateRequest, stages: tuple[Stage, ...], job: Job) -> None:
        """Sample the stages, store the motions, and emit them."""
        try:
            for stage in stages:
                judge = self._find_missed if stage is stages[-1] else None
                for one, motion in zip(request.split(), self._sample_stage(request, stage, job), strict=True):
                    described = self.motions.describe(self.motions.add(motion))
                    demands = [each.measure(motion) for each in request.constraints]
                    found = judge(one.timelines[0], motion) if judge else ()
                    missed = [{"text": each.text, "sentence": each.advice} for each in found]
                    job.emit(
                        "motion",
                        seed=one.seeds[0],
                        stage=stage.name,
                        motion=described,
                        demands=demands,
                        missed=missed,
                    )
        except (ValueError, ArithmeticError) as error:
            if not request.constraints or request_error(error) is not None:
                raise
            kinds = ", ".join(sorted({each.name for each in request.constraints}))
            raise RequestError(422, f"constraints ({kinds}) cannot be met here: {error}") from error

    def _sample_stage(self, request: GenerateRequest, stage: Stage, job: Job) -> Sequence[Motion]:
        steps, made = stage.steps, itertools.count()

        def report() -> None:
            self._turns.give_way()
            job.check()
            job.emit("progress", stage=stage.name, step=min(next(made), steps), steps=steps)

        sampling = Sampling(steps=steps).with_defaults(request.sampling).with_defaults(OWN)
        with self._turns.job(), CheckedOperations(job.check):
            return self.sample(replace(request, sampling=sampling), report_progress(report))
