"""HumanML3D's clips with their captions as its benchmark takes them: real motion to compare with, texts to ask for.

Knows which clips of a processed folder count, and as how many; how they are read is `humanml3d`'s matter.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from stmc.data.preparation import LayoutError
from stmc.data.sources.humanml3d.humanml3d_folder import FPS, LONGEST, SHORTEST, read_clip
from stmc.data.sources.humanml3d.humanml3d_texts import WHOLE, Caption
from stmc.io.untrusted import read_lines

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class CaptionedClip:
    """Raw features, and all captions that are true of them."""

    name: str
    features: Float[Tensor, "_ features"]
    captions: tuple[Caption, ...]


def read_captioned_clips(folder: str | Path, split: str = "test") -> list[CaptionedClip]:
    """The clips of a split of the folder `HumanML3D/`, as its authors' evaluation takes them: one of 40 to 199 frames
    with all captions of the whole of it, and for each caption of some of its seconds those frames, if they are as many.

    What cannot be used is left out, and logged. Raises `LayoutError` for a folder without the split, or without any
    clip of it.
    """
    folder = Path(folder).expanduser()
    listed = folder / f"{split}.txt"
    if not listed.is_file():
        raise LayoutError(f"{listed} does not exist: the folder is not HumanML3D's (new_joint_vecs/, texts/, test.txt)")
    clips, skipped = list[CaptionedClip](), list[str]()
    for name in dict.fromkeys(" ".join(read_lines(listed)).split()):
        try:
            clips += _clips(name, *read_clip(folder, name))
        except (ValueError, OSError) as error:
            skipped.append(f"{name}: {error}")
    if not clips:
        raise LayoutError(f"{listed}: not one clip can be used{'; ' + skipped[0] if skipped else ''}")
    if skipped:
        logger.warning("%d of the clips in %s are left out; the first: %s", len(skipped), listed, skipped[0])
    return clips


def _clips(name: str, features: Float[Tensor, "frames 263"], captions: list[Caption | str]) -> list[CaptionedClip]:
    usable = [caption for caption in captions if isinstance(caption, Caption)]
    whole = tuple(caption for caption in usable if (caption.start, caption.end) == WHOLE)
    clips = [CaptionedClip(name, features, whole)] if whole else []
    for number, caption in enumerate(caption for caption in usable if caption not in whole):
        part = features[int(caption.start * FPS) : int(caption.end * FPS)]
        if SHORTEST <= len(part) <= LONGEST:
            clips.append(CaptionedClip(f"{name}/{number}", part, (caption,)))
    return clips
