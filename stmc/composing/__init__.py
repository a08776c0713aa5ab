"""Predictors of timelines, built from predictors of crops or of sequences according to plans."""

from stmc.composing.batching import Guided
from stmc.composing.double_take import first_take_weights
from stmc.composing.guided import NULL, SequenceDenoiser, distinct_texts, guided_crops, guided_sequences
from stmc.composing.inpainting import Observed, impute, inpaint
from stmc.composing.interpolation import slerp, smooth_seams
from stmc.composing.methods import METHODS, Method, Rule, find_method, resolve_settings, stitched
from stmc.composing.retiming import time_warp
from stmc.composing.running import Progress, Run
from stmc.composing.sequences import body_sequences, compose_tracks
from stmc.composing.stitching import Columns, canvas_lengths, collage, crop_lengths, crop_seeds, sinc

__all__ = [
    "METHODS",
    "NULL",
    "Columns",
    "Guided",
    "Method",
    "Observed",
    "Progress",
    "Rule",
    "Run",
    "SequenceDenoiser",
    "body_sequences",
    "canvas_lengths",
    "collage",
    "compose_tracks",
    "crop_lengths",
    "crop_seeds",
    "distinct_texts",
    "find_method",
    "first_take_weights",
    "guided_crops",
    "guided_sequences",
    "impute",
    "inpaint",
    "resolve_settings",
    "sinc",
    "slerp",
    "smooth_seams",
    "stitched",
    "time_warp",
]
