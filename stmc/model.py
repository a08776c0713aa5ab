"""A trained model as one record, and the way from timelines to motions through it.

`Model` bundles what belongs together (denoiser, schedule, text encoder, representation, statistics, skeleton); the
steps of `generate` are the library's own functions, each of which can be used alone.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import islice
from typing import Any, Literal, get_args

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from stmc.body_model import Skeleton
from stmc.composing import (
    canvas_lengths,
    collage,
    crop_lengths,
    crop_seeds,
    distinct_texts,
    guided_crops,
    guided_sequences,
    inpaint,
    kept_shares,
    lerp,
    sinc,
    slerp,
    weave,
)
from stmc.composing.batching import Guided
from stmc.denoisers import FlowMdm, Network
from stmc.diffusion import Noise, Predict, Prediction, Schedule, Seed, Spread, ddpm
from stmc.motion import Motion
from stmc.planning import Plan, handshake, multi_diffusion, plan, second_take, soft
from stmc.representation import JointsFrom, Representation
from stmc.statistics import Statistics
from stmc.tensors import mask
from stmc.text import TextEncoder
from stmc.timeline import Timeline, one_text, single_track

Method = Literal[
    "stmc",
    "stmc_soft",
    "sinc",
    "sinc_lerp",
    "single_track",
    "one_text",
    "multi_diffusion",
    "double_take",
    "sinc_slerp",
    "flow_mdm",
]
"""STMC itself, the baselines of the paper's table 1, and other rules of composing in time: see `Model.generate`."""

STITCHED: Mapping[Method, Callable[[Plan], Plan]] = {
    "stmc": lambda plan: plan,
    "stmc_soft": soft,
    "single_track": lambda plan: plan,
    "one_text": lambda plan: plan,
    "multi_diffusion": multi_diffusion,
    "double_take": handshake,
}
"""The methods that stitch crops at every step, each with the rule that it makes of a plan."""

SEAMLESS: tuple[Method, ...] = ("one_text", "sinc", "flow_mdm")
"""The methods whose motions have no transitions of a length."""

OWN_LATE: tuple[Method, ...] = ("stmc", "stmc_soft")
"""The methods that begin to stitch as late as the model says; the others from the first step on."""

