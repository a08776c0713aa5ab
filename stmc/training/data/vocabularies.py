"""The vocabulary of a training data set, which is saved with the model."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection

from stmc.data.cache import Cache
from stmc.motion.body import BodyPart
from stmc.text import TextEncoder
from stmc.text.vocabulary import Content, Sentence, Vocabulary, build_vocabulary


def vocabulary_of(cache: Cache, min_clips: int, encoder: TextEncoder, joined: Collection[str] = ()) -> Vocabulary:
    """Build the vocabulary of a cache's training clips.

    Clips without known body parts belong to an unnamed content: for data sets of individual recordings, such as
    HumanML3D, the vocabulary contains sentences but no contents.

    Args:
        cache: Prepared data.
        min_clips: Contents with fewer training clips have no texts, as in `Dataset`.
        encoder: Sentence encoder of the vocabulary.
        joined: Sentences about two contents, if the training has some. The classifier learns that these say more than
            one content in plain words, as sentences do that clips of one style alone have.
    """
    training = [clip for clip in cache.clips if clip.split == "train"]
    counts: dict[str, int] = defaultdict(int)
    for clip in training:
        counts[clip.content] += 1
    weights: dict[Sentence, float] = defaultdict(float)
    keys: dict[str, set[str]] = defaultdict(set)
    for clip in training:
        if counts[clip.content] >= min_clips:
            parts = frozenset(map(BodyPart, clip.parts))
            content = Content(clip.content, parts, clip.cyclic) if parts else Content()
            for text, share in cache.texts[clip.texts]:
                weights[Sentence(text, content)] += share
                keys[clip.content].add(clip.texts)
    plain: set[str] = set()
    for styles in keys.values():
        styles_with = Counter(text for key in styles for text in {text for text, _ in cache.texts[key]})
        plain |= {text for text, count in styles_with.items() if count > 1 or len(styles) == 1}
    styled = {sentence.text for sentence in weights}.difference(plain)
    return build_vocabulary(weights, encoder, styled.union(joined))
