"""Methods as values: functions that turn timelines into features.

A method is a function of a `Run`; `stitched` builds one from any rule `Plan → Plan`. `METHODS` holds the method of this
library and the baselines. Depends on plans, predictors and schedules; independent of networks and of `Model`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import import_module
from types import MappingProxyType
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from stmc.composing.double_take import first_take_weights
from stmc.composing.inpainting import inpaint
from stmc.composing.interpolation import slerp, smooth_seams
from stmc.composing.retiming import time_warp
from stmc.composing.running import Run, settings_taken
from stmc.composing.sampling import INDEPENDENT, Sampling
from stmc.composing.sequences import compose_tracks
from stmc.diffusion import SAMPLERS, Predict
from stmc.diffusion.tensors import mask
from stmc.settings.records import SettingError, quote
from stmc.timeline import Timeline, one_text, single_track
from stmc.timeline.planning import Plan, cross_fade, handshake, look_back, multi_diffusion, second_take

Features = Float[Tensor, "batch frames features"]
Rule = Callable[[Plan], Plan]
Baseline = Callable[[Timeline, "float | int", int], Timeline]
"""(timeline, frames per second, frames of the longest crop) → the timeline that is sampled instead."""
SECOND_TAKE_SKIP = 0.1
"""Fraction of the steps, the noisiest, that DoubleTake's second take skips (Shafir et al. 2024)."""
TEACH_CONTEXT_SECONDS = 5 / 30
"""TEACH's context in seconds: five frames at 30 fps (Athanasiou et al. 2022). The prompt also covers the context, so a
longer context shortens the action itself."""


@dataclass(frozen=True, eq=False)
class Method:
    """A method that turns timelines into features.

    Args:
        sample: Function from a `Run` to normalised features [batch, frames, features], each timeline from its first
            frame on.
        label: Name of the method in tables.
        baseline: Function that replaces each timeline beforehand.
        fixed: Settings that the method fixes, whatever the model's defaults; None means that the method has no such
            setting.
        per_frame_text: Whether the method needs a denoiser with a text for every frame.
        tracks: "Single" or "Multi": the tracks of a timeline that the method uses.
        crops: "Single", "Multi" or "None": the crops of a timeline that the method uses.

    Examples:
        >>> still = stmc.Method(lambda run: torch.zeros(1, 20, 205), "Still")
        >>> stmc.load().generate("walk # 0 # 1", method=still)
        [Motion(20 frames at 20 fps, 1.00 s)]
    """

    sample: Callable[[Run], Features]
    label: str
    baseline: Baseline | None = None
    fixed: Mapping[str, Any] = field(default_factory=dict)
    per_frame_text: bool = False
    tracks: str = "Multi"
    crops: str = "Multi"

    def __post_init__(self) -> None:
        object.__setattr__(self, "fixed", MappingProxyType(dict(self.fixed)))

    @property
    def stitches(self) -> bool:
        """Whether the method composes at every step, from a configurable or fixed step on."""
        return self.fixed.get("stitch_from", 0.0) is not None


def stitched(rule: Rule | None = None, baseline: Baseline | None = None, label: str = "", **more: Any) -> Method:
    r"""Build a method that stitches crops at every step (STMC, section 3.3), according to a rule.

    Stitching starts at the setting `stitch_from`; before it, crops are denoised independently (outlook of section 4.6).

        model.generate(timeline, method=stmc.stitched(my_rule), stitch_from=0.2)

    Args:
        rule: Function from the usual plan to the plan to follow; None keeps the usual plan.
        baseline: Function that replaces each timeline beforehand.
        label: Name of the method in tables; defaults to the name of the rule.
        **more: Further arguments of `Method`.

    Examples:
        >>> method = stmc.stitched(stmc.timeline.planning.cross_fade, label="Cross-faded")
        >>> stmc.load().generate("walk # 0 # 1\njump # 1 # 2", method=method, stitch_from=0.5, steps=2)
        [Motion(40 frames at 20 fps, 2.00 s)]
    """

    def sample(run: Run) -> Features:
        return stitch(run, [plan if rule is None else _apply_rule(rule, plan) for plan in run.plans()])

    return Method(sample, label or getattr(rule, "__name__", "stitched"), baseline, **more)


def _apply_rule(rule: Rule, plan: Plan) -> Plan:
    """Apply a rule to a plan. Raises `SettingError` if the result is not a plan."""
    result = rule(plan)
    if not isinstance(result, Plan):
        raise SettingError(
            f"the rule {getattr(rule, '__name__', 'given')} returns a {type(result).__name__} instead of a Plan"
        )
    return result


def cross_faded(run: Run) -> Features:
    """Sample with STMC and cross-faded transitions, in which arms with a long way to go move more slowly."""
    plans = run.plans()
    plans_with_fades = [cross_fade(plan) for plan in plans]
    return stitch(run, plans_with_fades, time_warp(run.collage(plans_with_fades), plans, run.layout, run.statistics))


