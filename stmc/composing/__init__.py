"""From predictions of crops, or of sequences, to predictions of timelines, by plans."""

from stmc.composing.batching import Guided
from stmc.composing.double_take import inpaint, kept_shares
from stmc.composing.guided import NULL, SequenceDenoiser, distinct_texts, guided_crops, guided_sequences
from stmc.composing.interpolation import lerp, slerp
from stmc.composing.sequences import body_sequences, weave
from stmc.composing.stitching import Columns, canvas_lengths, collage, crop_lengths, crop_seeds, sinc

__all__ = [
    "NULL",
    "Columns",
    "Guided",
    "SequenceDenoiser",
    "body_sequences",
    "canvas_lengths",
    "collage",
    "crop_lengths",
    "crop_seeds",
    "distinct_texts",
    "guided_crops",
    "guided_sequences",
    "inpaint",
    "kept_shares",
    "lerp",
    "sinc",
    "slerp",
    "weave",
]
