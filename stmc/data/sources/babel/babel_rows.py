"""BABEL as FlowMDM is trained on it (Barquero et al. 2024, section 4.1, and its code): rows of consecutive actions,
each row a motion of its own; and for its evaluation single actions and whole recordings.

Knows BABEL's labels and which of them follow each other; knows no files of recordings (see `amass`).
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import torch

from stmc.data.cache import Cache
from stmc.data.preparation import LayoutError
from stmc.data.sources.amass.annotated_amass import Recording
from stmc.data.sources.amass.annotations import Annotated, Annotations, Segment, babel_entries
from stmc.data.spans import AnnotatedSpans, CacheBuilder
from stmc.motion.body_model import Skeleton
from stmc.motion.representation import BabelRepresentation

TRANSITION = "transition"
"""The label of what lies between two actions."""

MOST_TEXTS = 10
"""Of a row."""

MOST_SECONDS = 1e5
"""Of a label: longer than any recording."""

Span = tuple[int, int]
"""First frame and the one after the last, as BABEL's seconds say; spans may overlap and leave gaps."""


def read_babel_labels(folder: str | Path, spelling: str | Path | None = None) -> Annotations:
    """The labels of frames in a folder's `train.json` and `val.json`, as TEACH takes them: processed labels, with
    transitions as actions, and no sequences that are labelled as a whole only. `spelling`: a file of corrections,
    `{"wrong": "right"}` (TEACH's own are not ours to ship). Nothing is mirrored.

    Raises `LayoutError` for files in another format.
    """
    corrections = _corrections(spelling)
    entries, skipped = [], list[tuple[str, str]]()
    for name, path, split, value in babel_entries(Path(folder), skipped):
        labelled = value.get("frame_ann")
        labels = labelled.get("labels") if isinstance(labelled, Mapping) else None
        if not isinstance(labels, list):
            skipped.append((name, "no labels of frames"))
            continue
        segments = []
        for label in labels:
            try:
                segments.append(_segment(label, corrections))
            except ValueError as error:
                skipped.append((name, str(error)))
        entries.append(Annotated(name, path, False, split, tuple(segments)))
    return Annotations(tuple(entries), tuple(skipped))


@dataclass(frozen=True)
class RowConversion:
    """How a recording becomes rows, on the skeleton with these bones: those for training last `shortest` to `longest`
    seconds and are `chains` of actions, each with the features of a motion that begins with it; of others every action
    is a row, and the whole recording, as it stands, is a clip without any text."""

    fps: float | int
    representation: BabelRepresentation
    offsets: tuple[tuple[float, ...], ...]
    shortest: float | int
    longest: float | int

    def __call__(self, recording: Recording, entries: Sequence[Annotated]) -> Cache:
        """The clips of one recording; every entry is left out, with the reason, where it cannot be read."""
        builder, skeleton = CacheBuilder(self.representation.width), Skeleton(torch.tensor(self.offsets))
        try:
            motion = recording.motion(skeleton, self.fps)
        except ValueError as error:
            builder.skipped += [(entry.name, str(error)) for entry in entries]
            return builder.cache(self.fps, "babel")
        for entry in entries:
            labels = self._labels(entry, len(motion))
            for number, (edges, texts) in enumerate(self._rows(labels, entry.split)):
                rows = self.representation.encode(motion.trimmed(edges[0], edges[-1])).float()
                spans = {
                    (begin - edges[0], end - edges[0]): [text]
                    for (begin, end), text in zip(pairwise(edges), texts, strict=True)
                }
                builder.add(rows, AnnotatedSpans(f"{entry.name}-{number}", entry.split, False, spans))
            if entry.split != "train":
                whole = self.representation.differentiate(motion.rotations, motion.translation).float()
                builder.add(whole, AnnotatedSpans(entry.name, entry.split, False, {(0, len(whole)): []}))
        return builder.cache(self.fps, "babel")

    def _labels(self, entry: Annotated, frames: int) -> dict[Span, str]:
        """The actions within the recording, by their frames; of two with the same frames the later one."""
        spans = {}
        for segment in sorted(entry.segments, key=lambda each: (int(each.start * self.fps), int(each.end * self.fps))):
            span = int(segment.start * self.fps), min(frames, int(segment.end * self.fps))
            if span[0] < span[1]:
                spans[span] = segment.text
        return spans

    def _rows(self, labels: Mapping[Span, str], split: str) -> Iterator[tuple[list[int], list[str]]]:
        """Edges between texts, and the texts."""
        shortest, longest = round(self.shortest * self.fps), round(self.longest * self.fps)
        found = chains(labels, longest) if split == "train" else [(span,) for span in labels]
        for chain in found:
            edges, texts = consecutive(chain), [labels[span] for span in chain]
            lasting = shortest <= edges[-1] - edges[0] <= longest and texts != [TRANSITION]
            if (lasting or split != "train") and all(begin < end for begin, end in pairwise(edges)):
                yield edges, texts


