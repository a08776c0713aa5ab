"""Denoisers for sampling: computations that depend on the text alone run once and not at every step.

Independent of layers; `denoiser` defines the interface of a denoiser.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import ClassVar

from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from stmc.denoisers.denoiser import Denoiser
from stmc.diffusion.statistics import Statistics, restate
from stmc.settings.records import SettingError


class Network(nn.Module, ABC):
    """A `Denoiser` in two parts: `encode_text` runs once, then `denoise` runs with the encoded text at every step."""

    fixed_length: int | None = None
    """Number of frames that the network always sees, counted from the first frame of a crop. Frames after the end of
    the crop hold the rest of the timeline, or noise. None: the network sees the frames of the crop only, with a mask
    for padded crops."""

    supports_padding: bool = True
    """Whether texts of different lengths may share a batch, that is, whether padded words leave the prediction
    unchanged."""

    per_frame_text: bool = False
    """Whether `denoise` takes a last argument `segment`, the index of the word that applies to each frame (see
    `FlowMdm.denoise`)."""

    absolute_from: int | None = None
    """The lowest step with absolute positions, if `denoise` accepts an argument of this name that overrides it; None if
    all steps are alike."""

    ends: ClassVar[tuple[str, str]]
    """Names of the linear layers that take features in and give them out."""

    @property
    def name(self) -> str:
        """The name of the network in messages."""
        return type(self).__name__

    def require_per_frame_text(self) -> None:
        """Raise `SettingError` unless the network takes a text for every frame."""
        if not self.per_frame_text:
            need = "sequences of several texts need a denoiser with per_frame_text, such as FlowMdm"
            raise SettingError(f"{self.name} takes one text for all frames; {need}")

    def restate(self, old: Statistics, new: Statistics) -> None:
        """Adapt the weights from features normalised by `old` to features normalised by `new`.

        See `statistics.restate`.
        """
        first, last = map(self.get_submodule, self.ends)
        assert isinstance(first, nn.Linear) and isinstance(last, nn.Linear)
        restate(first, last, old, new)

    @abstractmethod
    def encode_text(
        self, text: Float[Tensor, "batch words width"], text_mask: Bool[Tensor, "batch words"] | None = None
    ) -> Float[Tensor, "batch words encoded"]:
        """Encode texts once for all steps: keep the number of words, change their width to that of the network."""

    @abstractmethod
    def denoise(
        self,
        x: Float[Tensor, "batch frames features"],
        t: Int[Tensor, " batch"],
        text: Float[Tensor, "batch words encoded"],
        text_mask: Bool[Tensor, "batch words"] | None = None,
        mask: Bool[Tensor, "batch frames"] | None = None,
    ) -> Float[Tensor, "batch frames features"]:
        """Predict as a `Denoiser`, but from a `text` that `encode_text` has encoded."""

    def forward(
        self,
        x: Float[Tensor, "batch frames features"],
        t: Int[Tensor, " batch"],
        text: Float[Tensor, "batch words width"],
        text_mask: Bool[Tensor, "batch words"] | None = None,
        mask: Bool[Tensor, "batch frames"] | None = None,
    ) -> Float[Tensor, "batch frames features"]:
        """Encode the text and call `denoise`; see `Denoiser`."""
        return self.denoise(x, t, self.encode_text(text, text_mask), text_mask, mask)


def as_network(denoiser: Denoiser) -> Network:
    """Return a `Network` unchanged, or wrap any function with the signature of a `Denoiser`.

    Attributes of the function, such as `fixed_length`, describe its abilities; missing attributes default to those of
    `Network`. Raises `ValueError` if `denoiser` is not callable.
    """
    if isinstance(denoiser, Network):
        return denoiser
    if not callable(denoiser):
        raise ValueError(f"{denoiser!r:.60} is not a denoiser; pass a function (x, t, text, text_mask, mask) -> motion")
    return _FunctionNetwork(denoiser)


class _FunctionNetwork(Network):
    def __init__(self, denoiser: Denoiser) -> None:
        super().__init__()
        self.function: Callable[..., Tensor] = denoiser
        for name in ("fixed_length", "supports_padding", "per_frame_text", "absolute_from"):
            setattr(self, name, getattr(denoiser, name, getattr(Network, name)))

    @property
    def name(self) -> str:
        return getattr(self.function, "__name__", type(self.function).__name__)

    def encode_text(self, text: Tensor, text_mask: Tensor | None = None) -> Tensor:
        return text

    def denoise(
        self,
        x: Tensor,
        t: Tensor,
        text: Tensor,
        text_mask: Tensor | None = None,
        mask: Tensor | None = None,
        *segment: Tensor | None,
        **settings: int,
    ) -> Tensor:
        return self.function(x, t, text, text_mask, mask, *segment, **settings)
