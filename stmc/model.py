"""A trained model as one record, and the way from timelines to motions through it.

`Model` bundles what belongs together (denoiser, schedule, text encoder, representation, statistics, skeleton); the
steps of `generate` are the library's own functions, each of which can be used alone.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from stmc.body_model import Skeleton
from stmc.compose import canvas_lengths, collage, crop_lengths, crop_seeds, distinct_texts, guided_crops, lerp, sinc
from stmc.denoisers import Network
from stmc.diffusion import Noise, Predict, Prediction, Schedule, Seed, Spread, ddpm
from stmc.motion import Motion
from stmc.planning import Plan, plan
from stmc.representation import Representation
from stmc.statistics import Statistics
from stmc.text import TextEncoder
from stmc.timeline import Timeline, one_text, single_track

Method = Literal["stmc", "sinc", "sinc_lerp", "single_track", "one_text"]
"""STMC itself and the baselines of the paper's table 1: see `Model.generate`."""

Precision = Literal["fp32", "bf16"]

Sampler = Callable[..., Iterable[Float[Tensor, "batch frames features"]]]
"""`ddpm`, `ddim`, `dpm_solver`, or one of them with some arguments fixed."""

Track = Callable[[Iterable], Iterable]
"""What a caller wraps around the denoising steps to show progress, e.g. a progress bar."""


