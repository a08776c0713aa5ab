"""What a training on a data set will have heard: the vocabulary that travels with its model."""

from __future__ import annotations

from collections import defaultdict

from stmc.data.cache import Cache
from stmc.motion.body import BodyPart
from stmc.text import TextEncoder
from stmc.text.vocabulary import Content, Sentence, Vocabulary, build_vocabulary


def vocabulary_of(cache: Cache, min_clips: int, encoder: TextEncoder) -> Vocabulary:
    """The vocabulary of a training on the cache's training clips, in which contents of fewer than `min_clips` have no
    texts (as in `Dataset`). A clip of no known body parts is a content without a name: of a data set of one-off
    recordings, such as HumanML3D, sentences are known and no contents."""
    training = [clip for clip in cache.clips if clip.split == "train"]
    counts: dict[str, int] = defaultdict(int)
    for clip in training:
        counts[clip.content] += 1
    weights: dict[Sentence, float] = defaultdict(float)
    for clip in training:
        if counts[clip.content] >= min_clips:
            parts = frozenset(map(BodyPart, clip.parts))
            content = Content(clip.content, parts, clip.cyclic) if parts else Content()
            for text, share in cache.texts[clip.texts]:
                weights[Sentence(text, content)] += share
    return build_vocabulary(weights, encoder)
