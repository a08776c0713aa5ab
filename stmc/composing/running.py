"""One run of sampling: all that a method may touch, and the few moves that methods are made of.

Knows timelines, seeds, settings, a predictor of crops and a schedule; knows no networks, no texts' embeddings and no
`Model`.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, partial
from itertools import islice
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from stmc.composing.autoregression import Action, action_rounds, seen_before
from stmc.composing.batching import Guided
from stmc.composing.inpainting import Known, impute
from stmc.composing.sampling import Sampling
from stmc.composing.stitching import (
    Columns,
    canvas_lengths,
    collage,
    crop_lengths,
    crop_seeds,
    crops_needed,
    crops_of,
    sinc,
)
from stmc.diffusion import SAMPLERS, Draw, Noise, Predict, Sampler, Schedule, Seed
from stmc.diffusion.statistics import Statistics
from stmc.motion.representation import Layout
from stmc.settings.records import SettingError
from stmc.timeline import Timeline
from stmc.timeline.planning import Plan, plan

Progress = Callable[..., Iterable[Any]]
"""(denoising steps, total=their number) → the same steps: how a caller shows progress, e.g. `tqdm`."""


@dataclass(frozen=True, eq=False)
class Run:
    """A batch of timelines that is being sampled, whichever the method.

    `sampling` is complete: what is None there does not apply. `overlap` is in frames. `guided` and `guided_sequences`
    make predictors of plans' crops, and of the sequences of plans without overlap, with a guidance: see
    `composing.guided_crops`. `fixed_length` is the denoiser's (see `Network`); `layout` and `statistics` are those of
    the features, which are normalised. `once`: texts of what happens once, however long it is asked for: see `plan`.
    What is asked for beside the texts: `known` features, and `meet`, which brings
    clean timelines [batch, frames, features] nearer to constraints.
    """

    timelines: Sequence[Timeline]
    seeds: Sequence[int]
    sampling: Sampling
    schedule: Schedule
    fps: float | int
    longest: int
    overlap: int
    layout: Layout
    statistics: Statistics
    guided: Callable[..., Guided]
    guided_sequences: Callable[[Sequence[Plan], float | int], Guided]
    fixed_length: int | None
    device: torch.device
    progress: Progress
    once: Collection[str] = ()
    known: Known | None = None
    meet: Callable[[Tensor], Tensor] | None = None

    @property
    def columns(self) -> Columns:
        """The columns of the features that each body part owns."""
        return self.layout.columns

    @cached_property
    def times(self) -> tuple[int, ...]:
        """The steps of the schedule that are visited, in rising order."""
        return self.schedule.spaced(self.sampling.steps)

    def steps_before(self, share: float | int | None) -> int:
        """How many of the steps, the noisiest, lie before a share of them."""
        return int((share or 0) * len(self.times))

    def plans(self, overlap: int | None = None) -> list[Plan]:
        """The layout of each timeline, its transitions as long as the run's, or `overlap` frames."""
        overlap = self.overlap if overlap is None else overlap
        return [plan(timeline, self.fps, overlap, self.longest, self.once) for timeline in self.timelines]

    def collage(self, plans: Sequence[Plan], guidance: float | int | None = None) -> Predict:
        """A predictor of the timelines by their plans, with the run's guidance or another."""
        return collage(self.crops(plans, guidance), plans, self.columns, self.fixed_length)

    def constrained(self, predict: Predict) -> Predict:
        """The predictor of timelines whose every answer meets what is asked for beside the texts: constraints first,
        then what is known."""
        meet, known = self.meet, self.known
        met = predict if meet is None else lambda x, t: meet(predict(x, t))
        return met if known is None else impute(met, *known)

    def crops(self, plans: Sequence[Plan], guidance: float | int | None = None) -> Predict:
        """A predictor of the plans' crops, with the run's guidance or another: from the setting `guidance_from` on.

        Before it, in the noisiest steps, guidance is 1 at most (Kynkäänniemi et al. 2024). More of it exaggerates there
        how neighbouring crops differ, which must then be bridged: a hand goes all its way in three frames. Less of it
        is heard less: measured in the results.
        """
        guidance = self.sampling.guidance if guidance is None else guidance
        unguided, predict = self.steps_before(self.sampling.guidance_from), cache(partial(self._guided, plans))
        if not unguided or guidance <= 1:
            return predict(guidance)
        first = self.times[-unguided]
        return lambda x, t: predict(1.0 if t >= first else guidance)(x, t)

    def noise(self, plans: Sequence[Plan], seeds: Sequence[Seed] | None = None) -> Noise:
        """What timelines of these plans begin with, and what is added at every step."""
        return self._noise(self.seeds if seeds is None else seeds, canvas_lengths(plans, self.fixed_length))

    def denoise(
        self, predict: Predict, x: Float[Tensor, "batch frames features"], draw: Draw, steps: int | None = None
    ) -> Float[Tensor, "batch frames features"]:
        """The clean sample after all steps, or after the `steps` least noisy ones, from `x`, as noisy as the first."""
        times = self.times[:steps]
        return _last(self.progress(self._states(predict, x, draw, times), total=len(times)))

    def independent(self) -> Float[Tensor, "batch frames features"]:
        """The crops of plans without overlap, each sampled by itself, and then combined (SINC)."""
        self._refuse_constraints()
        plans = self.plans(0)
        draw = self._crop_noise(plans)
        predict = self._knowing(self._guided(plans, self.sampling.guidance), plans)
        return sinc(self.denoise(predict, draw(), draw), plans, self.columns)

    def autoregressive(self, plans: Sequence[Plan]) -> Float[Tensor, "batch frames features"]:
        """The crops of plans that look back (`planning.look_back`), one after the other, each with the frames that it
        looks back on as known (TEACH): they stand in all that is predicted, so that the crop is sampled to fit them."""
        self._refuse_constraints()
        made = torch.zeros(len(plans), max(plan.frames for plan in plans), self.layout.width, device=self.device)
        for actions in action_rounds(plans):
            for action, crop in zip(actions, self._sampled_behind(made, actions), strict=True):
                own = slice(action.start - action.crop.start, action.crop.frames)
                made[action.timeline, action.start : action.crop.end] = crop[own]
        return made

    def _sampled_behind(self, made: Tensor, actions: Sequence[Action]) -> Tensor:
        """The crops of a round of actions, each with what it sees of what is `made`."""
        plans = [action.plan for action in actions]
        lengths = crop_lengths(plans, self.fixed_length)
        known = seen_before(actions, lengths, made, self.known)
        draw = self._noise([(self.seeds[action.timeline], action.number) for action in actions], lengths)
        return self.denoise(impute(self.guided(plans, self.sampling.guidance), *known), draw(), draw)

    def _refuse_constraints(self) -> None:
        if self.meet is not None:
            raise SettingError("constraints: the method must compose at every step; this one combines finished crops")

    def begun_independently(self, steps: int) -> Float[Tensor, "batch frames features"]:
        """The same after so many `steps`, the noisiest: as noisy as the step behind them."""
        plans, states = self.plans(0), []
        predict, draw = self._knowing(self.crops(plans), plans), self._crop_noise(plans)

        def watched(x: Tensor, t: int) -> Tensor:
            states.append(x)
            return predict(x, t) if len(states) <= steps else x

        _last(self.progress(islice(self._states(watched, draw(), draw, self.times), steps + 1), total=steps))
        return sinc(states[-1], plans, self.columns)

    def _guided(self, plans: Sequence[Plan], guidance: float | int) -> Guided:
        """Of the plans' crops those alone in which something is not known."""
        if self.known is None:
            return self.guided(plans, guidance)
        return self.guided(plans, guidance, needed=crops_needed(plans, self.known.weights == 1, self.columns))

    def _knowing(self, predict: Predict, plans: Sequence[Plan]) -> Predict:
        """A predictor of crops, each alone, that answers with what is known."""
        if self.known is None:
            return predict
        return impute(predict, *(crops_of(each, plans, self.fixed_length) for each in self.known))

    def _states(self, predict: Predict, x: Tensor, draw: Draw, times: tuple[int, ...]) -> Iterable[Tensor]:
        schedule = self.schedule.respaced(times)
        return sampler_of(self.sampling)(lambda x, i: predict(x, times[i]), schedule, x, draw)

    def _crop_noise(self, plans: Sequence[Plan]) -> Noise:
        return self._noise(crop_seeds(plans, self.seeds), crop_lengths(plans, self.fixed_length))

    def _noise(self, seeds: Sequence[Seed], lengths: Sequence[int]) -> Noise:
        return Noise(seeds, lengths, self.layout.width, device=self.device)


def sampler_of(sampling: Sampling) -> Sampler:
    """The sampler, with those of the settings that its own arguments name."""
    sampler = _named(sampling.sampler)
    taken = settings_taken(sampler)
    return partial(sampler, **{name: value for name, value in sampling.given.items() if name in taken})


def settings_taken(sampler: str | Sampler) -> set[str]:
    """Which settings a sampler has arguments for that are not bound yet; the steps are those of its schedule."""
    sampler = _named(sampler)
    bound = set(sampler.keywords) if isinstance(sampler, partial) else set()
    return set(inspect.signature(sampler).parameters) - bound - {"steps"}


def _named(sampler: str | Sampler) -> Sampler:
    return SAMPLERS[sampler] if isinstance(sampler, str) else sampler


def _last(items: Iterable[Tensor]) -> Tensor:
    for item in items:  # noqa: B007
        pass
    return item
