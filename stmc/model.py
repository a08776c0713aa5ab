"""A trained model as one record, and the way from timelines to motions through it.

`Model` bundles what belongs together (denoiser, schedule, text encoder, representation, statistics, skeleton); the
steps of `generate` are the library's own functions, each of which can be used alone.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any, Literal, Unpack

import torch
from jaxtyping import Float
from torch import Tensor

from stmc.composing import Method, Progress, Rule, Run, distinct_texts, find_method, guided_crops, guided_sequences
from stmc.composing.batching import Guided
from stmc.composing.methods import refuse, settled
from stmc.composing.sampling import DEFAULT, Sampling, SamplingArguments
from stmc.denoisers import Denoiser, Network, as_network
from stmc.diffusion import Prediction, Schedule
from stmc.diffusion.statistics import Statistics
from stmc.editing.conditions import Conditions, cleaned, kept_of
from stmc.editing.constraints import Constraint
from stmc.editing.generate_request import Changes, GenerateRequest
from stmc.motion.body_model import Skeleton
from stmc.motion.motion import Motion
from stmc.motion.representation import JointsFrom, Representation
from stmc.settings.records import SettingError, record_of, takes
from stmc.text import TextEncoder
from stmc.text.vocabulary import Recogniser, Recognition, Vocabulary
from stmc.timeline import RarelyShownWarning, Timeline, UnknownPromptWarning, advise
from stmc.timeline.planning import Plan, plan

Precision = Literal["fp32", "bf16"]

Encode = Callable[[Sequence[str]], tuple[Tensor, Tensor]]
"""What a `TextEncoder` does: texts → their words and how many each has."""


@dataclass(frozen=True, eq=False, repr=False)
class Model:
    """Everything that makes motion from text. `fps` is the frame rate of the features, `longest` the most frames that
    the denoiser knows from training; `config` says how to build the parts again (see `run.save`). `precision` is the
    denoiser's at sampling: "bf16" is faster where the processor has it, but a motion then depends on its batch, a bit.
    With either, the step at t = 0 is in fp32, since its rounding would make the motion tremble.
    `sampling` is how the model is sampled unless told otherwise. `vocabulary` is what it was trained to hear, where it
    says so: `generate` then warns of prompts that are far from all of it.

    In memory any function with the signature of a `Denoiser` is one, and so is one like `TextEncoder.encode`.

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
        weights = sum(each.numel() for each in self.network.parameters())
        encoder, representation = (type(part).__name__ for part in (self.text_encoder, self.representation))
        return (
            f"Model(\n  {_name(self.denoiser)} of {weights:,} weights, {self.precision} on {self.device},\n"
            f"  {encoder} → {self.prediction} of {representation}, {self.representation.width} features,\n"
            f"  {self.schedule.steps} steps, crops of up to {self.longest} frames, {self.fps:g} a second,\n"
            f"  {self.own_sampling}\n)"
        )

    @cached_property
    def network(self) -> Network:
        """The denoiser as sampling uses it: see `as_network`."""
        return as_network(self.denoiser)

    @cached_property
    def _recognise(self) -> Recogniser:
        return Recogniser(self.vocabulary, self.text_encoder)

    @property
    def device(self) -> torch.device:
        """Where the denoiser is; the CPU where it has no weights."""
        return next((each.device for each in self.network.parameters()), torch.device("cpu"))

    @property
    def own_sampling(self) -> Sampling:
        """Every setting as it is unless told otherwise; None: the model has no such thing."""
        steps, absolute_from = self.schedule.steps, self.network.absolute_from
        ape_steps = None if absolute_from is None else round(max(0.0, 1 - absolute_from / steps), 6)
        own = self.sampling.over(DEFAULT).over(Sampling(steps=steps, ape_steps=ape_steps))
        return own if ape_steps is not None else dataclasses.replace(own, ape_steps=None)

    def to(self, device: torch.device | str) -> Model:
        """The model on another device. The denoiser is moved, not copied; one without weights stays as it is.

        Examples:
            >>> stmc.load().to("cpu").device
            device(type='cpu')
        """
        return dataclasses.replace(self, denoiser=self.denoiser.to(device)) if hasattr(self.denoiser, "to") else self

    def plans(self, timelines: Sequence[Timeline], overlap: float | int | None = None) -> list[Plan]:
        """The layouts of timelines in this model's frames; `overlap` in seconds, 2 l in the paper (None: the model's
        own).

        Examples:
            >>> [plan] = stmc.load().plans([stmc.Timeline.parse("walk # 0 # 1\\njump # 1 # 2")], overlap=0.5)
            >>> [(crop.text, crop.frames) for crop in plan.crops]
            [('walk', 25), ('jump', 25), (None, 10)]
        """
        frames = self._frames(self.own_sampling.overlap if overlap is None else overlap)
        once = self._once(timelines)
        return [plan(timeline, self.fps, frames, self.longest, once) for timeline in timelines]

    def embed(self, texts: Sequence[str]) -> dict[str, Float[Tensor, "words width"]]:
        """Normalised embeddings, each text encoded once.

        Examples:
            >>> embeddings = stmc.load().embed(["walk", "jump", "walk"])
            >>> [(text, words.shape[-1]) for text, words in embeddings.items()]
            [('walk', 384), ('jump', 384)]
        """
        distinct = list(dict.fromkeys(texts))
        words, lengths = getattr(self.text_encoder, "encode", self.text_encoder)(distinct)
        words = self.text_statistics.normalise(words.float().cpu())
        return {text: row[:length] for text, row, length in zip(distinct, words, lengths.tolist(), strict=True)}

    def recognise(self, texts: Sequence[str]) -> list[Recognition]:
        """Which texts the model knows, each with the nearest sentences of its training; none of a model that does not
        say what it was trained with, or where MiniLM, by which texts are compared, cannot be had.

        Examples:
            >>> walk, swim = stmc.load().recognise(["stroll along", "swim"])
            >>> walk.known, swim.known
            (True, False)
        """
        return self._recognise(texts)

    def doubtful(self, timelines: Sequence[Timeline]) -> list[Recognition]:
        """The prompts of timelines that the model hardly knows, or rarely shows, each text once: see `advice`.

        Examples:
            >>> [prompt] = stmc.load().doubtful([stmc.Timeline.parse("walk # 0 # 4\\nswim # 4 # 6")])
            >>> prompt.text
            'swim'
        """
        texts = [prompt.text for timeline in timelines for prompt in timeline.prompts]
        return [each for each in self.recognise(texts) if not each.works]

    def _once(self, timelines: Sequence[Timeline]) -> frozenset[str]:
        """Texts of prompts that are too long for one crop and tell of what happens once, as far as the model knows."""
        prompts = (prompt for timeline in timelines for prompt in timeline.prompts)
        long = [prompt.text for prompt in prompts if (prompt.end - prompt.start) * self.fps > self.longest]
        return frozenset(each.text for each in self.recognise(long) if each.happens_once)

    def guided(
        self,
        plans: Sequence[Plan],
        guidance: float | int | None = None,
        ape_steps: float | int | None = None,
        needed: Sequence[bool] | None = None,
    ) -> Guided:
        """A predictor of the plans' crops, or of those `needed`, with classifier-free guidance (None: the model's own):
        see `composing.guided_crops`. `ape_steps`: as of `Sampling`.

        Examples:
            >>> model = stmc.load()
            >>> model.guided(model.plans([stmc.Timeline.parse("walk # 0 # 1")]), guidance=2.5)
            Guided(1 rows of up to 20 frames, guidance 2.5, 0.0% padding)
        """
        return guided_crops(
            *self._asked(plans, guidance, ape_steps),
            supports_padding=self.network.supports_padding,
            fixed_length=self.network.fixed_length,
            needed=needed,
        )

    def guided_sequences(
        self, plans: Sequence[Plan], guidance: float | int | None = None, ape_steps: float | int | None = None
    ) -> Guided:
        """A predictor of the body sequences of plans without overlap, with guidance: see
        `composing.guided_sequences`. Raises `SettingError` for a denoiser that knows one text only.

        Examples:
            >>> model = stmc.load("flow_mdm_wide")
            >>> model.guided_sequences(model.plans([stmc.Timeline.parse("walk # 0 # 1")], overlap=0), guidance=2.5)
            Guided(1 rows of up to 20 frames, guidance 2.5, 0.0% padding)
        """
        self._check_text(True)
        return guided_sequences(*self._asked(plans, guidance, ape_steps))

    @takes(Sampling)
    def settings(self, method: str | Method | Rule = "stmc", **settings: Unpack[SamplingArguments]) -> Sampling:
        """What `generate` samples with when it is given these: the method's and the model's own where they are open,
        None for what does not apply. Raises `SettingError` as `generate` does.

        Examples:
            >>> settings = stmc.load().settings("sinc", steps=50)
            >>> settings.steps, settings.overlap
            (50, None)
        """
        asked, method, own = record_of(Sampling, settings), find_method(method), self.own_sampling
        refuse(asked, method, own)
        found = settled(asked, method, own)
        if found.steps > self.schedule.steps:
            raise SettingError(f"steps={found.steps}: must be at most {self.schedule.steps}, as many as in training")
        self._frames(found.overlap or 0.0)
        return found

    @takes(Sampling)
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
        """One motion for each timeline, of its duration, at the model's frame rate, on the model's skeleton.

        Args:
            timelines: One or several, each also as the text of a file: see `Timeline.parse`.
            seed: One for each timeline, or the first of consecutive ones; a motion depends on its own alone.
            method: A name of `composing.METHODS`, a `Method`, or a rule `Plan → Plan`. "stmc" stitches crops at every
                step, cross-faded; "stmc_paper" is the paper's algorithm to the letter (section 3.3), "sinc",
                "sinc_lerp", "single_track" and "one_text" its baselines (section 4.3); "multi_diffusion",
                "double_take", "sinc_slerp", "teach_b", "teach" and "flow_mdm" are other ways to compose in time.
            progress: Wraps the denoising steps of each phase, `progress(steps, total=100)`, e.g. `tqdm`.
            joints_from: See `decode`.
            keep: A motion, generated or recorded, that the result is but for the `change` and what the timeline has
                behind its end; one for all timelines, or one for each.
            change: `Change`s (seconds, body parts) or prompts of the timeline to regenerate in it.
            constraints: Paths, headings, keyframes, hands and feet, for all timelines: see `stmc.editing.constraints`.
            clean_feet: Keep standing feet in place and above the floor, as `stmc.clean_feet` does; kept motion stays,
                and constraints hold. False: the motion as sampled, which is what an evaluation measures.
            settings: Those of `Sampling`; what is not said is the method's or the model's own.

        Raises:
            SettingError: For settings that do not fit, or that the method, the sampler or the model does not have.
            TimelineError: For a timeline that cannot be read or planned.

        Warns:
            PromptWarning: One for each text of `doubtful`: an `UnknownPromptWarning` or a `RarelyShownWarning`.

        Examples:
            >>> model = stmc.load()
            >>> model.generate("run # 0 # 2 # legs\\nraise the right arm # 0.5 # 1.5 # right arm", seed=1, steps=2)
            [Motion(40 frames at 20 fps, 2.00 s)]
        """
        own = {"method": method, "joints_from": joints_from, "keep": keep, "change": change, "constraints": constraints}
        own |= {"timelines": timelines, "seeds": seed, "clean_feet": clean_feet}
        return self.sample(GenerateRequest.read(own | settings), progress)

    def check(self, request: GenerateRequest) -> Sampling:
        """The settings that a request is sampled with. Raises `SettingError` for what this model cannot do.

        Examples:
            >>> stmc.load().check(stmc.GenerateRequest.read({"timelines": "walk # 0 # 1"})).steps
            100
        """
        method = request.resolved_method
        self._check_text(method.per_frame_text)
        return self.settings(method, **request.sampling.given)

    @torch.inference_mode()
    def sample(self, request: GenerateRequest, progress: Progress | None = None) -> list[Motion]:
        """The motions of a request, as `generate` makes them: a record for programs that keep, send or compare what
        they ask for.

        Examples:
            >>> request = stmc.GenerateRequest.read({"timelines": ["walk # 0 # 1", "run # 0 # 2"], "steps": 2})
            >>> stmc.load().sample(request)
            [Motion(20 frames at 20 fps, 1.00 s), Motion(40 frames at 20 fps, 2.00 s)]
        """
        sampling, method, timelines = self.check(request), request.resolved_method, request.timelines
        if not timelines:
            return []
        for prompt in self.doubtful(timelines):
            advise(prompt.advice, RarelyShownWarning if prompt.known else UnknownPromptWarning)
        if method.baseline:
            timelines = [method.baseline(timeline, self.fps, self.longest) for timeline in timelines]
        frames = [timeline.frames(self.fps) for timeline in timelines]
        kept = kept_of(request, frames, self.skeleton, self.fps)
        self.network.eval()
        run = self._run(timelines, request.seeds, sampling, progress or _silent)
        if kept or request.constraints:
            parts = (self.representation, self.motion_statistics, self.skeleton, self.fps)
            conditions = Conditions(*parts, frames, kept, request.constraints)
            motions = conditions.sampled(method.sample, run, request.joints_from)
        else:
            motions = self.decode(method.sample(run), frames, request.joints_from)
        motions = cleaned(motions, kept, request.constraints) if request.clean_feet else motions
        return [dataclasses.replace(motion, overlap=sampling.overlap or 0.0) for motion in motions]

    def decode(
        self,
        features: Float[Tensor, "batch frames features"],
        lengths: Sequence[int],
        joints_from: JointsFrom = "skeleton",
    ) -> list[Motion]:
        """Motions on the CPU from a batch of normalised features, each of its own length.

        Joints are those of the model's "skeleton", whose bones keep their lengths; or the positions that are part of
        the "features" (of HumanML3D's, what `recover_from_ric` gives), which STMC's tables were made from.

        Examples:
            >>> stmc.load().decode(torch.zeros(2, 40, 205), lengths=[20, 40])
            [Motion(20 frames at 20 fps, 1.00 s), Motion(40 frames at 20 fps, 2.00 s)]
        """
        skeleton = self.skeleton if joints_from == "skeleton" else None
        raw = self.motion_statistics.restore(features.float().cpu())
        return [
            self.representation.decode(row[:length], self.fps, skeleton)
            for row, length in zip(raw, lengths, strict=True)
        ]

    def _run(self, timelines: Sequence[Timeline], seeds: Sequence[int], sampling: Sampling, progress: Progress) -> Run:
        return Run(
            timelines=timelines,
            seeds=seeds,
            sampling=sampling,
            schedule=self.schedule,
            fps=self.fps,
            longest=self.longest,
            once=self._once(timelines),
            overlap=self._frames(sampling.overlap or 0.0),
            layout=self.representation.layout,
            statistics=self.motion_statistics,
            guided=partial(self.guided, ape_steps=sampling.ape_steps),
            guided_sequences=partial(self.guided_sequences, ape_steps=sampling.ape_steps),
            fixed_length=self.network.fixed_length,
            device=self.device,
            progress=progress,
        )

    def _frames(self, overlap: float | int) -> int:
        """Of seconds. Raises `SettingError` for a transition that no crop could hold."""
        if not 0 <= overlap * self.fps < self.longest:
            most = self.longest / self.fps
            raise SettingError(f"overlap={overlap}: must be at least 0 and below {most:g} s, the model's longest crop")
        return int(overlap * self.fps)

    def _asked(self, plans: Sequence[Plan], guidance: float | int | None, ape_steps: float | int | None) -> tuple:
        """What predictors are made of, crops' and sequences' alike."""
        guidance = self.own_sampling.guidance if guidance is None else guidance
        own = {} if ape_steps is None else {"absolute_from": round((1 - ape_steps) * self.schedule.steps)}
        return partial(self._denoise, **own), self.schedule, plans, self._encode(plans), guidance, self.prediction

    def _encode(self, plans: Sequence[Plan]) -> dict[str, Float[Tensor, "words encoded"]]:
        with self._autocast(self.precision == "bf16"):
            embeddings = self.embed(distinct_texts(plans)).items()
            return {
                text: self.network.encode_text(words[None].to(self.device))[0].float() for text, words in embeddings
            }

    def _denoise(self, x: Tensor, t: Tensor, *others: Tensor | None, **settings: int) -> Tensor:
        """Run the network, at t = 0 in fp32. Later steps remove the rounding of earlier ones, so only the rounding of
        the last step remains; with bf16 it adds about two fifths to the mean jerk, a part of it in each layer."""
        with self._autocast(self.precision == "bf16" and not bool((t == 0).all())):
            return self.network.denoise(x, t, *others, **settings)

    def _autocast(self, half: bool) -> torch.autocast:
        return torch.autocast(self.device.type, torch.bfloat16, enabled=half)

    def _check_text(self, per_frame: bool) -> None:
        if per_frame and not self.network.per_frame_text:
            raise SettingError(
                f"{_name(self.denoiser)} knows one text for all frames; sequences of several texts "
                "need a denoiser with per_frame_text, such as FlowMdm"
            )


def _name(denoiser: Denoiser) -> str:
    return getattr(denoiser, "__name__", type(denoiser).__name__)


def _silent(steps: Iterable[Any], total: int) -> Iterable[Any]:
    return steps
