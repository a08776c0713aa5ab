"""A vocabulary as one safetensors file: embeddings in eight bits, sentences and contents as JSON in its header.

The file may be anybody's: its size is bounded before it is opened, and everything in it is checked. Nothing of it is
run.
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
from stmc.io.untrusted import UnreadableError, cut, load_json, shown
from stmc.motion.body import BodyPart
from stmc.text.vocabulary.sentences import LONGEST_TEXT, Content, Sentence
from stmc.text.vocabulary.vocabulary import Vocabulary

MOST_BYTES = 16 * 2**20
"""Of a file; that of the most sentences that are kept takes 1."""

MOST_SENTENCES, LONGEST_NAME = 20_000, 100
"""Of a file; characters."""

TABLE, EMBEDDINGS = "vocabulary", "embeddings"
_WRITTEN, _WRITTEN_BEFORE = torch.float8_e4m3fn, torch.float16
"""Types of embeddings in files. Eight bits move cosines by a hundredth at most."""
_ROUNDING = 2**-4
"""Eight bits round each number by at most this share of it, so a vector's length by no more."""

_KEYS = ("contents", "known", "others", "threshold")


class VocabularyError(ValueError):
    """A file that is no vocabulary or calibration, or a damaged one; the message names it and says what is wrong."""


def write_vocabulary(vocabulary: Vocabulary, path: Path) -> None:
    """Writes the file, which appears whole or not at all."""
    contents = list(dict.fromkeys(each.content for each in (*vocabulary.known, *vocabulary.others)))
    places = {content: place for place, content in enumerate(contents)}
    table = {
        "contents": [[each.name, [part for part in BodyPart if part in each.parts], each.cyclic] for each in contents],
        "known": [[each.text, places[each.content]] for each in vocabulary.known],
        "others": [[each.text, places[each.content]] for each in vocabulary.others],
        "threshold": vocabulary.threshold,
    }
    numbers = {EMBEDDINGS: vocabulary.embeddings.to(_WRITTEN).contiguous()}
    metadata = {TABLE: json.dumps(table, ensure_ascii=False)}
    write_whole(path, lambda temporary: save_file(numbers, temporary, metadata))


def read_vocabulary(path: Path) -> Vocabulary:
    """The vocabulary of a file that `write_vocabulary` wrote. Raises `VocabularyError` for any other."""
    try:
        if path.stat().st_size > MOST_BYTES:
            raise VocabularyError(f"larger than {MOST_BYTES >> 20} MiB, the limit for such a file")
        with safe_open(path, "pt") as file:
            table = load_json((file.metadata() or {}).get(TABLE, ""))
            names = list(file.keys())
            if names != [EMBEDDINGS]:
                raise VocabularyError(f"{EMBEDDINGS} and nothing else needed, not {shown(names)}")
            embeddings = file.get_tensor(EMBEDDINGS).clone()  # not mapped: the file may be replaced
        return _vocabulary(table, embeddings)
    except (VocabularyError, UnreadableError, SafetensorError, OSError) as error:
        raise VocabularyError(f"{path} cannot be read: {cut(' '.join(str(error).split()), 200)}") from error


def _vocabulary(table: Any, embeddings: torch.Tensor) -> Vocabulary:
    if not isinstance(table, Mapping) or set(table) != set(_KEYS):
        raise VocabularyError(f"{', '.join(_KEYS)} needed, not {shown(table)}")
    contents = [_content(row) for row in _rows(table, "contents", 3)]
    known, others = ([_sentence(row, contents) for row in _rows(table, key, 2)] for key in ("known", "others"))
    threshold = table["threshold"]
    if isinstance(threshold, bool) or not isinstance(threshold, (int, float)) or not abs(threshold) <= 3:
        raise VocabularyError(f"threshold={shown(threshold)}: a number from -3 to 3 needed")
    rows = len(known) + len(others)
    if not known or not others or embeddings.shape[:1] != (rows,) or embeddings.ndim != 2:
        raise VocabularyError(f"embeddings of {len(known)} known sentences and {len(others)} others needed")
    typed = embeddings.dtype in (_WRITTEN, _WRITTEN_BEFORE)
    if not typed or not ((embeddings.float().norm(dim=1) - 1).abs() < _ROUNDING).all():
        raise VocabularyError("embeddings must be of length 1, in eight bits (float8_e4m3fn) or in half precision")
    return Vocabulary(tuple(known), tuple(others), F.normalize(embeddings.float(), dim=1).half(), threshold)


def _rows(table: Mapping[str, Any], key: str, width: int) -> Sequence[Any]:
    rows = table[key]
    if not isinstance(rows, list) or len(rows) > MOST_SENTENCES:
        raise VocabularyError(f"{key}: a list of at most {MOST_SENTENCES} needed")
    for row in rows:
        if not isinstance(row, list) or len(row) != width:
            raise VocabularyError(f"{key}: rows of {width} values needed, not {shown(row)}")
    return rows


def _content(row: Sequence[Any]) -> Content:
    name, parts, cyclic = row
    check_text(name, LONGEST_NAME)
    if not isinstance(parts, list) or any(part not in list(BodyPart) for part in parts) or not isinstance(cyclic, bool):
        raise VocabularyError(f"content {shown(name)}: body parts needed and whether it is cyclic, not {shown(row)}")
    return Content(name, frozenset(map(BodyPart, parts)), cyclic)


def _sentence(row: Sequence[Any], contents: Sequence[Content]) -> Sentence:
    text, place = row
    check_text(text, LONGEST_TEXT)
    if isinstance(place, bool) or not isinstance(place, int) or not 0 <= place < len(contents):
        raise VocabularyError(f"sentence {shown(text)}: the place of a content needed, not {shown(place)}")
    return Sentence(text, contents[place])


def check_text(text: Any, most: int) -> None:
    """Raise `VocabularyError` for anything but a printable text of at most `most` characters."""
    if not isinstance(text, str) or len(text) > most or not text.isprintable():
        raise VocabularyError(f"{shown(text)}: at most {most} printable characters needed")
