"""A trained model as one record, and the steps from timelines to motions.

`Model` bundles the denoiser, schedule, text encoder, representation, statistics and skeleton. Every step of `generate`
is a function of this library that can also be used alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, Literal, Unpack

import torch
from jaxtyping import Float
from torch import Tensor

from stmc.composing import Method, Progress, Rule, Run, distinct_texts, find_method, guided_crops, guided_sequences
from stmc.composing.batching import Guided
from stmc.composing.methods import check_settings, resolve_settings
from stmc.composing.own_words import in_own_words, one_shot_texts
from stmc.composing.sampling import DEFAULT, Sampling, SamplingArguments
from stmc.denoisers import Denoiser, Network, as_network
from stmc.diffusion import Prediction, Schedule
from stmc.diffusion.statistics import Statistics
from stmc.editing.conditions import Conditions, clean_motions, prepare_kept
from stmc.editing.constraints import Constraint
from stmc.editing.generate_request import Changes, GenerateRequest
from stmc.editing.streaming import EMPTY, MotionStream, stream_defaults
from stmc.motion.body_model import Skeleton
from stmc.motion.motion import Motion
from stmc.motion.representation import JointsFrom, Representation
from stmc.settings.records import SettingError, record_of, with_signature_of
from stmc.text import Remembered, TextEncoder
from stmc.text.text_encoder import Encode
from stmc.text.vocabulary import Recogniser, Recognition, Vocabulary
from stmc.timeline import Timeline, advise_prompt
from stmc.timeline.planning import Plan, plan

Precision = Literal["fp32", "bf16"]


@dataclass(frozen=True, eq=False, repr=False)
class Model:
    """All parts that turn text into motion.

    `fps` is the frame rate of the features, `longest` the largest number of frames in a training crop; `config` tells
    how to rebuild the parts (see `run.save`). `precision` applies to the denoiser at sampling: "bf16" is faster on
    processors that support it, but a motion then depends slightly on its batch; the last step always runs in fp32,
    since rounding there would add jitter. `sampling` holds the model's default settings. `vocabulary` describes the
    training texts; with it, `generate` warns of prompts that are far from all of them. In memory, any functions with
    the signatures of a `Denoiser` and of `TextEncoder.encode` can take their place.

    Examples:
        >>> model = stmc.load()
        >>> model.fps, model.schedule.steps, model.representation.width
        (20, 100, 205)
    """

    denoiser: Denoiser
    schedule: Schedule
    text_encoder: TextEncoder | Encode
    representation: Representation
    motion_statistics: Statistics
    text_statistics: Statistics
    skeleton: Skeleton
    fps: float | int
    longest: int
    prediction: Prediction = "x0"
    config: Mapping[str, Any] = field(default_factory=dict)
    precision: Precision = "fp32"
    sampling: Sampling = Sampling()
    vocabulary: Vocabulary | None = None

    def __repr__(self) -> str:
        weights = sum(parameter.numel() for parameter in self.network.parameters())
        encoder, representation = (type(part).__name__ for part in (self.text_encoder, self.representation))
        return (
            f"Model(\n  {self.network.name} of {weights:,} weights, {self.precision} on {self.device},\n"
            f"  {encoder} → {self.prediction} of {representation}, {self.representation.width} features,\n"
            f"  {self.schedule.steps} steps, crops of up to {self.longest} frames, {self.fps:g} a second,\n"
            f"  {self.own_sampling}\n)"
        )

    @cached_property
    def network(self) -> Network:
        """The denoiser in the form that sampling uses; see `as_network`."""
        return as_network(self.denoiser)

    @cached_property
    def _recognise(self) -> Recogniser:
        return Recogniser(self.vocabulary, self.text_encoder)

    @property
    def device(self) -> torch.device:
        """The device of the denoiser; the CPU if it has no weights."""
        return next((parameter.device for parameter in self.network.parameters()), torch.device("cpu"))

    @property
    def own_sampling(self) -> Sampling:
        """The default of every setting; None if the setting does not apply to the model."""
        steps, absolute_from = self.schedule.steps, self.network.absolute_from
        ape_steps = None if absolute_from is None else round(max(0.0, 1 - absolute_from / steps), 6)
        defaults = self.sampling.with_defaults(DEFAULT).with_defaults(Sampling(steps=steps, ape_steps=ape_steps))
        return defaults if ape_steps is not None else replace(defaults, ape_steps=None)

    def to(self, device: torch.device | str) -> Model:
        """Return the model on another device. The denoiser is moved, not copied; a plain function stays as it is.

        Examples:
            >>> stmc.load().to("cpu").device
            device(type='cpu')
        """
        return replace(self, denoiser=self.denoiser.to(device)) if hasattr(self.denoiser, "to") else self

    def plans(self, timelines: Sequence[Timeline], overlap: float | int | None = None) -> list[Plan]:
        """Plan timelines in this model's frames. `overlap` is in seconds, 2 l in the paper; None: the model's default.

        Examples:
            >>> [plan] = stmc.load().plans([stmc.Timeline.parse("walk # 0 # 1\\njump # 1 # 2")], overlap=0.5)
            >>> [(crop.text, crop.frames) for crop in plan.crops]
            [('walk', 25), ('jump', 25), (None, 10)]
        """
        frames = self._frames((self.own_sampling.overlap if overlap is None else overlap) or 0.0)
        one_shot = self._one_shot_texts(timelines)
        return [plan(timeline, self.fps, frames, self.longest, one_shot) for timeline in timelines]

    def embed(self, texts: Sequence[str]) -> dict[str, Float[Tensor, "words width"]]:
        """Return the normalised embedding of each distinct text.

        Examples:
            >>> embeddings = stmc.load().embed(["walk", "jump", "walk"])
            >>> [(text, words.shape[-1]) for text, words in embeddings.items()]
            [('walk', 384), ('jump', 384)]
        """
        distinct = list(dict.fromkeys(texts))
        encode = self.text_encoder.encode if hasattr(self.text_encoder, "encode") else self.text_encoder
        words, lengths = encode(distinct)
        words = self.text_statistics.normalise(words.float().cpu())
        return {text: row[:length] for text, row, length in zip(distinct, words, lengths.tolist(), strict=True)}

    def recognise(self, texts: Sequence[str]) -> list[Recognition]:
        """Tell which texts are in the model's vocabulary, each with its nearest training sentences. Empty if the model
        has no vocabulary, or if MiniLM, which compares the texts, is not available.

        Examples:
            >>> walk, swim = stmc.load().recognise(["stroll along", "swim"])
            >>> walk.known, swim.known
            (True, False)
        """
        return self._recognise(texts)

    def doubtful(self, timelines: Sequence[Timeline]) -> list[Recognition]:
        """Return the prompts that are out of vocabulary or rarely visible in motions, each text once; see `advice`.

        Examples:
            >>> [prompt] = stmc.load().doubtful([stmc.Timeline.parse("walk # 0 # 4\\nswim # 4 # 6")])
            >>> prompt.text
            'swim'
        """
        texts = [prompt.text for timeline in timelines for prompt in timeline.prompts]
        return [recognition for recognition in self.recognise(texts) if not recognition.works]

    def _one_shot_texts(self, timelines: Sequence[Timeline]) -> frozenset[str]:
        return one_shot_texts(timelines, self._recognise, self.longest / self.fps)

    def guided(
        self,
        plans: Sequence[Plan],
        guidance: float | int | None = None,
        ape_steps: float | int | None = None,
        needed: Sequence[bool] | None = None,
    ) -> Guided:
        """Return a predictor of the plans' crops with classifier-free guidance; see `composing.guided_crops`.

        Args:
            plans: Plans whose crops are denoised.
            guidance: Weight of the texts; None: the model's default.
            ape_steps: As in `Sampling`.
            needed: Whether each crop is needed; None: all are.

        Examples:
            >>> model = stmc.load()
            >>> model.guided(model.plans([stmc.Timeline.parse("walk # 0 # 1")]), guidance=2.5)
            Guided(1 rows of up to 20 frames, guidance 2.5, 0.0% padding)
        """
        network, arguments = self.network, self._arguments(plans, guidance, ape_steps)
        return guided_crops(
            *arguments, supports_padding=network.supports_padding, fixed_length=network.fixed_length, needed=needed
        )

    def guided_sequences(
        self, plans: Sequence[Plan], guidance: float | int | None = None, ape_steps: float | int | None = None
    ) -> Guided:
        """Return a predictor of whole sequences with guidance, for a denoiser with a text for every frame.

        Args:
            plans: Plans without overlap.
            guidance: As in `guided`.
            ape_steps: As in `Sampling`.

        Examples:
            >>> model = stmc.load("flow_mdm_wide")
            >>> model.guided_sequences(model.plans([stmc.Timeline.parse("walk # 0 # 1")], overlap=0), guidance=2.5)
            Guided(1 rows of up to 20 frames, guidance 2.5, 0.0% padding)
        """
        self.network.require_per_frame_text()
        return guided_sequences(*self._arguments(plans, guidance, ape_steps))

    @with_signature_of(Sampling)
    def settings(self, method: str | Method | Rule = "stmc", **settings: Unpack[SamplingArguments]) -> Sampling:
        """Resolve the settings of `generate`: open ones take the method's or the model's default; None: not applicable.
        Raises `SettingError` as `generate` does.

        Examples:
            >>> settings = stmc.load().settings("sinc", steps=50)
            >>> settings.steps, settings.overlap
            (50, None)
        """
        return self._resolve(record_of(Sampling, settings), find_method(method))

    def _resolve(self, requested: Sampling, method: Method) -> Sampling:
        resolved = resolve_settings(requested, method, self.own_sampling)
        check_settings(requested, resolved, method)
        if resolved.steps is not None and resolved.steps > self.schedule.steps:
            raise SettingError(f"steps={resolved.steps}: must be at most {self.schedule.steps}, as many as in training")
        self._frames(resolved.overlap or 0.0)
        return resolved

    @with_signature_of(Sampling)
    def generate(
        self,
        timelines: str | Timeline | Sequence[str | Timeline],
        seed: int | Iterable[int] = 0,
        method: str | Method | Rule = "stmc",
        progress: Progress | None = None,
        joints_from: JointsFrom = "skeleton",
        keep: Motion | Sequence[Motion] | None = None,
        change: Changes = (),
        constraints: Sequence[Constraint] = (),
        clean_feet: bool = True,
        **settings: Unpack[SamplingArguments],
    ) -> list[Motion]:
        """Generate one motion per timeline, of its duration, at the model's frame rate, on the model's skeleton.

        Args:
            timelines: One or several timelines, each a `Timeline` or the text of a file; see `Timeline.parse`.
            seed: One seed per timeline, or the first of consecutive seeds. A motion depends on its own seed alone.
            method: A name of `composing.METHODS`, a `Method`, or a rule `Plan → Plan`. "stmc" stitches crops at every
                step, cross-faded; "stmc_paper" is the paper's algorithm to the letter (section 3.3), "sinc",
                "sinc_lerp", "single_track" and "one_text" its baselines (section 4.3); "multi_diffusion",
                "double_take", "sinc_slerp", "teach_b", "teach" and "flow_mdm" are other ways to compose in time.
            progress: Wraps the denoising steps of each phase, `progress(steps, total=100)`, e.g. `tqdm`.
            joints_from: See `decode`.
            keep: A motion, generated or recorded, to keep except for `change` and for frames after its end; one for
                all timelines, or one per timeline.
            change: `Change`s (seconds, body parts) or prompts of the timeline to regenerate in `keep`.
            constraints: Paths, headings, keyframes, hands and feet, for all timelines; see `stmc.editing.constraints`.
            clean_feet: Keep standing feet in place and above the floor, as `stmc.clean_feet` does; kept motion stays,
                and constraints hold. False: the motion as sampled, which evaluations measure.
            **settings: Fields of `Sampling`; an omitted one takes the method's or the model's default.

        Raises:
            SettingError: If a setting is invalid, or does not exist for the method, the sampler or the model.
            TimelineError: If a timeline cannot be read or planned.

        Warns:
            PromptWarning: For each text of `doubtful`, an `UnknownPromptWarning` or a `RarelyShownWarning`.

        Examples:
            >>> model = stmc.load()
            >>> model.generate("run # 0 # 2 # legs\\nraise the right arm # 0.5 # 1.5 # right arm", seed=1, steps=2)
            [Motion(40 frames at 20 fps, 2.00 s)]
        """
        values: dict[str, Any] = {"timelines": timelines, "seeds": seed, "method": method, "joints_from": joints_from}
        values |= {"keep": keep, "change": change, "constraints": constraints, "clean_feet": clean_feet}
        return self.sample(GenerateRequest.read(values | settings), progress)

    def check(self, request: GenerateRequest) -> Sampling:
        """Resolve the settings of a request. Raises `SettingError` if this model cannot sample it.

        Examples:
            >>> stmc.load().check(stmc.GenerateRequest.read({"timelines": "walk # 0 # 1"})).steps
            100
        """
        method = request.resolved_method
        if method.per_frame_text:
            self.network.require_per_frame_text()
        return self._resolve(request.sampling, method)

    @torch.inference_mode()
    def sample(self, request: GenerateRequest, progress: Progress | None = None) -> list[Motion]:
        """Sample the motions of a request, as `generate` does; programs can store, send and compare requests.

        Examples:
            >>> request = stmc.GenerateRequest.read({"timelines": ["walk # 0 # 1", "run # 0 # 2"], "steps": 2})
            >>> stmc.load().sample(request)
            [Motion(20 frames at 20 fps, 1.00 s), Motion(40 frames at 20 fps, 2.00 s)]
        """
        sampling, method, timelines = self.check(request), request.resolved_method, request.timelines
        if not timelines:
            return []
        for prompt in self.doubtful(timelines):
            advise_prompt(prompt.advice, prompt.known)
        timelines = in_own_words(timelines, self._recognise, sampling.restate_from)
        if method.baseline:
            timelines = tuple(method.baseline(timeline, self.fps, self.longest) for timeline in timelines)
        frames = [timeline.frames(self.fps) for timeline in timelines]
        kept = prepare_kept(request, frames, self.skeleton, self.fps)
        run = self._run(timelines, request.seeds, sampling, progress or (lambda steps, total: steps))
        if kept or request.constraints:
            parts = (self.representation, self.motion_statistics, self.skeleton, self.fps)
            conditions = Conditions(*parts, frames, kept, request.constraints)
            motions = conditions.sample(method.sample, run, request.joints_from)
        else:
            motions = self.decode(method.sample(run), frames, request.joints_from)
        motions = clean_motions(motions, kept, request.constraints) if request.clean_feet else motions
        return [replace(motion, overlap=sampling.overlap or 0.0) for motion in motions]

    @with_signature_of(Sampling)
    def stream(self, timeline: str | Timeline = EMPTY, seed: int = 0, **settings: Any) -> MotionStream:
        """Stream the frames of a timeline without end, which may be edited while it plays; see `MotionStream`.

        Args:
            timeline: Timeline to begin with, or its text.
            seed: Seed of the stream.
            **settings: `method`, `clean_feet` and fields of `Sampling`, as in `generate`; by default `stream_defaults`.

        Examples:
            >>> stmc.load().stream("walk # 0 # 4", steps=1).take(30)
            Motion(30 frames at 20 fps, 1.50 s)
        """
        request = GenerateRequest.read(stream_defaults(self.sampling) | settings | dict(timelines=timeline, seeds=seed))
        model, sampling = replace(self, text_encoder=Remembered(self.text_encoder)), self.check(request)
        run = model._run((), request.seeds, sampling, lambda steps, total: steps)
        read = partial(in_own_words, recogniser=self._recognise, confidence=sampling.restate_from)
        return MotionStream(run, request, self.skeleton, self.representation, read, self._one_shot_texts)

    def decode(
        self,
        features: Float[Tensor, "batch frames features"],
        lengths: Sequence[int],
        joints_from: JointsFrom = "skeleton",
    ) -> list[Motion]:
        """Decode a batch of normalised features to motions on the CPU.

        Args:
            features: Normalised features.
            lengths: Number of frames of each motion.
            joints_from: "skeleton" poses the model's skeleton, whose bones keep their lengths; "features" reads the
                positions in the features (HumanML3D: as `recover_from_ric`), the source of STMC's tables.

        Examples:
            >>> stmc.load().decode(torch.zeros(2, 40, 205), lengths=[20, 40])
            [Motion(20 frames at 20 fps, 1.00 s), Motion(40 frames at 20 fps, 2.00 s)]
        """
        decode = partial(self.representation.decode, skeleton=self.skeleton if joints_from == "skeleton" else None)
        rows = self.motion_statistics.restore(features.float().cpu())
        return [decode(row[:length], self.fps) for row, length in zip(rows, lengths, strict=True)]

    def _run(self, timelines: Sequence[Timeline], seeds: Sequence[int], sampling: Sampling, progress: Progress) -> Run:
        self.network.eval()
        return Run(
            timelines=timelines, seeds=seeds, sampling=sampling, progress=progress, device=self.device, fps=self.fps,
            schedule=self.schedule, layout=self.representation.layout, statistics=self.motion_statistics,
            longest=self.longest, overlap=self._frames(sampling.overlap or 0.0), fixed_length=self.network.fixed_length,
            one_shot=self._one_shot_texts(timelines), guided=partial(self.guided, ape_steps=sampling.ape_steps),
            guided_sequences=partial(self.guided_sequences, ape_steps=sampling.ape_steps),
        )  # fmt: skip

    def _frames(self, overlap: float | int) -> int:
        """Convert an overlap from seconds to frames. Raises `SettingError` if no crop can hold it."""
        if not 0 <= overlap * self.fps < self.longest:
            limit = self.longest / self.fps
            raise SettingError(f"overlap={overlap}: must be at least 0 and below {limit:g} s, the model's longest crop")
        return int(overlap * self.fps)

    def _arguments(
        self, plans: Sequence[Plan], guidance: float | int | None, ape_steps: float | int | None
    ) -> tuple[Callable[..., Tensor], Schedule, Sequence[Plan], dict[str, Tensor], float | int, Prediction]:
        """Return the arguments that predictors of crops and of sequences share."""
        guidance = self.own_sampling.guidance if guidance is None else guidance
        assert guidance is not None  # a model has a default of every setting that applies
        start = None if ape_steps is None else round((1 - ape_steps) * self.schedule.steps)
        denoise = self._denoise if start is None else partial(self._denoise, absolute_from=start)
        return denoise, self.schedule, plans, self._encode(plans), guidance, self.prediction

    def _encode(self, plans: Sequence[Plan]) -> dict[str, Float[Tensor, "words encoded"]]:
        with self._autocast(self.precision == "bf16"):
            texts = self.embed(distinct_texts(plans)).items()
            return {text: self.network.encode_text(words[None].to(self.device))[0].float() for text, words in texts}

    def _denoise(self, x: Tensor, t: Tensor, *others: Any, **settings: Any) -> Tensor:
        """Run the network, the last step in fp32: only its rounding remains, which in bf16 adds two fifths of jerk."""
        last = self.schedule.spaced(self.sampling.steps)[0]
        with self._autocast(self.precision == "bf16" and bool((t > last).any())):
            return self.network.denoise(x, t, *others, **settings)

    def _autocast(self, half: bool) -> torch.autocast:
        return torch.autocast(self.device.type, torch.bfloat16, enabled=half)
