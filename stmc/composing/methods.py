"""Methods as values: how timelines become features.

A method is one function of a `Run`; `stitched` makes one of any rule `Plan → Plan`. `METHODS` names ours and the
baselines. Knows plans, predictors and schedules; knows no networks and no `Model`.
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

from stmc.composing.double_take import kept_shares
from stmc.composing.inpainting import inpaint
from stmc.composing.interpolation import slerp, smooth_seams
from stmc.composing.retiming import retimed
from stmc.composing.running import Run, settings_taken
from stmc.composing.sampling import INDEPENDENT, Sampling
from stmc.composing.sequences import compose_tracks
from stmc.diffusion import SAMPLERS, Predict
from stmc.diffusion.tensors import mask
from stmc.settings.records import SettingError, shown
from stmc.timeline import Timeline, one_text, single_track
from stmc.timeline.planning import Plan, cross_fade, handshake, look_back, multi_diffusion, second_take

Features = Float[Tensor, "batch frames features"]
Rule = Callable[[Plan], Plan]
Baseline = Callable[[Timeline, "float | int", int], Timeline]
"""(timeline, frames per second, frames of the longest crop) → the timeline that is sampled instead."""

SKIPPED = 0.1
"""The share of the steps, the noisiest, that DoubleTake's second take goes without (Shafir et al. 2024)."""

SEEN = 5 / 30
"""Seconds of what is before it that an action sees: TEACH's five frames, 30 a second (Athanasiou et al. 2022). The text
holds for them, too: the more of them, the more of the action is over when its own frames begin."""


@dataclass(frozen=True, eq=False)
class Method:
    """How timelines become features.

    `sample` makes normalised features [batch, frames, features] of a `Run`, each from its first frame on. `label` is
    the method's name in tables, with what it sees of a timeline: `tracks` and `crops`, "Single" or "Multi" each.
    `baseline` replaces each timeline beforehand. `fixed` are the settings that the method decides, whatever the model
    says; None: it has no such setting. `per_frame_text`: it needs a denoiser that knows a text for every frame.

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
        """Whether it composes at every step, from a moment on that can be chosen or is fixed."""
        return self.fixed.get("stitch_from", 0.0) is not None


def stitched(rule: Rule | None = None, baseline: Baseline | None = None, label: str = "", **more: Any) -> Method:
    """The method that stitches crops at every step (STMC, section 3.3), by the plans that `rule` makes of the usual
    ones (None: as they are), from the setting `stitch_from` on: before it crops are denoised alone (section 4.6's
    outlook).

        model.generate(timeline, method=stmc.stitched(my_rule), stitch_from=0.2)

    `more`: as of `Method`; the label is the rule's own name unless said.

    Examples:
        >>> method = stmc.stitched(stmc.timeline.planning.cross_fade, label="Cross-faded")
        >>> stmc.load().generate("walk # 0 # 1\\njump # 1 # 2", method=method, stitch_from=0.5, steps=2)
        [Motion(40 frames at 20 fps, 2.00 s)]
    """

    def sample(run: Run) -> Features:
        return stitch(run, [plan if rule is None else _planned(rule, plan) for plan in run.plans()])

    return Method(sample, label or getattr(rule, "__name__", "stitched"), baseline, **more)


def _planned(rule: Rule, plan: Plan) -> Plan:
    """The plan that a rule makes. Raises `SettingError` for a rule that makes something else."""
    made = rule(plan)
    if not isinstance(made, Plan):
        raise SettingError(f"the rule {getattr(rule, '__name__', 'given')} makes a {type(made).__name__}, not a Plan")
    return made


def cross_faded(run: Run) -> Features:
    """STMC with cross-faded transitions, in which arms that have far to go take their time."""
    plans = run.plans()
    faded = [cross_fade(plan) for plan in plans]
    return stitch(run, faded, retimed(run.collage(faded), plans, run.layout, run.statistics))


def stitch(run: Run, plans: Sequence[Plan], predict: Predict | None = None) -> Features:
    """STMC by `plans`, from the run's `stitch_from` on, with their collage or another predictor of timelines."""
    predict, draw = run.constrained(predict or run.collage(plans)), run.noise(plans)
    independent = run.steps_before(run.sampling.stitch_from)
    if not independent:
        return run.denoise(predict, draw(), draw)
    left = len(run.times) - independent
    noise = draw()
    x = run.schedule.q_sample(torch.zeros_like(noise), run.times[left - 1], noise)  # what lies behind the ends
    crops = run.begun_independently(independent)
    inside = mask(torch.tensor([plan.frames for plan in plans]))[..., None].to(crops.device)
    x[:, : crops.shape[1]] = torch.where(inside, crops, x[:, : crops.shape[1]])
    return run.denoise(predict, x, draw, left)


