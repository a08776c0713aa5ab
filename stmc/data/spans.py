"""Spans of frames with sentences → clips and their texts, for data sets of unique recordings."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from stmc.data.cache import Cache, Clip


@dataclass(frozen=True)
class AnnotatedSpans:
    """Spans `[begin, end)` of some features, each with its sentences, and with a common name, split and mirroring."""

    name: str
    split: str
    mirrored: bool
    spans: dict[tuple[int, int], list[str]]


class CacheBuilder:
    """A builder of a piece's cache, entry by entry: features, clips and texts."""

    def __init__(self, width: int) -> None:
        self.skipped: list[tuple[str, str]] = []
        self._features, self._clips = [torch.zeros(0, width)], list[Clip]()
        self._texts: dict[str, tuple[tuple[str, float], ...]] = {}
        self._start = 0

    def add(self, features: Float[Tensor, "frames features"], *annotated: AnnotatedSpans) -> None:
        """Add a recording, if anything of it is described, and a clip for every span of each entry.

        The body parts of clips are unknown, and every entry is its own action.
        """
        if any(entry.spans for entry in annotated):
            for entry in annotated:
                self._add(entry, (self._start, self._start + len(features)))
            self._features.append(features)
            self._start += len(features)

    def _add(self, annotated: AnnotatedSpans, whole: tuple[int, int]) -> None:
        spans = annotated.spans
        for number, ((begin, end), sentences) in enumerate(spans.items()):
            name = f"{annotated.name}/{number}" if len(spans) > 1 else annotated.name
            self._clips.append(
                Clip(
                    name=name,
                    content=annotated.name,
                    style="",
                    texts=name,
                    parts=(),
                    cyclic=False,
                    mirrored=annotated.mirrored,
                    split=annotated.split,
                    start=whole[0] + begin,
                    end=whole[0] + end,
                    recording=annotated.name,
                    annotations=len(sentences),
                    whole=whole,
                )
            )
            frequencies = Counter(sentences)
            self._texts[name] = tuple((text, count / len(sentences)) for text, count in frequencies.items())

    def cache(self, fps: float | int, representation: str) -> Cache:
        """Build the cache of everything that was added."""
        features = torch.cat(self._features)
        return Cache(fps, representation, features, tuple(self._clips), self._texts, tuple(self.skipped))
