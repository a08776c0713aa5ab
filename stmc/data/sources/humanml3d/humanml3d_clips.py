"""HumanML3D's clips with their captions for its benchmark: real motion for comparison, and texts.

Selects the clips of a processed folder and their parts; `humanml3d_folder` reads them.
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
    """Raw features, and all captions that describe them."""

    name: str
    features: Float[Tensor, "_ features"]
    captions: tuple[Caption, ...]


def read_captioned_clips(folder: str | Path, split: str = "test") -> list[CaptionedClip]:
    """Read the clips of a split of the folder `HumanML3D/`, as its authors' evaluation does.

    A clip of 40 to 199 frames has all captions of the whole clip; each caption of a part of it gives a clip of those
    frames, if their number is in the same range. Unusable clips are skipped and logged. Raises `LayoutError` if the
    folder lacks the split, or the split has no usable clip.
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
        raise LayoutError(f"{listed}: no clip can be used{'; ' + skipped[0] if skipped else ''}")
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