@dataclass(frozen=True, eq=False)
class Model:
    """Everything that makes motion from text. `fps` is the frame rate of the features, `longest` the most frames that
    the denoiser knows from training; `config` says how to build the parts again (see `run.save`). `precision` is the
    denoiser's at sampling: "bf16" is faster where the processor has it, but a motion then depends on its batch, a bit.
    `guidance` and the `spread` of `ddpm` are those the model is sampled with unless told otherwise.
    """

    denoiser: Network
    schedule: Schedule
    text_encoder: TextEncoder
    representation: Representation
    motion_statistics: Statistics
    text_statistics: Statistics
    skeleton: Skeleton
    fps: float | int
    longest: int
    prediction: Prediction = "x0"
    config: Mapping[str, Any] = field(default_factory=dict)
    precision: Precision = "fp32"
    guidance: float | int = 2.5
    spread: Spread = "variance"

    @property
    def device(self) -> torch.device:
        """Where the denoiser is."""
        return next(self.denoiser.parameters()).device

    def to(self, device: torch.device | str) -> Model:
        """The model on another device. The denoiser is moved, not copied."""
        return dataclasses.replace(self, denoiser=self.denoiser.to(device))

    def plans(self, timelines: Sequence[Timeline], overlap: float | int = 0.5) -> list[Plan]:
        """The layouts of timelines in this model's frames; `overlap` in seconds (2 l in the paper)."""
        frames = int(overlap * self.fps)
        return [plan(timeline, fps=self.fps, overlap=frames, longest=self.longest) for timeline in timelines]

    def embed(self, texts: Sequence[str]) -> dict[str, Float[Tensor, "words width"]]:
        """Normalised embeddings, each text encoded once."""
        distinct = list(dict.fromkeys(texts))
        words, lengths = self.text_encoder.encode(distinct)
        words = self.text_statistics.normalise(words.float().cpu())
        return {text: row[:length] for text, row, length in zip(distinct, words, lengths.tolist(), strict=True)}

    def guided(self, plans: Sequence[Plan], weight: float | int | None = None) -> Predict:
        """A predictor of the plans' crops with classifier-free guidance (None: the model's own): see
        `compose.guided_crops`."""
        weight = self.guidance if weight is None else weight
        network = self.denoiser
        with self._autocast():
            embeddings = self.embed(distinct_texts(plans)).items()
            read = {text: network.read(words[None].to(self.device))[0].float() for text, words in embeddings}
        settings = {"mixed": network.mixed, "window": network.window}
        return guided_crops(self._denoise, self.schedule, plans, read, weight, self.prediction, **settings)

    def _denoise(self, x: Tensor, *others: Tensor | None) -> Tensor:
        with self._autocast():
            return self.denoiser.denoise(x, *others)

    def _autocast(self) -> torch.autocast:
        return torch.autocast(self.device.type, torch.bfloat16, enabled=self.precision == "bf16")

    @torch.inference_mode()
    def generate(
        self,
        timelines: Timeline | Sequence[Timeline],
        seed: int | Sequence[int] = 0,
        guidance: float | int | None = None,
        overlap: float | int = 0.5,
        steps: int | None = None,
        sampler: Sampler | None = None,
        method: Method = "stmc",
        track: Track = iter,
    ) -> list[Motion]:
        """One motion for each timeline, of its duration, at the model's frame rate, on the model's skeleton.

        `seed`: one for each timeline, or the first of consecutive ones; a motion depends on its own alone, not on the
        batch. `guidance` weighs the text (1: as trained, 0: no text; None: the model's own); `overlap` in seconds;
        `steps` of denoising (None: as many as in training); `sampler` (None: `ddpm` with the model's own spread).
        `method`: "stmc" stitches at every step (section 3.3); "sinc" once, after sampling each
        crop on its own; "sinc_lerp" smooths the seams of that over `overlap`; "single_track" joins simultaneous texts
        by "while" and composes in time alone (DiffCollage); "one_text" makes one sentence of them all (section 4.3).
        Raises `ValueError` for an unknown method, negative seeds, and seeds that are not one for each timeline.
        """
        timelines = [timelines] if isinstance(timelines, Timeline) else list(timelines)
        seeds = list(range(seed, seed + len(timelines))) if isinstance(seed, int) else list(seed)
        if len(seeds) != len(timelines):
            raise ValueError(f"{len(seeds)} seeds for {len(timelines)} timelines: each needs one")
        if min(seeds, default=0) < 0:
            raise ValueError(f"seed {min(seeds)} is negative: seeds count from 0")
        if method not in get_args(Method):
            raise ValueError(f"unknown method {method!r}; choose from {', '.join(get_args(Method))}")
        if not timelines:
            return []
        self.denoiser.eval()
        timelines = [_baseline(timeline, method, self) for timeline in timelines]
        independent = method in ("sinc", "sinc_lerp")
        plans = self.plans(timelines, 0.0 if independent else overlap)
        columns, window = self.representation.columns, self.denoiser.window
        crops, sampler = self.guided(plans, guidance), sampler or partial(ddpm, spread=self.spread)
        if independent:
            lengths, seeds = crop_lengths(plans, window), crop_seeds(plans, seeds)
            features = self._sample(crops, lengths, seeds, sampler, steps, track)
            features = sinc(features, plans, columns)
            if method == "sinc_lerp":
                features = lerp(features, plans, columns, int(overlap * self.fps))
        else:
            predict = collage(crops, plans, columns, window)
            features = self._sample(predict, canvas_lengths(plans, window), seeds, sampler, steps, track)
        return self.decode(features, [each.frames for each in plans])

    def _sample(
        self,
        predict: Predict,
        lengths: Sequence[int],
        seeds: Sequence[Seed],
        sampler: Sampler,
        steps: int | None,
        track: Track,
    ) -> Float[Tensor, "batch frames features"]:
        draw = Noise(seeds, lengths, self.representation.width, device=self.device)
        for x0 in track(sampler(predict, self.schedule, draw(), draw, steps=steps)):  # noqa: B007
            pass
        return x0

    def decode(self, features: Float[Tensor, "batch frames features"], lengths: Sequence[int]) -> list[Motion]:
        """Motions on the CPU from a batch of normalised features, each of its own length."""
        raw = self.motion_statistics.restore(features.float().cpu())
        return [
            self.representation.decode(row[:length], self.fps, self.skeleton)
            for row, length in zip(raw, lengths, strict=True)
        ]


def _baseline(timeline: Timeline, method: Method, model: Model) -> Timeline:
    if method == "one_text":
        return one_text(timeline, model.longest / model.fps)
    return single_track(timeline, model.fps) if method == "single_track" else timeline