def stitch(run: Run, plans: Sequence[Plan], predict: Predict | None = None) -> Features:
    """Sample with STMC according to `plans`, from the run's `stitch_from` on.

    Args:
        run: The run.
        plans: Plans to follow.
        predict: Predictor of timelines; None uses the collage of `plans`.
    """
    predict, draw = run.constrained(predict or run.collage(plans)), run.noise(plans)
    independent = run.steps_before(run.sampling.stitch_from)
    if not independent:
        return run.denoise(predict, draw(), draw)
    remaining = len(run.times) - independent
    noise = draw()
    x = run.schedule.q_sample(torch.zeros_like(noise), run.times[remaining - 1], noise)  # the frames after the ends
    crops = run.sample_independent_start(independent)
    inside = mask(torch.tensor([plan.frames for plan in plans]))[..., None].to(crops.device)
    x[:, : crops.shape[1]] = torch.where(inside, crops, x[:, : crops.shape[1]])
    return run.denoise(predict, x, draw, remaining)


def sample_independent_prompts(run: Run) -> Features:
    """Sample the single prompt of every timeline as a separate motion. Raises `ValueError` for several prompts."""
    if several := [timeline for timeline in run.timelines if len(timeline.prompts) != 1]:
        raise ValueError(f"a timeline has {len(several[0].prompts)} prompts; this method needs one prompt per timeline")
    return stitch(run, run.plans())


def sample_sinc_lerp(run: Run) -> Features:
    """Sample with SINC, and interpolate linearly over the overlap wherever a part changes from one crop to another."""
    return smooth_seams(run.independent(), run.plans(0), run.columns, run.overlap)


def sample_sinc_slerp(run: Run) -> Features:
    """Sample with SINC, and interpolate rotations on the sphere.

    On one track this is TEACH's own baseline of independent actions.
    """
    return _interpolate_on_sphere(run, run.independent(), run.plans(0))


def sample_teach_b(run: Run) -> Features:
    """Sample crops one after the other, each with the previous frames as context (TEACH without slerp)."""
    return run.autoregressive(_plans_with_context(run))


def sample_teach(run: Run) -> Features:
    """Sample with TEACH: as `teach_b`, then interpolate rotations on the sphere over the overlap between actions."""
    plans = _plans_with_context(run)
    return _interpolate_on_sphere(run, run.autoregressive(plans), plans)


def _plans_with_context(run: Run) -> list[Plan]:
    """Plan crops that leave room for their context and begin with it."""
    context = min(round(TEACH_CONTEXT_SECONDS * run.fps), run.longest - 1)
    return [look_back(plan, context) for plan in replace(run, longest=run.longest - context).plans(0)]


def _interpolate_on_sphere(run: Run, features: Features, plans: Sequence[Plan]) -> Features:
    return run.statistics.normalise(slerp(run.statistics.restore(features), plans, run.layout, run.overlap))


def sample_flow_mdm(run: Run) -> Features:
    """Sample the prompts of each body part as one sequence, without crops (FlowMDM, here with several tracks)."""
    run = replace(run, fixed_length=None)  # sequences have no fixed length
    plans = run.plans(0)
    draw = run.noise(plans)
    sequences = compose_tracks(run.guided_sequences(plans, run.guidance), plans, run.columns)
    return run.denoise(run.constrained(sequences), draw(), draw)


def sample_double_take(run: Run) -> Features:
    """Sample crops that fade into each other, then regenerate half an overlap on either side of each transition."""
    plans, ramp = run.plans(), run.overlap // 2
    content = stitch(run, [handshake(plan) for plan in plans])
    if not ramp:
        return content
    takes = [second_take(plan, run.longest) for plan in plans]
    weights = first_take_weights(plans, run.columns, ramp).to(content)
    weights = F.pad(weights, (0, 0, 0, content.shape[1] - weights.shape[1]), value=1.0)
    steps = max(1, len(run.times) - int(SECOND_TAKE_SKIP * len(run.times)))
    draw = run.noise(takes, [(seed, 0) for seed in run.seeds])
    x = run.schedule.q_sample(content, run.times[steps - 1], draw())
    return run.denoise(inpaint(run.constrained(run.collage(takes, 0.0)), content, weights), x, draw, steps)


_COMPOSED_FROM_THE_START: Mapping[str, Any] = {"stitch_from": 0.0, "guidance_from": 0.0}
_NOT_COMPOSED: Mapping[str, Any] = {"stitch_from": None, "guidance_from": None}
_WITHOUT_OVERLAP: Mapping[str, Any] = {**_NOT_COMPOSED, "overlap": None}


def _one_track(timeline: Timeline, fps: float | int, longest: int) -> Timeline:
    return single_track(timeline, fps)


