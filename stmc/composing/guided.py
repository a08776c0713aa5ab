"""What a denoiser is asked for plans, with classifier-free guidance: their crops, or the sequences of their body parts.

Knows plans, texts and embeddings; knows no text encoders, no samplers and nothing of how answers become timelines.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from stmc.composing.batching import Guided, Request
from stmc.composing.sequences import Segment, body_sequences
from stmc.composing.stitching import crop_lengths
from stmc.denoisers import Denoiser
from stmc.diffusion import Prediction, Schedule
from stmc.timeline.planning import Plan

NULL = ""
"""The text that stands for no text: its embedding is what the network saw when the text was dropped in training."""

PADDING = 0.1
"""Which share of the frames that a step denoises may be padding."""


@runtime_checkable
class SequenceDenoiser(Protocol):
    """A denoiser that knows a text for every frame, such as `FlowMdm.denoise`."""

    def __call__(
        self,
        x: Float[Tensor, "batch frames features"],
        t: Int[Tensor, " batch"],
        text: Float[Tensor, "batch words width"],
        text_mask: Bool[Tensor, "batch words"] | None,
        mask: Bool[Tensor, "batch frames"] | None,
        segment: Int[Tensor, "batch frames"] | None,
    ) -> Float[Tensor, "batch frames features"]:
        """As `Denoiser`, but a text has a word for each segment, and `segment` says which one a frame belongs to."""
        ...


def distinct_texts(plans: Sequence[Plan]) -> tuple[str, ...]:
    """What has to be encoded for these plans: the empty text first, then every text once, in order of appearance."""
    return tuple(dict.fromkeys([NULL, *(crop.text or NULL for plan in plans for crop in plan.crops)]))


def check_embeddings(plans: Sequence[Plan], embeddings: Mapping[str, Tensor]) -> None:
    """Raises `ValueError` naming the texts of the plans that have no embedding."""
    missing = [text for text in distinct_texts(plans) if text not in embeddings]
    if missing:
        raise ValueError(f"no embedding for {missing}; every text of the plans needs one, and the empty text too")


def guided_crops(
    denoiser: Denoiser,
    schedule: Schedule,
    plans: Sequence[Plan],
    embeddings: Mapping[str, Float[Tensor, "_ width"]],
    guidance: float | int = 2.5,
    prediction: Prediction = "x0",
    padding: float = PADDING,
    budget: int = 32768,
    supports_padding: bool = False,
    fixed_length: int | None = None,
    needed: Sequence[bool] | None = None,
) -> Guided:
    """A predictor of the crops of all plans, [crops, frames, features], with classifier-free guidance: see `Guided`.

    `embeddings` gives the normalised embedding [words, width] of every text in `distinct_texts(plans)`. What stands
    beyond a crop's end is not seen, and comes out as zero.

    `supports_padding`: texts of different numbers of words share calls. Only for denoisers that padded words do not
    disturb, such as `MdmSmpl` with its `words` set: the published network moves the frames behind the longest text.
    `fixed_length`: every crop has as many frames, whatever its own length (see `Network`), and all are predicted.
    `needed`: of each crop, whether it is (None: all are); the others come out as zero.

    Raises `ValueError` for a text without an embedding.

    Examples:
        >>> plans = [stmc.plan(stmc.Timeline.parse("walk # 0 # 2"), fps=20, overlap=10)]
        >>> embeddings = {"": torch.zeros(1, 384), "walk": torch.ones(1, 384)}
        >>> crops = stmc.guided_crops(lambda x, *others: x, stmc.Schedule.cosine(100), plans, embeddings)
        >>> crops(torch.zeros(1, 40, 205), 99).shape
        torch.Size([1, 40, 205])
    """
    check_embeddings(plans, embeddings)
    crops = [crop for plan in plans for crop in plan.crops]
    requests = [
        Request(crop.frames, frames, embeddings[NULL], embeddings[crop.text] if crop.text else None, needed=wanted)
        for crop, frames, wanted in zip(
            crops, crop_lengths(plans, fixed_length), needed or [True] * len(crops), strict=True
        )
    ]
    return Guided(denoiser, schedule, requests, guidance, prediction, padding, budget, supports_padding)


def guided_sequences(
    denoiser: SequenceDenoiser,
    schedule: Schedule,
    plans: Sequence[Plan],
    embeddings: Mapping[str, Float[Tensor, "_ width"]],
    guidance: float | int = 2.5,
    prediction: Prediction = "x0",
    budget: int = 65536,
) -> Guided:
    """A predictor of the sequences of all plans, [sequences, frames, features], with classifier-free guidance.

    `embeddings` gives the normalised embedding, one word, of every text in `distinct_texts(plans)`. A sequence with any
    text is denoised with its texts, and in a second pass with the same segments but no text: see `Guided`. Raises
    `ValueError` for a text without an embedding, or with more words than one, and for plans with overlap.
    """
    check_embeddings(plans, embeddings)
    if long := [text for text in distinct_texts(plans) if len(embeddings[text]) != 1]:
        raise ValueError(f"a segment's text is one word, but {long[0]!r} has {len(embeddings[long[0]])}")
    requests = [_request(plan, sequence, embeddings) for plan in plans for sequence in body_sequences(plan)]
    return Guided(denoiser, schedule, requests, guidance, prediction, PADDING, budget, supports_padding=True)


def _request(plan: Plan, sequence: Sequence[Segment], embeddings: Mapping[str, Tensor]) -> Request:
    """A word and a segment for each crop, also for one that comes back behind another."""
    crops = list(dict.fromkeys(segment.crop for segment in sequence))
    texts = [plan.crops[crop].text or NULL for crop in crops]
    conditional, null = (torch.cat([embeddings[text] for text in each]) for each in (texts, [NULL] * len(texts)))
    words = torch.cat([torch.full((end - start,), crops.index(crop)) for crop, start, end in sequence])
    return Request(plan.frames, plan.frames, null, conditional if any(text != NULL for text in texts) else None, words)
