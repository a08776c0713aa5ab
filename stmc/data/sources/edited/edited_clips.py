"""Motions made by editing recordings, as a `Preparation`.

Depends on prepared caches, recipes and texts; the recipes in `edited` make the motions.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
from jaxtyping import Float
from torch import Tensor

from stmc.data.cache import FEATURES, TABLE, Cache, Clip, assemble, fingerprint, read_caches
from stmc.data.preparation import LayoutError, Piece, Watch, convert_pieces, find_source
from stmc.data.sources.cmu.cmu_clips import encode_above_floor
from stmc.data.sources.contents import CONTENTS, describe, mirror_content
from stmc.data.sources.edited import RECIPES
from stmc.data.sources.edited.recipe import Base, Bases, Draft, Recipe, Unusable
from stmc.motion.body_model import Skeleton
from stmc.motion.feet import clean_feet
from stmc.motion.motion import Motion
from stmc.motion.representation.smpl import SmplRepresentation
from stmc.settings.records import SettingError

MAX_DRAWS = 40
"""Maximum number of draws of one clip."""
SHORTEST = 1.5
"""Minimum duration of a clip in seconds."""
CACHE_VERSION = 5
"""Version of the conversion of the same caches. Raise it by one with every change that produces other clips, features
or texts: caches of earlier versions are then prepared again."""

Rows = list[tuple[Clip, Float[Tensor, "_ features"]]]


@dataclass(frozen=True)
class EditedClips:
    """A `Preparation` of edited motions, which takes minutes; a killed run resumes.

    `source` is one or several folders of prepared data sets: a sequence, or names separated by commas. Their features
    must be those of `SmplRepresentation` on the default skeleton.
    """

    source: str | Path | Sequence[str | Path]

    def check(self) -> list[Path]:
        """Return the folders. Raises `LayoutError` if one does not exist."""
        expected = "the folders of prepared data sets, commas between them, such as cache/bandai,cache/cmu"
        if not self.source:
            raise LayoutError(f"source={self.source} is empty; it should be {expected}")
        names = str(self.source).split(",") if isinstance(self.source, str | Path) else self.source
        return [find_source(name, expected) for name in names]

    def fingerprint(self) -> str:
        """Compute a digest of the caches, the version and the sentences."""
        assets = Path(__file__).parents[3] / "assets"
        inputs = [folder / name for folder in self.check() for name in (FEATURES, TABLE)]
        return fingerprint([*inputs, *(assets / f"{name}.json" for name in ("contents", "skeleton"))], [CACHE_VERSION])

    def prepared(self, scratch: Path, workers: int, watch: Watch) -> Cache:
        """Build the cache; see `Preparation`. A recipe is a piece; a clip without a usable draw is skipped."""
        folders, inputs = tuple(self.check()), self.fingerprint()
        names = [f"{recipe.action}/{recipe.origin}" for recipe in RECIPES]
        pieces = [
            Piece(name, fingerprint([], [inputs, name]), partial(_make_cache, folders, number))
            for number, name in enumerate(names)
        ]
        return convert_pieces(pieces, len(pieces), scratch, workers, watch)


@lru_cache(maxsize=1)
def _read(folders: tuple[Path, ...]) -> RecordedBases:
    """Read the recordings. Raises `LayoutError` if recipes cannot edit their features or body."""
    cache = read_caches(folders)
    if cache.representation != "smpl" or cache.skeleton is not None:
        raise LayoutError(f"recordings to edit need 205 features on the default skeleton, not {cache.representation}")
    return RecordedBases(cache)


def _make_cache(folders: tuple[Path, ...], number: int) -> Cache:
    """Build the cache of a recipe, by its index, because recipes hold functions that cannot be pickled."""
    bases = _read(folders)
    return gather(*make(RECIPES[number], bases, bases.splits, bases.fps), bases.fps)


class RecordedBases(Mapping[str, Sequence[Base]]):
    """The unmirrored clips of a cache as motions on the default skeleton, in double precision; see `recipe.Bases`.

    An action's clips are decoded at first use. `splits` holds the split of each recording.
    """

    def __init__(self, cache: Cache) -> None:
        self.fps, self.splits = cache.fps, dict[str, str]()
        self._features, self._clips = cache.features, dict[str, list[Clip]]()
        self._decoded = dict[str, tuple[Base, ...]]()
        for clip in cache.clips:
            if not clip.mirrored:
                self._clips.setdefault(clip.content, []).append(clip)
                self.splits[_recording(clip)] = clip.split

    def __getitem__(self, action: str) -> tuple[Base, ...]:
        if action not in self._decoded:
            self._decoded[action] = tuple(map(self._base, self._clips[action]))
        return self._decoded[action]

    def __iter__(self) -> Iterator[str]:
        return iter(self._clips)

    def __len__(self) -> int:
        return len(self._clips)

    def _base(self, clip: Clip) -> Base:
        features = self._features[clip.start : clip.end].double()
        motion = SmplRepresentation().decode(features, self.fps, _skeleton())
        return Base(clip.name, _recording(clip), clip.style, motion)


def _recording(clip: Clip) -> str:
    """Return the name of the recording that contains a clip: names of segments append an index."""
    return clip.name.partition("/")[0]


def _skeleton() -> Skeleton:
    return Skeleton(Skeleton.default().offsets.double())


def make(
    recipe: Recipe, bases: Bases, splits: Mapping[str, str], fps: float | int
) -> tuple[Rows, list[tuple[str, str]]]:
    """Make all clips of a recipe and its mirror images, with features; also return the failures.

    A clip depends on the bases and its own name alone. It has the split of the recording that it was made from; rest
    that a recipe adds may come from a recording of another split. A failure is the name of a clip without a usable
    draw, with the last reason.

    Args:
        recipe: The recipe.
        bases: Recorded clips.
        splits: Split of each recording.
        fps: Frame rate of the clips.

    Raises:
        ValueError: If no clip is usable.
    """
    rows, skipped = Rows(), list[tuple[str, str]]()
    for number in range(recipe.clips):
        name = f"{recipe.action}/{recipe.origin}/{number:03d}"
        rng = np.random.default_rng(zlib.crc32(name.encode()))
        try:
            draft = _draw(recipe, bases, rng)
        except Unusable as error:
            skipped.append((name, str(error)))
            continue
        split = splits.get(draft.recording, "train")
        for mirrored in (False, True) if recipe.mirrors else (False,):
            motion = draft.motion.mirrored() if mirrored else draft.motion
            posed = Motion.posed(motion.rotations, motion.translation, fps, _skeleton())
            rows.append(
                (_clip(recipe, f"{name}/{draft.recording}", mirrored, split, posed.frames), encode_above_floor(posed))
            )
    if not rows:
        raise ValueError(f"none of {recipe.clips} clips could be made: {skipped[0][1]}")
    return rows, skipped


def _draw(recipe: Recipe, bases: Bases, rng: np.random.Generator) -> Draft:
    """Return the first draw that is usable after foot cleanup. Raises `Unusable` after `MAX_DRAWS` draws."""
    reason = ""
    for _ in range(MAX_DRAWS):
        try:
            draft = recipe.make(bases, rng)
        except (Unusable, SettingError) as error:
            reason = str(error)
            continue
        motion = clean_feet(draft.motion)
        if motion.duration < SHORTEST:
            reason = f"shorter than {SHORTEST:g} s"
        elif recipe.accept(motion):
            return replace(draft, motion=motion)
        else:
            reason = "not accepted"
    raise Unusable(f"none of {MAX_DRAWS} draws is usable; the last: {reason}")


def _clip(recipe: Recipe, name: str, mirrored: bool, split: str, frames: int) -> Clip:
    action = mirror_content(recipe.action) if mirrored else recipe.action
    content = CONTENTS[action]
    return Clip(
        name=f"M/{name}" if mirrored else name,
        content=action,
        style=recipe.origin,
        texts=f"{action}/normal",
        parts=tuple(sorted(content.parts)),
        cyclic=content.cyclic,
        mirrored=mirrored,
        split=split,
        start=0,
        end=frames,
        from_start=recipe.once or recipe.origin == "authored",
    )


def gather(rows: Rows, skipped: Sequence[tuple[str, str]], fps: float | int) -> Cache:
    """Build the cache of made clips, in order, without a fingerprint."""
    clips, features = assemble(rows)
    texts = {clip.texts: describe(clip.content, "normal") for clip in clips}
    return Cache(fps, "smpl", features, clips, texts, tuple(skipped))
