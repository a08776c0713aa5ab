"""Real motion for FlowMDM's evaluation: the clips of a test split with their texts, and windows of its recordings.

See Barquero et al. (2024), section 4.1. Depends on HumanML3D's processed folder and prepared caches of BABEL;
independent of evaluators.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from stmc.data.cache import Cache, Clip
from stmc.data.preparation import LayoutError
from stmc.data.sources.humanml3d.humanml3d_clips import CaptionedClip, read_captioned_clips
from stmc.data.sources.humanml3d.humanml3d_texts import Caption
from stmc.motion.representation import BabelRepresentation

TRANSITION = "transition"
"""BABEL's label of the transition between two actions."""
POSES = {"t pose": "t-pose", "tpose": "t-pose", "a pose": "a-pose", "apose": "a-pose"}
"""Labels of one pose with several spellings."""


@dataclass(frozen=True, eq=False)
class References:
    """Raw features of real `clips` with their captions, and of `windows` from anywhere in the recordings."""

    clips: tuple[CaptionedClip, ...]
    windows: Float[Tensor, "windows frames features"]


def humanml3d_references(
    folder: str | Path, split: str = "test", shortest: int = 70, longest: int = 199, window: int = 60, seed: int = 0
) -> References:
    """Read the references of HumanML3D: its clips, and a random window of each clip that is long enough.

    Args:
        folder: HumanML3D's processed folder.
        split: Split of the clips.
        shortest: Minimum length of a clip in frames.
        longest: Maximum length of a clip in frames.
        window: Length of a window in frames.
        seed: Seed of the windows.

    Raises:
        LayoutError: If there are no clips or windows.
    """
    clips, rng = read_captioned_clips(folder, split), np.random.default_rng(seed)
    windows = [_window(clip.features, window, rng) for clip in clips if len(clip.features) >= window]
    usable = tuple(clip for clip in clips if shortest <= len(clip.features) <= longest)
    return _build_references(usable, windows, f"{folder}, split {split}", window)


def babel_references(
    cache: str | Path, split: str = "val", shortest: int = 30, longest: int = 200, window: int = 30, seed: int = 0
) -> References:
    """Read the references of a prepared cache of BABEL: its clips without transitions, and windows of its recordings.

    A recording has as many random windows as its length allows. Recordings are the clips without texts, which
    `babel_rows` prepares or, if there are none, the recordings that contain the clips.

    Args:
        cache: Folder of the prepared cache.
        split: Split of the clips.
        shortest: Minimum length of a clip in frames.
        longest: Maximum length of a clip in frames.
        window: Length of a window in frames.
        seed: Seed of the windows.

    Raises:
        CacheError: If the folder holds no cache.
        LayoutError: If the features are not BABEL's, or there are no clips or windows.
    """
    prepared, rng = Cache.read(Path(cache).expanduser()), np.random.default_rng(seed)
    width = BabelRepresentation().width
    if prepared.features.shape[1] != width:
        raise LayoutError(f"{cache} holds {prepared.features.shape[1]} features; BABEL's are {width}")
    inside = [clip for clip in prepared.clips if clip.split == split and not clip.mirrored]
    recordings, windows = [clip for clip in inside if not prepared.texts[clip.texts]], []
    for start, end in dict.fromkeys(clip.whole or (clip.start, clip.end) for clip in recordings or inside):
        windows += [_window(prepared.features[start:end], window, rng) for _ in range((end - start) // window)]
    clips = (_clip(prepared, clip) for clip in inside if shortest <= clip.end - clip.start <= longest)
    return _build_references(tuple(clip for clip in clips if clip.captions), windows, f"{cache}, split {split}", window)


def _clip(cache: Cache, clip: Clip) -> CaptionedClip:
    texts = (text for text, _ in cache.texts[clip.texts])
    captions = tuple(Caption(POSES.get(text, text), 0.0, 0.0) for text in texts if text != TRANSITION)
    return CaptionedClip(clip.name, cache.features[clip.start : clip.end], captions)


def _window(features: Float[Tensor, "_ features"], window: int, rng: np.random.Generator) -> Tensor:
    start = int(rng.integers(len(features) - window + 1))
    return features[start : start + window]


def _build_references(
    clips: tuple[CaptionedClip, ...], windows: Sequence[Tensor], place: str, window: int
) -> References:
    if not clips or not windows:
        raise LayoutError(
            f"{place}: {len(clips)} clips with texts and {len(windows)} windows of {window} frames are too few"
        )
    return References(clips, torch.stack(list(windows)))