def chains(labels: Mapping[Span, str], most_frames: int) -> list[tuple[Span, ...]]:
    """All rows of actions that follow each other, each once, none longer than `most_frames` but single actions.

    One action follows another that it overlaps and outlasts, or to which a transition leads from the other; the
    transition itself has no place in the row, but where it is what follows another. A row ends where nothing follows,
    or before what would make it too long, and after `MOST_TEXTS`. An action that nothing follows is no row.
    """
    before = {span: [other for other in labels if _follows(span, other)] for span in labels}
    after = {span: [other for other in labels if _follows(other, span)] for span in labels}

    def grown(last: Span, row: tuple[Span, ...]) -> Iterator[tuple[Span, ...]]:
        if labels[last] == TRANSITION and last[0] and before[last] and after[last]:
            pairs = [(*row, end) if row else (begin, end) for begin, end in product(before[last], after[last])]
        elif acting := [span for span in after[last] if labels[span] != TRANSITION]:
            pairs = [(*row, end) if row else (last, end) for end in acting]
        else:
            for span in after[last] if row else ():
                yield from grown(span, row)
            if row and not after[last]:
                yield row
            return
        for pair in dict.fromkeys(tuple(sorted(pair)) for pair in pairs):
            if pair[-1][1] - pair[0][0] > most_frames or len(pair) > MOST_TEXTS:
                yield pair[:-1]
            else:
                yield from grown(pair[-1], pair)

    return list(dict.fromkeys(row for span in labels for row in grown(span, ())))


def consecutive(row: Sequence[Span]) -> list[int]:
    """The edges of the row's actions, where two meet in the middle of what they share or of what lies between them."""
    middles, end = [], row[0][1]
    for following in row[1:]:
        middles.append(end + (following[0] - end) // 2 + 1)
        end = following[1]
    return [row[0][0], *middles, row[-1][1]]


def _follows(span: Span, other: Span) -> bool:
    return other[0] < span[0] <= other[1] < span[1]


def _segment(label: Any, corrections: Mapping[str, str]) -> Segment:
    text = label.get("proc_label") if isinstance(label, Mapping) else None
    if not isinstance(text, str) or not text.strip():
        raise ValueError("a label without proc_label")
    start, end = label.get("start_t"), label.get("end_t")
    for moment in (start, end):
        if not isinstance(moment, (int, float)) or isinstance(moment, bool) or not 0 <= moment < MOST_SECONDS:
            raise ValueError(f"label {text[:60]!r}: start_t {start!r:.20} and end_t {end!r:.20} must be seconds")
    words = " ".join(text.split())
    return Segment(corrections.get(words, words), float(start), float(end))


def _corrections(path: str | Path | None) -> dict[str, str]:
    if path is None:
        return {}
    place = Path(path).expanduser()
    try:
        content = json.loads(place.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise LayoutError(f"{place} is not a JSON file of corrections: {error}") from error
    if not isinstance(content, dict) or not all(isinstance(each, str) for each in content.values()):
        raise LayoutError(f'{place} must be an object of texts, {{"wrong": "right"}}')
    return content
