"""Parts of speech of captions for the evaluator of Guo et al. (2022): `a/DET person/NOUN walk/VERB`."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

from stmc.data.sources.humanml3d.humanml3d_texts import Caption, read_captions

MODEL = "en_core_web_sm"
"""The spaCy pipeline that tagged HumanML3D's captions."""
LEMMAS = ("NOUN", "VERB")
"""Parts of speech that are replaced by their base form, except for "left"."""


class TagError(ValueError):
    """A caption without tags; the message names it and the possible sources of tags."""


class Tags:
    """Tagger of texts: `tags(texts)` returns the words of each text with their parts of speech.

    Texts in `known` are looked up; `tagged` tags all others.
    """

    def __init__(self, known: Mapping[str, str], tagged: Callable[[str], str]) -> None:
        self._table, self._tagged = dict(known), tagged

    @classmethod
    def read(cls, path: str | Path | None = None) -> Tags:
        """Read tags from a file of lines `caption#tagged words#0.0#0.0`, or from a folder of such files.

        HumanML3D's `texts/` is such a folder. spaCy tags all other captions (all captions if `path` is None). Raises
        `TagError` if the path does not exist.
        """
        if path is None:
            return cls({}, by_spacy)
        source = Path(path).expanduser()
        if not source.exists():
            raise TagError(
                f"{source} does not exist; pass a file of lines caption#tagged words#0.0#0.0 or a folder of them"
            )
        files: Iterable[Path] = sorted(source.glob("*.txt")) if source.is_dir() else [source]
        captions = (caption for file in files for caption in read_captions(file))
        return cls({line.text: line.tagged for line in captions if isinstance(line, Caption) and line.tagged}, by_spacy)

    def __call__(self, texts: Iterable[str]) -> list[str]:
        return [self._table.get(" ".join(text.split())) or self._tagged(text) for text in texts]


def by_spacy(text: str) -> str:
    """Tag a caption as HumanML3D does: without hyphens, alphabetic words only, nouns and verbs in their base form.

    Raises `TagError` if spaCy or its pipeline is not installed.
    """
    words = []
    for token in _pipeline(text)(text.replace("-", "")):
        if token.text.isalpha():
            use_lemma = token.pos_ in LEMMAS and token.text != "left"
            words.append(f"{token.lemma_ if use_lemma else token.text}/{token.pos_}")
    return " ".join(words)


def _pipeline(text: str) -> Callable[[str], Iterable]:
    try:
        return _load_pipeline()
    except (ImportError, OSError) as error:  # spaCy's own error for a missing pipeline
        raise TagError(
            f"the caption {text[:60]!r} has no parts of speech; pass a file with it (caption#tagged words#0.0#0.0, as "
            f"in HumanML3D's texts/), or install spacy and its pipeline {MODEL}"
        ) from error


@functools.cache
def _load_pipeline() -> Callable[[str], Iterable]:
    import spacy

    return spacy.load(MODEL)