METHODS: Mapping[str, Method] = {
    "one_text": stitched(
        baseline=lambda timeline, fps, longest: one_text(timeline, longest / fps),
        label="One text",
        fixed=_WITHOUT_OVERLAP,
        tracks="Single",
        crops="Single",
    ),
    "single_track": stitched(baseline=_one_track, label="DiffCollage", fixed=_COMPOSED_FROM_THE_START, tracks="Single"),
    INDEPENDENT: Method(sample_independent_prompts, "Independent prompts", fixed=_WITHOUT_OVERLAP),
    "sinc": Method(Run.independent, "SINC w/o Lerp", fixed=_WITHOUT_OVERLAP),
    "sinc_lerp": Method(sample_sinc_lerp, "SINC w/ Lerp", fixed=_NOT_COMPOSED),
    "sinc_slerp": Method(sample_sinc_slerp, "SINC w/ Slerp", fixed=_NOT_COMPOSED),
    "teach_b": Method(sample_teach_b, "TEACH_B", _one_track, fixed=_WITHOUT_OVERLAP, tracks="Single"),
    "teach": Method(sample_teach, "TEACH", _one_track, fixed=_NOT_COMPOSED, tracks="Single"),
    "multi_diffusion": stitched(multi_diffusion, label="MultiDiffusion", fixed=_COMPOSED_FROM_THE_START),
    "double_take": Method(sample_double_take, "DoubleTake", fixed=_COMPOSED_FROM_THE_START),
    "stmc_paper": stitched(label="STMC (paper)", fixed=_COMPOSED_FROM_THE_START),
    "stmc": Method(cross_faded, "STMC (cross-faded)"),
    "flow_mdm": Method(sample_flow_mdm, "FlowMDM", fixed=_WITHOUT_OVERLAP, per_frame_text=True, crops="None"),
}
"""The methods of Table 1 in its order, and related methods next to them. "stmc_paper" is the exact algorithm of the
paper: hard edges, composed from the first step on. Its noise scale is that of the model, because publishers differ."""

_RENAMED = {"stmc_soft": "stmc"}


def find_method(method: str | Method | Rule, trusted: Iterable[str] = ()) -> Method:
    """Resolve a method: a name in `METHODS`, a dotted name such as "mylab.rules.mine", a `Method` or a rule.

    A dotted name refers to a `Method` or a rule of a package in `trusted`, because importing it executes its code. A
    rule becomes a method by `stitched`.

    Raises:
        SettingError: If the name is unknown, or the package is not trusted or has no such attribute.

    Examples:
        >>> stmc.find_method("one_text").tracks
        'Single'
    """
    if isinstance(method, str):
        method = METHODS.get(method) or _import_method(method, tuple(trusted))
    if isinstance(method, Method):
        return method
    if not callable(method):
        raise SettingError(f"method={quote(method)}: pass a name, a Method or a rule Plan → Plan")
    return stitched(method)


def _import_method(name: str, trusted: Sequence[str]) -> Any:
    if name in _RENAMED:
        raise SettingError(
            f"method={name}: it is now called {_RENAMED[name]}; stmc_paper has the hard edges of the paper"
        )
    home, _, attribute = name.rpartition(".")
    if not home:
        raise SettingError(f"method={quote(name)}: choose from {', '.join(METHODS)}, or pass a dotted name")
    package = name.partition(".")[0]
    if package not in trusted:
        raise SettingError(f"method={quote(name)}: {quote(package)} is not among the trusted packages")
    try:
        result = getattr(import_module(home), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise SettingError(f"method={quote(name)}: {str(error)[:120]}") from error
    is_defined_there = f"{getattr(result, '__module__', '')}".partition(".")[0] == package
    if callable(result) and not isinstance(result, Method) and not is_defined_there:
        raise SettingError(f"method={quote(name)}: {package} defines no such rule Plan → Plan")
    return result


def resolve_settings(requested: Sampling, method: Method, own: Sampling) -> Sampling:
    """Resolve the settings of a run: those that the method fixes, then the request, then the model's defaults.

    A setting that does not apply to the method, the sampler or the model becomes None.

    Args:
        requested: Requested settings.
        method: The method.
        own: Complete defaults of the model.
    """
    resolved = replace(requested.with_defaults(own), **method.fixed)
    taken = settings_taken(resolved.sampler)
    absent = {name for name in _SAMPLER_SETTINGS if name not in taken} | {
        name for name in requested.given if getattr(own, name) is None and name not in _SAMPLER_SETTINGS
    }
    return replace(resolved, **dict.fromkeys(absent))


def check_settings(requested: Sampling, resolved: Sampling, method: Method) -> None:
    """Raise `SettingError` if a requested setting would be ignored by this method, sampler or model.

    Args:
        requested: Requested settings.
        resolved: The settings of the run; see `resolve_settings`.
        method: The method.
    """
    for name, value in requested.given.items():
        used = getattr(resolved, name)
        if value != used and not (used is None and value == 0):
            raise SettingError(f"{name}={quote(value)}: {_reason(name, used, method)}")


def _reason(name: str, used: Any, method: Method) -> str:
    if name in method.fixed:
        return f"{method.label} has no such setting" if used is None else f"{method.label} fixes it at {used}"
    return f"{'the sampler' if name in _SAMPLER_SETTINGS else 'the model'} has no such setting"


_SAMPLER_SETTINGS = frozenset.union(*(frozenset(settings_taken(name)) for name in SAMPLERS)) & set(
    Sampling.__dataclass_fields__
)
"""Settings that are arguments of samplers."""
