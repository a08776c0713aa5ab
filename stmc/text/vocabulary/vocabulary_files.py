"""Vocabularies as safetensors files: embeddings in eight bits, sentences and actions as JSON in the header.

Files are untrusted: their size is limited before they are opened, all values are checked, and no code is run.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from stmc.io.files import write_whole
from stmc.io.untrusted import UnreadableError, load_json, quote, truncate
from stmc.motion.body import BodyPart
from stmc.text.vocabulary.classifier import Classifier
from stmc.text.vocabulary.sentences import LONGEST_TEXT, Content, Sentence
from stmc.text.vocabulary.vocabulary import Vocabulary

MOST_BYTES = 16 * 2**20
"""Size limit of a file; the largest vocabulary that `build_vocabulary` makes takes 1 MiB."""

MOST_SENTENCES, LONGEST_NAME = 20_000, 100
"""Limits of the sentences in a file, and of the characters in the name of an action."""

TABLE, EMBEDDINGS, CLASSIFIER = "vocabulary", "embeddings", "classifier"
_WRITTEN, _WRITTEN_BEFORE = torch.float8_e4m3fn, torch.float16
"""Types of embeddings in new and in older files. Eight bits change cosines by at most 0.01."""
_ROUNDING = 2**-4
"""Greatest relative rounding error of a number in eight bits, and thus of a vector's length."""

_KEYS = ("contents", "known", "others", "threshold")


class VocabularyError(ValueError):
    """A file that is not a vocabulary or calibration, or is damaged; the message names the file and the problem."""


def write_vocabulary(vocabulary: Vocabulary, path: Path) -> None:
    """Write a vocabulary to a file, which is complete or absent."""
    contents = list(dict.fromkeys(sentence.content for sentence in (*vocabulary.known, *vocabulary.others)))
    indices = {content: index for index, content in enumerate(contents)}
    table = {
        "contents": [[item.name, [part for part in BodyPart if part in item.parts], item.cyclic] for item in contents],
        "known": [[sentence.text, indices[sentence.content]] for sentence in vocabulary.known],
        "others": [[sentence.text, indices[sentence.content]] for sentence in vocabulary.others],
        "threshold": vocabulary.threshold,
    }
    numbers = {EMBEDDINGS: vocabulary.embeddings.to(_WRITTEN).contiguous()}
    if vocabulary.classifier is not None:
        numbers[CLASSIFIER] = vocabulary.classifier.weights.half().contiguous()
    metadata = {TABLE: json.dumps(table, ensure_ascii=False)}
    write_whole(path, lambda temporary: save_file(numbers, temporary, metadata))


def read_vocabulary(path: Path) -> Vocabulary:
    """Read a file of `write_vocabulary`. Raises `VocabularyError` for any other file."""
    try:
        if path.stat().st_size > MOST_BYTES:
            raise VocabularyError(f"larger than {MOST_BYTES >> 20} MiB, the limit for such a file")
        with safe_open(path, "pt") as file:
            table = load_json((file.metadata() or {}).get(TABLE, ""))
            names = set(file.keys())
            if not {EMBEDDINGS} <= names <= {EMBEDDINGS, CLASSIFIER}:
                raise VocabularyError(f"must hold {EMBEDDINGS} and at most {CLASSIFIER}, not {quote(sorted(names))}")
            numbers = {name: file.get_tensor(name).clone() for name in names}  # not mapped: the file may be replaced
        return _vocabulary(table, numbers[EMBEDDINGS], numbers.get(CLASSIFIER))
    except (VocabularyError, UnreadableError, SafetensorError, OSError) as error:
        raise VocabularyError(f"{path} cannot be read: {truncate(' '.join(str(error).split()), 200)}") from error


def _vocabulary(table: Any, embeddings: torch.Tensor, classifier: torch.Tensor | None) -> Vocabulary:
    if not isinstance(table, Mapping) or set(table) != set(_KEYS):
        raise VocabularyError(f"must be an object of {', '.join(_KEYS)}, not {quote(table)}")
    contents = [_content(row) for row in _rows(table, "contents", 3)]
    known, others = ([_sentence(row, contents) for row in _rows(table, key, 2)] for key in ("known", "others"))
    threshold = table["threshold"]
    if isinstance(threshold, bool) or not isinstance(threshold, (int, float)) or not abs(threshold) <= 3:
        raise VocabularyError(f"threshold={quote(threshold)}: must be a number from -3 to 3")
    rows = len(known) + len(others)
    if not known or not others or embeddings.shape[:1] != (rows,) or embeddings.ndim != 2:
        raise VocabularyError(f"must hold embeddings of {len(known)} known sentences and {len(others)} others")
    typed = embeddings.dtype in (_WRITTEN, _WRITTEN_BEFORE)
    if not typed or not ((embeddings.float().norm(dim=1) - 1).abs() < _ROUNDING).all():
        raise VocabularyError("embeddings must be of length 1, in eight bits (float8_e4m3fn) or in half precision")
    if classifier is not None:
        classes = len({sentence.content for sentence in known if sentence.content.name}) + 2
        _check_classifier(classifier, (classes, embeddings.shape[1] + 1))
    return Vocabulary(
        tuple(known),
        tuple(others),
        F.normalize(embeddings.float(), dim=1).half(),
        threshold,
        classifier=None if classifier is None else Classifier(classifier),
    )


def _check_classifier(classifier: torch.Tensor, shape: tuple[int, int]) -> None:
    """Raise `VocabularyError` unless a classifier is finite, of the `shape` and in half precision."""
    if classifier.shape != shape or classifier.dtype != torch.float16 or not classifier.isfinite().all():
        raise VocabularyError(f"the classifier must be {shape[0]} by {shape[1]} finite numbers in half precision")


def _rows(table: Mapping[str, Any], key: str, width: int) -> Sequence[Any]:
    rows = table[key]
    if not isinstance(rows, list) or len(rows) > MOST_SENTENCES:
        raise VocabularyError(f"{key}: must be a list of at most {MOST_SENTENCES}")
    for row in rows:
        if not isinstance(row, list) or len(row) != width:
            raise VocabularyError(f"{key}: must be rows of {width} values, not {quote(row)}")
    return rows


def _content(row: Sequence[Any]) -> Content:
    name, parts, cyclic = row
    check_text(name, LONGEST_NAME)
    if not isinstance(parts, list) or any(part not in list(BodyPart) for part in parts) or not isinstance(cyclic, bool):
        raise VocabularyError(f"content {quote(name)}: must have body parts and a cyclic flag, not {quote(row)}")
    return Content(name, frozenset(map(BodyPart, parts)), cyclic)


def _sentence(row: Sequence[Any], contents: Sequence[Content]) -> Sentence:
    text, index = row
    check_text(text, LONGEST_TEXT)
    if isinstance(index, bool) or not isinstance(index, int) or not 0 <= index < len(contents):
        raise VocabularyError(f"sentence {quote(text)}: must have the index of a content, not {quote(index)}")
    return Sentence(text, contents[index])


def check_text(text: Any, most: int) -> None:
    """Raise `VocabularyError` unless a value is a printable text of at most `most` characters."""
    if not isinstance(text, str) or len(text) > most or not text.isprintable():
        raise VocabularyError(f"{quote(text)}: must be at most {most} printable characters")
