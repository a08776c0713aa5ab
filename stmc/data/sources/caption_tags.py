"""Parts of speech for captions, as the evaluator of Guo et al. (2022) reads them: `a/DET person/NOUN walk/VERB`.

Knows files of captions with their tags, and spaCy where it is installed; knows no evaluator.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

from stmc.data.sources.humanml3d.humanml3d_texts import Caption, read_captions

MODEL = "en_core_web_sm"
"""The pipeline that HumanML3D's captions were tagged with."""

LEMMAS = ("NOUN", "VERB")
"""Kinds of words that stand as their base form; but for "left"."""


class TagError(ValueError):
    """A caption without tags; the message says which, and where tags could come from."""


class Tags:
    """`tags(texts)`: each text's words with their parts of speech. Those `known` are looked up; of others, `tagged`
    tells them."""

    def __init__(self, known: Mapping[str, str], tagged: Callable[[str], str]) -> None:
        self._known, self._tagged = dict(known), tagged

    @classmethod
    def read(cls, path: str | Path | None = None) -> Tags:
        """Of a file of lines `caption#tagged words#0.0#0.0`, or of all such files in a folder, as HumanML3D's `texts/`;
        what is not among them is tagged by spaCy (`path` None: all is). Raises `TagError` for a path that is
        neither."""
        if path is None:
            return cls({}, by_spacy)
        place = Path(path).expanduser()
        if not place.exists():
            raise TagError(f"{place} does not exist: a file of lines caption#tagged words#0.0#0.0, or a folder of them")
        files: Iterable[Path] = sorted(place.glob("*.txt")) if place.is_dir() else [place]
        captions = (caption for file in files for caption in read_captions(file))
        return cls({each.text: each.tagged for each in captions if isinstance(each, Caption) and each.tagged}, by_spacy)

    def __call__(self, texts: Iterable[str]) -> list[str]:
        return [self._known.get(" ".join(text.split())) or self._tagged(text) for text in texts]


def by_spacy(text: str) -> str:
    """As HumanML3D's captions were tagged: hyphens go, words of letters alone stay, nouns and verbs in their base form.

    Raises `TagError` where spaCy or its pipeline is not installed.
    """
    words = []
    for token in _pipeline(text)(text.replace("-", "")):
        if token.text.isalpha():
            base = token.pos_ in LEMMAS and token.text != "left"
            words.append(f"{token.lemma_ if base else token.text}/{token.pos_}")
    return " ".join(words)


def _pipeline(text: str) -> Callable[[str], Iterable]:
    try:
        return _loaded()
    except (ImportError, OSError) as error:  # spaCy's own error for a pipeline that is not there
        raise TagError(
            f"the caption {text[:60]!r} has no parts of speech: give a file with it (caption#tagged words#0.0#0.0, as "
            f"in HumanML3D's texts/), or install spacy and its pipeline {MODEL}"
        ) from error


@functools.cache
def _loaded() -> Callable[[str], Iterable]:
    import spacy

    return spacy.load(MODEL)
