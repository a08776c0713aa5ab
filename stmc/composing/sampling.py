"""How a model is sampled: the one list of the settings that decide what a motion becomes, beside its seed and method.

Command lines, experiments, records and tables take their settings from the fields of `Sampling`; samplers and denoisers
are given those that their own arguments name. Knows settings and the names of samplers; knows no timelines.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, TypedDict, get_args

from stmc.diffusion import SAMPLERS, NoiseScale
from stmc.settings.records import check, setting


@dataclass(frozen=True)
class Sampling:
    """Settings of sampling; None leaves one open: it is then the method's own, or else the model's.

    Raises:
        SettingError: For a value of another type or out of range.

    Examples:
        >>> dict(stmc.Sampling(steps=50, guidance=2.5).given)
        {'steps': 50, 'guidance': 2.5}
    """

    steps: int | None = setting(None, "steps of denoising; null: as many as in training", at_least=1)
    sampler: str | Callable[..., Any] | None = setting(
        None, "how noise becomes motion: a name or, in Python, a function like stmc.ddpm", choices=SAMPLERS
    )
    noise_scale: NoiseScale | None = setting(
        None,
        "what scales the noise of ddpm's steps: the posterior's standard deviation (textbook) or variance (paper)",
        choices=get_args(NoiseScale),
    )
    guidance: float | int | None = setting(
        None, "weight of the texts: 0 ignores them, 1 is as trained", above=-1000, below=1000
    )
    guidance_from: float | int | None = setting(
        None, "start of the guidance; texts count as trained before it", unit="share of steps", at_least=0, below=1
    )
    overlap: float | int | None = setting(None, "length of a transition between prompts", unit="s", at_least=0)
    stitch_from: float | int | None = setting(
        None, "start of the composition; crops are denoised alone before it", unit="share of steps", at_least=0, below=1
    )
    ape_steps: float | int | None = setting(
        None, "FlowMDM's noisiest steps, with absolute positions", unit="share of steps", at_least=0, at_most=1
    )

    def __post_init__(self) -> None:
        check(self)

    def over(self, other: Sampling) -> Sampling:
        """These settings and, where they leave one open, the `other`'s.

        Examples:
            >>> dict(stmc.Sampling(steps=50).over(stmc.Sampling(steps=100, overlap=0.5)).given)
            {'steps': 50, 'overlap': 0.5}
        """
        return replace(other, **self.given)

    @property
    def given(self) -> Mapping[str, Any]:
        """What is not left open, by name."""
        values = {each.name: getattr(self, each.name) for each in fields(self)}
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
    ape_steps: float | int | None


INDEPENDENT = "independent"
"""The method that samples every prompt as a motion of its own: what composing could at best keep (appendix E)."""

DEFAULT = Sampling(
    sampler="ddpm", noise_scale="variance", guidance=2.5, guidance_from=0.0, overlap=0.5, stitch_from=0.0
)
"""What neither the caller nor the method nor the model decides; the steps are then the schedule's."""
