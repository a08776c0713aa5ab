"""Sampling settings: the only list of the settings that, with the seed and the method, determine a motion.

Command lines, experiments, records and tables take their settings from the fields of `Sampling`; samplers and denoisers
receive those that their arguments name. Depends on settings and the names of samplers; independent of timelines.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, TypedDict, get_args

from stmc.diffusion import SAMPLERS, NoiseScale
from stmc.settings.records import check, setting


@dataclass(frozen=True)
class Sampling:
    """Settings of sampling; None leaves a setting open, to take the method's default, or else the model's.

    Raises:
        SettingError: If a value has the wrong type or is out of range.

    Examples:
        >>> dict(stmc.Sampling(steps=50, guidance=2.5).given)
        {'steps': 50, 'guidance': 2.5}
    """

    steps: int | None = setting(None, "denoising steps; null: as many as in training", at_least=1)
    sampler: str | Callable[..., Any] | None = setting(
        None, "sampler: a name or, in Python, a function like stmc.ddpm", choices=SAMPLERS
    )
    noise_scale: NoiseScale | None = setting(
        None,
        "scale of the noise in ddpm's steps: the posterior's standard deviation (textbook) or variance (paper)",
        choices=get_args(NoiseScale),
    )
    guidance: float | int | None = setting(
        None, "guidance weight of the texts: 0 ignores them, 1 is as trained", above=-1000, below=1000
    )
    guidance_from: float | int | None = setting(
        None, "start of guidance; before it, the weight is at most 1", unit="share of steps", at_least=0, below=1
    )
    overlap: float | int | None = setting(None, "length of a transition between prompts", unit="s", at_least=0)
    stitch_from: float | int | None = setting(
        None,
        "start of stitching; crops are denoised independently before it",
        unit="share of steps",
        at_least=0,
        below=1,
    )
    restate_from: float | int | None = setting(
        None,
        "minimum probability of an action for reading a prompt as the action's first training sentence; 1: never",
        at_least=0,
        at_most=1,
    )
    ape_steps: float | int | None = setting(
        None, "FlowMDM's noisiest steps, which use absolute positions", unit="share of steps", at_least=0, at_most=1
    )

    def __post_init__(self) -> None:
        check(self)

    def with_defaults(self, defaults: Sampling) -> Sampling:
        """Return these settings, with `defaults` in place of open ones.

        Examples:
            >>> dict(stmc.Sampling(steps=50).with_defaults(stmc.Sampling(steps=100, overlap=0.5)).given)
            {'steps': 50, 'overlap': 0.5}
        """
        return replace(defaults, **self.given)

    @property
    def given(self) -> Mapping[str, Any]:
        """The settings that are not open, by name."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in values.items() if value is not None}


class SamplingArguments(TypedDict, total=False):
    """The fields of `Sampling` as keyword arguments, for editors and type checkers."""

    steps: int | None
    sampler: str | Callable[..., Any] | None
    noise_scale: NoiseScale | None
    guidance: float | int | None
    guidance_from: float | int | None
    overlap: float | int | None
    stitch_from: float | int | None
    restate_from: float | int | None
    ape_steps: float | int | None


INDEPENDENT = "independent"
"""The method that samples every prompt as a separate motion: an upper bound for compositions (appendix E)."""

DEFAULT = Sampling(
    sampler="ddpm",
    noise_scale="variance",
    guidance=2.5,
    guidance_from=0.0,
    overlap=0.5,
    stitch_from=0.0,
    restate_from=1.0,
)
"""Defaults of settings that the caller, the method and the model all leave open; `steps` defaults to the schedule's."""