SKIPPED = 0.1
"""The share of the steps, the noisiest, that DoubleTake's second take goes without (Shafir et al. 2024)."""

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
    `guidance`, the `spread` of `ddpm` and how `late` STMC begins to stitch are those the model is sampled with unless
    told otherwise.
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
    late: float | int = 0.0

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

    def guided(self, plans: Sequence[Plan], weight: float | int | None = None) -> Guided:
        """A predictor of the plans' crops with classifier-free guidance (None: the model's own): see
        `composing.guided_crops`."""
        weight = self.guidance if weight is None else weight
        settings = {"mixed": self.denoiser.mixed, "window": self.denoiser.window}
        read = self._read(plans)
        return guided_crops(self._denoise, self.schedule, plans, read, weight, self.prediction, **settings)

    def guided_sequences(self, plans: Sequence[Plan], weight: float | int | None = None) -> Guided:
        """A predictor of the body sequences of plans without overlap, with guidance: see
        `composing.guided_sequences`. Raises `ValueError` for a denoiser that knows one text only."""
        if not isinstance(self.denoiser, FlowMdm):
            name = type(self.denoiser).__name__
            raise ValueError(f"{name} knows one text for all frames; only FlowMdm denoises sequences of several")
        weight = self.guidance if weight is None else weight
        return guided_sequences(self._denoise, self.schedule, plans, self._read(plans), weight, self.prediction)

    def _read(self, plans: Sequence[Plan]) -> dict[str, Float[Tensor, "words read"]]:
        with self._autocast():
            embeddings = self.embed(distinct_texts(plans)).items()
            return {text: self.denoiser.read(words[None].to(self.device))[0].float() for text, words in embeddings}

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
        late: float | int | None = None,
        joints_from: JointsFrom = "skeleton",
        track: Track = iter,
    ) -> list[Motion]:
        """One motion for each timeline, of its duration, at the model's frame rate, on the model's skeleton.

        `seed`: one for each timeline, or the first of consecutive ones; a motion depends on its own alone, not on the
        batch. `guidance` weighs the text (1: as trained, 0: no text; None: the model's own); `overlap` in seconds;
        `steps` of denoising (None: as many as in training); `sampler` (None: `ddpm` with the model's own spread).

        `method`: "stmc" stitches at every step (section 3.3), or only after the share `late` of them (None: the model's
        own), before which crops are denoised alone (section 4.6's outlook); "stmc_soft" does the same with crops that
        come and go along straight lines (see `planning.soft`); "sinc" once, after sampling each crop on
        its own; "sinc_lerp" smooths the seams of that over `overlap`; "single_track" joins simultaneous texts by
        "while" and composes in time alone (DiffCollage); "one_text" makes one sentence of them all (section 4.3).
        "multi_diffusion" averages overlapping crops; "double_take" fades them into each other and then makes the
        transitions' surroundings anew; "sinc_slerp" is "sinc_lerp" with rotations on the sphere (TEACH); "flow_mdm"
        makes seamless sequences of what each body part obeys, without overlap and crops, by a denoiser that knows a
        text for every frame (`FlowMdm`).

        `joints_from`: see `decode`.

        Raises `ValueError` for an unknown method or `joints_from`, negative seeds, seeds that are not one for each
        timeline, `late` outside of [0, 1) or with a method that does not stitch, and for "flow_mdm" with any other
        denoiser.
        """
        timelines = [timelines] if isinstance(timelines, Timeline) else list(timelines)
        seeds = _seeds(seed, len(timelines))
        if method not in get_args(Method):
            raise ValueError(f"unknown method {method!r}; choose from {', '.join(get_args(Method))}")
        if joints_from not in get_args(JointsFrom):
            raise ValueError(f"unknown joints_from {joints_from!r}; choose from {', '.join(get_args(JointsFrom))}")
        if late is None:
            late = self.late if method in OWN_LATE else 0.0
        check_late(late, method)
        if not timelines:
            return []
        self.denoiser.eval()
        timelines = [_baseline(timeline, method, self) for timeline in timelines]
        run = _Run(self, timelines, seeds, guidance, sampler or partial(ddpm, spread=self.spread), steps, track)
        if method == "flow_mdm":
            features = run.woven()
        elif method in STITCHED:
            plans = self.plans(timelines, overlap)
            features = run.stitched([STITCHED[method](plan) for plan in plans], late)
            if method == "double_take":
                features = run.retaken(plans, features, int(overlap * self.fps) // 2)
        else:
            features = run.joined(run.apart(), method, int(overlap * self.fps))
        motions = self.decode(features, [timeline.frames(self.fps) for timeline in timelines], joints_from)
        made_with = 0.0 if method in SEAMLESS else overlap
        return [dataclasses.replace(motion, overlap=made_with) for motion in motions]

    def decode(
        self,
        features: Float[Tensor, "batch frames features"],
        lengths: Sequence[int],
        joints_from: JointsFrom = "skeleton",
    ) -> list[Motion]:
        """Motions on the CPU from a batch of normalised features, each of its own length.

        Joints are those of the model's "skeleton", whose bones keep their lengths; or the positions that are part of
        the "features" (of HumanML3D's, what `recover_from_ric` gives), which STMC's tables were made from.
        """
        skeleton = self.skeleton if joints_from == "skeleton" else None
        raw = self.motion_statistics.restore(features.float().cpu())
        return [
            self.representation.decode(row[:length], self.fps, skeleton)
            for row, length in zip(raw, lengths, strict=True)
        ]


def check_late(late: float | int, method: Method) -> None:
    """Raises `ValueError` unless `method` can begin to stitch after the share `late` of the steps."""
    if not 0 <= late < 1 or (late and method not in STITCHED):
        raise ValueError(
            f"late={late}: the share of the steps before stitching is in [0, 1), and 0 for SINC and FlowMDM"
        )


def _baseline(timeline: Timeline, method: Method, model: Model) -> Timeline:
    if method == "one_text":
        return one_text(timeline, model.longest / model.fps)
    return single_track(timeline, model.fps) if method == "single_track" else timeline


@dataclass(frozen=True, eq=False)
class _Run:
    """How timelines are sampled, whichever the method."""

    model: Model
    timelines: Sequence[Timeline]
    seeds: Sequence[int]
    guidance: float | int | None
    sampler: Sampler
    steps: int | None
    track: Track

    @cached_property
    def plans(self) -> list[Plan]:
        """Without overlap: every body part of every frame has one crop."""
        return self.model.plans(self.timelines, 0.0)

    def apart(self) -> Float[Tensor, "batch frames features"]:
        """SINC: the crops alone, combined at the end."""
        return sinc(self._crops(), self.plans, self.model.representation.columns)

    def joined(self, features: Tensor, method: Method, overlap: int) -> Float[Tensor, "batch frames features"]:
        """The combined crops with their seams smoothed over `overlap` frames, or as they are."""
        statistics, representation = self.model.motion_statistics, self.model.representation
        if method == "sinc_slerp":
            return statistics.normalise(slerp(statistics.restore(features), self.plans, representation.layout, overlap))
        return lerp(features, self.plans, representation.columns, overlap) if method == "sinc_lerp" else features

    def woven(self) -> Float[Tensor, "batch frames features"]:
        """FlowMDM, with several tracks."""
        predict = self.model.guided_sequences(self.plans, self.guidance)
        predict = weave(predict, self.plans, self.model.representation.columns)
        draw = self._noise(self.seeds, canvas_lengths(self.plans))
        return _last(self.track(self.sampler(predict, self.model.schedule, draw(), draw, steps=self.steps)))

    def retaken(
        self, plans: Sequence[Plan], content: Float[Tensor, "batch frames features"], ramp: int
    ) -> Float[Tensor, "batch frames features"]:
        """DoubleTake's second take: `ramp` frames on either side of each transition, made anew without a text."""
        if not ramp:
            return content
        model, columns, window = self.model, self.model.representation.columns, self.model.denoiser.window
        takes = [second_take(plan, model.longest) for plan in plans]
        kept = kept_shares(plans, columns, ramp).to(content)
        kept = F.pad(kept, (0, 0, 0, content.shape[1] - kept.shape[1]), value=1.0)
        predict = inpaint(collage(model.guided(takes, 0.0), takes, columns, window), content, kept)
        times = model.schedule.spaced(self.steps)
        times = times[: max(1, len(times) - int(SKIPPED * len(times)))]
        draw = self._noise([(seed, 0) for seed in self.seeds], canvas_lengths(takes, window))
        return self._rest(predict, model.schedule.q_sample(content, times[-1], draw()), draw, times)

    def stitched(self, plans: Sequence[Plan], late: float | int) -> Float[Tensor, "batch frames features"]:
        """STMC on `plans`, from the share `late` of the steps on."""
        model, window = self.model, self.model.denoiser.window
        predict = collage(model.guided(plans, self.guidance), plans, model.representation.columns, window)
        draw = self._noise(self.seeds, canvas_lengths(plans, window))
        times = model.schedule.spaced(self.steps)
        alone = int(late * len(times))
        if not alone:
            return _last(self.track(self.sampler(predict, model.schedule, draw(), draw, steps=self.steps)))
        times = times[: len(times) - alone]
        x = model.schedule.q_sample(torch.zeros_like(noise := draw()), times[-1], noise)  # what lies behind the ends
        apart = sinc(self._crops(until=alone), self.plans, model.representation.columns)
        x[:, : apart.shape[1]] = torch.where(self._within(apart), apart, x[:, : apart.shape[1]])
        return self._rest(predict, x, draw, times)

    def _rest(self, predict: Predict, x: Tensor, draw: Noise, times: tuple[int, ...]) -> Tensor:
        """Sampling in the steps `times` alone, from `x`, as noisy as at the last of them."""
        schedule = self.model.schedule.respaced(times)
        return _last(self.track(self.sampler(lambda x, i: predict(x, times[i]), schedule, x, draw)))

    def _crops(self, until: int | None = None) -> Float[Tensor, "crops frames features"]:
        """The crops, each sampled alone; or their noisy states after so many steps."""
        model, window = self.model, self.model.denoiser.window
        predict, states = model.guided(self.plans, self.guidance), []
        draw = self._noise(crop_seeds(self.plans, self.seeds), crop_lengths(self.plans, window))

        def watched(x: Tensor, t: int) -> Tensor:
            states[:] = [x]
            return predict(x, t)

        sampling = self.sampler(watched, model.schedule, draw(), draw, steps=self.steps)
        if until is None:
            return _last(self.track(sampling))
        _last(islice(sampling, until + 1))
        return states[0]

    def _within(self, features: Tensor) -> Tensor:
        """Where a timeline has frames."""
        return mask(torch.tensor([plan.frames for plan in self.plans]))[..., None].to(features.device)

    def _noise(self, seeds: Sequence[Seed], lengths: Sequence[int]) -> Noise:
        return Noise(seeds, lengths, self.model.representation.width, device=self.model.device)


def _last(items: Iterable[Tensor]) -> Tensor:
    for item in items:  # noqa: B007
        pass
    return item


def _seeds(seed: int | Sequence[int], count: int) -> list[int]:
    seeds = list(range(seed, seed + count)) if isinstance(seed, int) else list(seed)
    if len(seeds) != count:
        raise ValueError(f"{len(seeds)} seeds for {count} timelines: each needs one")
    if min(seeds, default=0) < 0:
        raise ValueError(f"seed {min(seeds)} is negative: seeds count from 0")
    return seeds