def alone(run: Run) -> Features:
    """Every timeline's one prompt as a motion of its own. Raises `ValueError` for several prompts."""
    if several := [timeline for timeline in run.timelines if len(timeline.prompts) != 1]:
        raise ValueError(f"independent prompts: one prompt a timeline, not {len(several[0].prompts)}")
    return stitch(run, run.plans())


def smoothed(run: Run) -> Features:
    """SINC, with a straight line over the overlap wherever a part changes from one crop to another."""
    return smooth_seams(run.independent(), run.plans(0), run.columns, run.overlap)


def smoothed_on_the_sphere(run: Run) -> Features:
    """The same with rotations on their shortest arc: on one track TEACH's own baseline of independent actions."""
    return _on_the_sphere(run, run.independent(), run.plans(0))


def one_by_one(run: Run) -> Features:
    """Crops one after the other, each with the last frames before it in view (TEACH without slerp)."""
    return run.autoregressive(_looking_back(run))


def one_by_one_on_the_sphere(run: Run) -> Features:
    """The same, then rotations on their shortest arc over the overlap wherever an action follows another (TEACH)."""
    plans = _looking_back(run)
    return _on_the_sphere(run, run.autoregressive(plans), plans)


def _looking_back(run: Run) -> list[Plan]:
    """Plans whose crops leave room for what they see, and begin with it."""
    seen = min(round(SEEN * run.fps), run.longest - 1)
    return [look_back(plan, seen) for plan in replace(run, longest=run.longest - seen).plans(0)]


def _on_the_sphere(run: Run, features: Features, plans: Sequence[Plan]) -> Features:
    return run.statistics.normalise(slerp(run.statistics.restore(features), plans, run.layout, run.overlap))


def seamless(run: Run) -> Features:
    """What each body part obeys as one sequence, without crops (FlowMDM, here with several tracks)."""
    run = replace(run, fixed_length=None)  # sequences are seen whole
    plans = run.plans(0)
    draw = run.noise(plans)
    sequences = compose_tracks(run.guided_sequences(plans, run.sampling.guidance), plans, run.columns)
    return run.denoise(run.constrained(sequences), draw(), draw)


def two_takes(run: Run) -> Features:
    """Crops that fade into each other, then half an overlap on either side of each transition made anew."""
    plans, ramp = run.plans(), run.overlap // 2
    content = stitch(run, [handshake(plan) for plan in plans])
    if not ramp:
        return content
    takes = [second_take(plan, run.longest) for plan in plans]
    kept = kept_shares(plans, run.columns, ramp).to(content)
    kept = F.pad(kept, (0, 0, 0, content.shape[1] - kept.shape[1]), value=1.0)
    steps = max(1, len(run.times) - int(SKIPPED * len(run.times)))
    draw = run.noise(takes, [(seed, 0) for seed in run.seeds])
    x = run.schedule.q_sample(content, run.times[steps - 1], draw())
    return run.denoise(inpaint(run.constrained(run.collage(takes, 0.0)), content, kept), x, draw, steps)


