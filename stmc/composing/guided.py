"""Predictors with classifier-free guidance for plans: of their crops, or of the sequences of their body parts."""

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
"""The text that represents no text: the network saw its embedding when a text was dropped in training."""
PADDING = 0.1
"""Maximum fraction of padding among the frames that a step denoises."""


@runtime_checkable
class SequenceDenoiser(Protocol):
    """A denoiser with a text for every frame, such as `FlowMdm.denoise`."""

    def __call__(
        self,
        x: Float[Tensor, "batch frames features"],
        t: Int[Tensor, " batch"],
        text: Float[Tensor, "batch words width"],
        text_mask: Bool[Tensor, "batch words"] | None,
        mask: Bool[Tensor, "batch frames"] | None,
        segment: Int[Tensor, "batch frames"] | None,
    ) -> Float[Tensor, "batch frames features"]:
        """Predict as `Denoiser` does, with one word per segment; `segment` holds the index of each frame's word."""
        ...


def distinct_texts(plans: Sequence[Plan]) -> tuple[str, ...]:
    """List the texts to encode for plans: the empty text first, then every text once, in order of appearance."""
    return tuple(dict.fromkeys([NULL, *(crop.text or NULL for plan in plans for crop in plan.crops)]))


def check_embeddings(plans: Sequence[Plan], embeddings: Mapping[str, Tensor]) -> None:
    """Raise `ValueError` with the texts of the plans that have no embedding."""
    missing = [text for text in distinct_texts(plans) if text not in embeddings]
    if missing:
        raise ValueError(f"no embedding for {missing}; pass one for every text of the plans and for the empty text")


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
    """Build a predictor of the crops of all plans, [crops, frames, features], with classifier-free guidance.

    Frames beyond the end of a crop are not seen and are predicted as zero. See `Guided`.

    Args:
        denoiser: Denoiser of crops.
        schedule: Noise schedule.
        plans: Plans of the timelines.
        embeddings: Normalised embedding [words, width] of every text in `distinct_texts(plans)`.
        guidance: Guidance scale.
        prediction: The quantity that the denoiser predicts.
        padding: Maximum fraction of padding in a step.
        budget: Maximum number of frames of one call.
        supports_padding: Whether texts with different numbers of words share calls. Only for denoisers that are
            insensitive to padded words, such as `MdmSmpl` with `words` set; the published network places the frames
            after the longest text.
        fixed_length: Number of frames of every crop, whatever its own length, all of which are predicted (see
            `Network`).
        needed: Whether each crop is used; unused crops are predicted as zero. None means that all are used.

    Raises:
        ValueError: If a text has no embedding.

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
        Request(crop.frames, frames, embeddings[NULL], embeddings[crop.text] if crop.text else None, needed=used)
        for crop, frames, used in zip(
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
    """Build a predictor of the sequences of all plans, [sequences, frames, features], with classifier-free guidance.

    A sequence with any text is denoised with its texts, and again with the same segments but no text. See `Guided`.

    Args:
        denoiser: Denoiser with a text for every frame.
        schedule: Noise schedule.
        plans: Plans without overlap.
        embeddings: Normalised embedding, one word, of every text in `distinct_texts(plans)`.
        guidance: Guidance scale.
        prediction: The quantity that the denoiser predicts.
        budget: Maximum number of frames of one call.

    Raises:
        ValueError: If a text has no embedding or more than one word, or a plan has an overlap.
    """
    check_embeddings(plans, embeddings)
    if long := [text for text in distinct_texts(plans) if len(embeddings[text]) != 1]:
        raise ValueError(f"the text of a segment must have one word, but {long[0]!r} has {len(embeddings[long[0]])}")
    requests = [_request(plan, sequence, embeddings) for plan in plans for sequence in body_sequences(plan)]
    return Guided(denoiser, schedule, requests, guidance, prediction, PADDING, budget, supports_padding=True)


def _request(plan: Plan, sequence: Sequence[Segment], embeddings: Mapping[str, Tensor]) -> Request:
    """Build a request with one word and one segment per crop, also for a crop that resumes after another."""
    crops = list(dict.fromkeys(segment.crop for segment in sequence))
    texts = [plan.crops[crop].text or NULL for crop in crops]
    conditional, null = (torch.cat([embeddings[text] for text in words]) for words in (texts, [NULL] * len(texts)))
    words = torch.cat([torch.full((end - start,), crops.index(crop)) for crop, start, end in sequence])
    return Request(plan.frames, plan.frames, null, conditional if any(text != NULL for text in texts) else None, words)
