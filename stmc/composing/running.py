"""One run of sampling: everything that a method may use, and the building blocks of methods."""

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

from stmc.composing.autoregression import Action, action_rounds, observed_features
from stmc.composing.batching import Guided
from stmc.composing.inpainting import Observed, impute
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
from stmc.diffusion import SAMPLERS, Draw, FrameNoise, Noise, Predict, Sampler, Schedule, Seed
from stmc.diffusion.statistics import Statistics
from stmc.motion.representation import Layout
from stmc.settings.records import SettingError
from stmc.timeline import Timeline
from stmc.timeline.planning import Plan, Span, plan

Progress = Callable[..., Iterable[Any]]
"""(denoising steps, total=number of steps) → the same steps; displays progress, e.g. `tqdm`."""


@dataclass(frozen=True, eq=False)
class Run:
    """A batch of timelines that is being sampled, whatever the method.

    Args:
        timelines: The timelines.
        seeds: Seed of each timeline.
        sampling: Resolved settings; None means that a setting does not apply.
        schedule: Full noise schedule.
        fps: Frames per second.
        longest: Maximum number of frames of a crop.
        overlap: Length of a transition in frames.
        layout: Layout of the features.
        statistics: Statistics that normalise the features.
        guided: Builds a predictor of the crops of plans with a guidance; see `composing.guided_crops`.
        guided_sequences: Builds a predictor of the sequences of plans without overlap, with a guidance.
        fixed_length: The denoiser's `fixed_length`; see `Network`.
        device: Device of the features.
        progress: Displays progress.
        one_shot: Texts of one-shot actions; see `planning.plan`.
        observed: Observed features, or None.
        constrain: Moves clean timelines [batch, frames, features] towards constraints, or None.
        window: Frames [start, end) of the one timeline to sample, with the noise of those frames; None: all frames.
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
    one_shot: Collection[str] = ()
    observed: Observed | None = None
    constrain: Callable[[Tensor], Tensor] | None = None
    window: Span | None = None

    @property
    def columns(self) -> Columns:
        """The columns of the features that each body part owns."""
        return self.layout.columns

    @property
    def guidance(self) -> float | int:
        """The guidance weight of the texts."""
        assert self.sampling.guidance is not None
        return self.sampling.guidance

    @cached_property
    def times(self) -> tuple[int, ...]:
        """The visited steps of the schedule, in rising order."""
        return self.schedule.spaced(self.sampling.steps)

    def steps_before(self, fraction: float | int | None) -> int:
        """Return the number of the noisiest steps that make up a fraction of all steps."""
        return int((fraction or 0) * len(self.times))

    def plans(self, overlap: int | None = None) -> list[Plan]:
        """Lay out each timeline, with transitions of `overlap` frames; None uses the overlap of the run."""
        overlap = self.overlap if overlap is None else overlap
        arguments = (self.fps, overlap, self.longest, self.one_shot, self.window)
        return [plan(timeline, *arguments) for timeline in self.timelines]

    def collage(self, plans: Sequence[Plan], guidance: float | int | None = None) -> Predict:
        """Build a predictor of timelines from their plans; a guidance of None uses that of the run."""
        return collage(self.crops(plans, guidance), plans, self.columns, self.fixed_length)

    def constrained(self, predict: Predict) -> Predict:
        """Wrap a predictor of timelines so that predictions meet the constraints and contain the observed features.

        Constraints are applied first.
        """
        constrain, observed = self.constrain, self.observed
        constrained = predict if constrain is None else lambda x, t: constrain(predict(x, t))
        return constrained if observed is None else impute(constrained, *observed)

    def crops(self, plans: Sequence[Plan], guidance: float | int | None = None) -> Predict:
        """Build a predictor of the plans' crops with guidance from the setting `guidance_from` on.

        Before it, in the noisiest steps, guidance is at most 1 (Kynkäänniemi et al. 2024). Higher guidance there
        exaggerates the differences of neighbouring crops, which a transition must then bridge: a hand moves its whole
        way in three frames. Lower guidance follows the text less; see the results page.
        """
        guidance = self.guidance if guidance is None else guidance
        unguided, predict = self.steps_before(self.sampling.guidance_from), cache(partial(self._guided, plans))
        if not unguided or guidance <= 1:
            return predict(guidance)
        first = self.times[-unguided]
        return lambda x, t: predict(1.0 if t >= first else guidance)(x, t)

    def noise(self, plans: Sequence[Plan], seeds: Sequence[Seed] | None = None) -> Noise | FrameNoise:
        """Create the source of the initial noise, and of the noise of every step, for timelines with these plans."""
        return self._noise(self.seeds if seeds is None else seeds, canvas_lengths(plans, self.fixed_length))

    def denoise(
        self, predict: Predict, x: Float[Tensor, "batch frames features"], draw: Draw, steps: int | None = None
    ) -> Float[Tensor, "batch frames features"]:
        """Run all steps, or the `steps` least noisy ones, and return the clean sample.

        Args:
            predict: Predictor of clean samples.
            x: Initial sample, as noisy as the first of the steps.
            draw: Source of noise.
            steps: Number of steps; None runs all.
        """
        times = self.times[:steps]
        return _last(self.progress(self._states(predict, x, draw, times), total=len(times)))

    def independent(self) -> Float[Tensor, "batch frames features"]:
        """Sample the crops of plans without overlap independently, and combine them (SINC)."""
        self._check_no_constraints()
        plans = self.plans(0)
        draw = self._crop_noise(plans)
        predict = self._impute_crops(self._guided(plans, self.guidance), plans)
        return sinc(self.denoise(predict, draw(), draw), plans, self.columns)

    def autoregressive(self, plans: Sequence[Plan]) -> Float[Tensor, "batch frames features"]:
        """Sample the crops of plans that look back one after the other, with previous frames as context (TEACH).

        The context replaces its part of every prediction, so that the crop is sampled to fit it. See
        `planning.look_back`.
        """
        self._check_no_constraints()
        features = torch.zeros(len(plans), max(plan.frames for plan in plans), self.layout.width, device=self.device)
        for actions in action_rounds(plans):
            for action, crop in zip(actions, self._sample_with_context(features, actions), strict=True):
                owned = slice(action.start - action.crop.start, action.crop.frames)
                features[action.timeline, action.start : action.crop.end] = crop[owned]
        return features

    def _sample_with_context(self, features: Tensor, actions: Sequence[Action]) -> Tensor:
        """Sample the crops of a round of actions, each with its context in `features`."""
        plans = [action.plan for action in actions]
        lengths = crop_lengths(plans, self.fixed_length)
        observed = observed_features(actions, lengths, features, self.observed)
        draw = self._noise([(self.seeds[action.timeline], action.number) for action in actions], lengths)
        return self.denoise(impute(self.guided(plans, self.guidance), *observed), draw(), draw)

    def _check_no_constraints(self) -> None:
        if self.constrain is not None:
            raise SettingError(
                "constraints need a method that composes at every step; this method combines finished crops"
            )

    def sample_independent_start(self, steps: int) -> Float[Tensor, "batch frames features"]:
        """Sample crops independently for the noisiest `steps` steps.

        The result is as noisy as the next step.
        """
        plans, states = self.plans(0), []
        predict, draw = self._impute_crops(self.crops(plans), plans), self._crop_noise(plans)

        def predict_and_record(x: Tensor, t: int) -> Tensor:
            states.append(x)
            return predict(x, t) if len(states) <= steps else x

        _last(self.progress(islice(self._states(predict_and_record, draw(), draw, self.times), steps + 1), total=steps))
        return sinc(states[-1], plans, self.columns)

    def _guided(self, plans: Sequence[Plan], guidance: float | int) -> Guided:
        """Build a predictor of the crops that contain something to generate; others are predicted as zero."""
        if self.observed is None:
            return self.guided(plans, guidance)
        return self.guided(plans, guidance, needed=crops_needed(plans, self.observed.weights == 1, self.columns))

    def _impute_crops(self, predict: Predict, plans: Sequence[Plan]) -> Predict:
        """Wrap a predictor of independent crops so that it returns the observed features."""
        if self.observed is None:
            return predict
        return impute(predict, *(crops_of(values, plans, self.fixed_length) for values in self.observed))

    def _states(self, predict: Predict, x: Tensor, draw: Draw, times: tuple[int, ...]) -> Iterable[Tensor]:
        schedule = self.schedule.respaced(times)
        return sampler_of(self.sampling)(lambda x, i: predict(x, times[i]), schedule, x, draw)

    def _crop_noise(self, plans: Sequence[Plan]) -> Noise | FrameNoise:
        lengths = crop_lengths(plans, self.fixed_length)
        if self.window is None:
            return self._noise(crop_seeds(plans, self.seeds), lengths)
        starts = [self.window[0] + crop.start for plan in plans for crop in plan.crops]
        return FrameNoise((self.seeds[0], 0), starts, lengths, self.layout.width, self.device)

    def _noise(self, seeds: Sequence[Seed], lengths: Sequence[int]) -> Noise | FrameNoise:
        if self.window is None:
            return Noise(seeds, lengths, self.layout.width, device=self.device)
        return FrameNoise(seeds[0], [self.window[0]], lengths, self.layout.width, self.device)


def sampler_of(sampling: Sampling) -> Sampler:
    """Return the sampler, with the settings that are its arguments."""
    sampler = _find_sampler(sampling.sampler)
    taken = settings_taken(sampler)
    return partial(sampler, **{name: value for name, value in sampling.given.items() if name in taken})


def settings_taken(sampler: str | Sampler | None) -> set[str]:
    """Return the settings that are unbound arguments of a sampler, without the steps, which the schedule defines."""
    sampler = _find_sampler(sampler)
    bound = set(sampler.keywords) if isinstance(sampler, partial) else set()
    return set(inspect.signature(sampler).parameters) - bound - {"steps"}


def _find_sampler(sampler: str | Sampler | None) -> Sampler:
    assert sampler is not None  # resolved settings have one
    return SAMPLERS[sampler] if isinstance(sampler, str) else sampler


def _last(items: Iterable[Tensor]) -> Tensor:
    for item in items:  # noqa: B007
        pass
    return item