_FROM_THE_FIRST: Mapping[str, Any] = {"stitch_from": 0.0, "guidance_from": 0.0}
_NEVER: Mapping[str, Any] = {"stitch_from": None, "guidance_from": None}
_WITHOUT_OVERLAP: Mapping[str, Any] = _NEVER | {"overlap": None}


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
    "single_track": stitched(
        baseline=_one_track,
        label="DiffCollage",
        fixed=_FROM_THE_FIRST,
        tracks="Single",
    ),
    INDEPENDENT: Method(alone, "Independent prompts", fixed=_WITHOUT_OVERLAP),
    "sinc": Method(Run.independent, "SINC w/o Lerp", fixed=_WITHOUT_OVERLAP),
    "sinc_lerp": Method(smoothed, "SINC w/ Lerp", fixed=_NEVER),
    "sinc_slerp": Method(smoothed_on_the_sphere, "SINC w/ Slerp", fixed=_NEVER),
    "teach_b": Method(one_by_one, "TEACH_B", _one_track, fixed=_WITHOUT_OVERLAP, tracks="Single"),
    "teach": Method(one_by_one_on_the_sphere, "TEACH", _one_track, fixed=_NEVER, tracks="Single"),
    "multi_diffusion": stitched(multi_diffusion, label="MultiDiffusion", fixed=_FROM_THE_FIRST),
    "double_take": Method(two_takes, "DoubleTake", fixed=_FROM_THE_FIRST),
    "stmc_paper": stitched(label="STMC (paper)", fixed=_FROM_THE_FIRST),
    "stmc": Method(cross_faded, "STMC (cross-faded)"),
    "flow_mdm": Method(seamless, "FlowMDM", fixed=_WITHOUT_OVERLAP, per_frame_text=True, crops="None"),
}
"""Table 1's rows in its order, and others beside those that they are nearest to. "stmc_paper" is the paper's algorithm
to the letter: hard edges, composed from the first step on. Its noise is the model's: each publisher has its own."""

_RENAMED = {"stmc_soft": "stmc"}


def find_method(method: str | Method | Rule, trusted: Iterable[str] = ()) -> Method:
    """The method of a name in `METHODS`, or of a dotted name such as "mylab.rules.mine": a `Method` or a rule of a
    package that `trusted` names, for importing it runs its code. A method is itself, and a rule is `stitched`.

    Raises:
        SettingError: For an unknown name, and a package that is not trusted or has no such thing.

    Examples:
        >>> stmc.find_method("one_text").tracks
        'Single'
    """
    if isinstance(method, str):
        method = METHODS.get(method) or _imported(method, tuple(trusted))
    if isinstance(method, Method):
        return method
    if not callable(method):
        raise SettingError(f"method={shown(method)}: a name, a Method or a rule Plan → Plan needed")
    return stitched(method)


def _imported(name: str, trusted: Sequence[str]) -> Any:
    if name in _RENAMED:
        raise SettingError(f"method={name}: {name} is now {_RENAMED[name]}, and the paper's hard edges are stmc_paper")
    home, _, attribute = name.rpartition(".")
    if not home:
        raise SettingError(f"method={shown(name)}: choose from {', '.join(METHODS)}, or a dotted name of your own")
    package = name.partition(".")[0]
    if package not in trusted:
        raise SettingError(f"method={shown(name)}: {shown(package)} is not among the trusted packages")
    try:
        found = getattr(import_module(home), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise SettingError(f"method={shown(name)}: {str(error)[:120]}") from error
    is_own = f"{getattr(found, '__module__', '')}".partition(".")[0] == package
    if callable(found) and not isinstance(found, Method) and not is_own:
        raise SettingError(f"method={shown(name)}: not a rule Plan → Plan that {package} defines")
    return found


def settled(asked: Sampling, method: Method, own: Sampling) -> Sampling:
    """The settings of a run: what the method fixes, then what is `asked`, then the model's `own`, which are complete.
    What does not apply is None: to the method, to the sampler, or to the model."""
    found = replace(asked.over(own), **method.fixed)
    taken = settings_taken(found.sampler)
    absent = {name for name in _OF_SAMPLERS if name not in taken} | {
        name for name in asked.given if getattr(own, name) is None and name not in _OF_SAMPLERS
    }
    return replace(found, **dict.fromkeys(absent))


def refuse(asked: Sampling, method: Method, own: Sampling) -> None:
    """Raises `SettingError` for what is `asked` in vain: a value that a run would not have."""
    found = settled(asked, method, own)
    for name, value in asked.given.items():
        used = getattr(found, name)
        if value != used and not (used is None and value == 0):
            raise SettingError(f"{name}={shown(value)}: {_reason(name, used, method, found)}")


def _reason(name: str, used: Any, method: Method, found: Sampling) -> str:
    if name in method.fixed:
        return f"{method.label} has no such setting" if used is None else f"{method.label} fixes it at {used}"
    return f"{'the sampler' if name in _OF_SAMPLERS else 'the model'} has no such setting"


_OF_SAMPLERS = frozenset.union(*(frozenset(settings_taken(name)) for name in SAMPLERS)) & set(
    Sampling.__dataclass_fields__
)
"""The settings that samplers have arguments for."""
