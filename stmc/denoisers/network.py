"""A denoiser as sampling uses it: what of it depends on the text alone is done once, not at every step.

Knows no layers; see `protocol` for what a denoiser is.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from stmc.denoisers.denoiser import Denoiser
from stmc.diffusion.statistics import Statistics, restate


class Network(nn.Module, ABC):
    """A `Denoiser` in two parts: `encode_text` once, then `denoise` with the encoded text, at every step."""

    fixed_length: int | None = None
    """How many frames it always sees, from a crop's first one on: also those behind the crop's end, where the timeline
    goes on, or noise. None: a crop's own frames, with a mask where crops of a batch are padded."""

    supports_padding: bool = True
    """Whether texts of different numbers of words may share a call: whether padded words leave an answer alone."""

    per_frame_text: bool = False
    """Whether `denoise` takes as its last argument `segment`, which says of every frame to which word of the text it
    belongs: see `FlowMdm.denoise`."""

    absolute_from: int | None = None
    """The least step with absolute positions, where `denoise` takes another one as an argument of that name; None: a
    step is like any other."""

    ends: ClassVar[tuple[str, str]]
    """Names of the linear layers that take features in and give them out."""

    def restate(self, old: Statistics, new: Statistics) -> None:
        """Makes weights that were trained on features normalised by `old` ones for features normalised by `new`: see
        `statistics.restate`."""
        restate(*map(self.get_submodule, self.ends), old, new)

    @abstractmethod
    def encode_text(
        self, text: Float[Tensor, "batch words width"], text_mask: Bool[Tensor, "batch words"] | None = None
    ) -> Float[Tensor, "batch words encoded"]:
        """What there is to know of texts at every step: as many words, of the network's own width."""

    @abstractmethod
    def denoise(
        self,
        x: Float[Tensor, "batch frames features"],
        t: Int[Tensor, " batch"],
        text: Float[Tensor, "batch words encoded"],
        text_mask: Bool[Tensor, "batch words"] | None = None,
        mask: Bool[Tensor, "batch frames"] | None = None,
    ) -> Float[Tensor, "batch frames features"]:
        """The prediction, as `Denoiser` says, for an encoded `text`."""

    def forward(
        self,
        x: Float[Tensor, "batch frames features"],
        t: Int[Tensor, " batch"],
        text: Float[Tensor, "batch words width"],
        text_mask: Bool[Tensor, "batch words"] | None = None,
        mask: Bool[Tensor, "batch frames"] | None = None,
    ) -> Float[Tensor, "batch frames features"]:
        """See `Denoiser`."""
        return self.denoise(x, t, self.encode_text(text, text_mask), text_mask, mask)


def as_network(denoiser: Denoiser) -> Network:
    """The denoiser itself, or any function with a denoiser's signature as one that has nothing to encode beforehand.

    Attributes of the function's, such as `fixed_length`, say what it can; without them it is taken to be as `Network`
    says. Raises `ValueError` for what cannot be called.
    """
    if isinstance(denoiser, Network):
        return denoiser
    if not callable(denoiser):
        raise ValueError(f"a denoiser is a function (x, t, text, text_mask, mask) -> motion, not {denoiser!r:.60}")
    return _Called(denoiser)


class _Called(Network):
    def __init__(self, denoiser: Denoiser) -> None:
        super().__init__()
        self.called = denoiser
        for name in ("fixed_length", "supports_padding", "per_frame_text", "absolute_from"):
            setattr(self, name, getattr(denoiser, name, getattr(Network, name)))

    def encode_text(self, text: Tensor, text_mask: Tensor | None = None) -> Tensor:
        return text

    def denoise(self, x: Tensor, t: Tensor, text: Tensor, *others: Tensor | None, **settings: int) -> Tensor:
        return self.called(x, t, text, *others, **settings)
