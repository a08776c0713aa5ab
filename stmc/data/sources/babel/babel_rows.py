"""BABEL for the training of FlowMDM: rows of consecutive actions, each a separate motion.

See Barquero et al. (2024), section 4.1, and its code. Evaluation uses single actions and whole recordings. Depends on
BABEL's labels and their order; independent of files of recordings (see `amass`).
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
"""Label of the transition between two actions."""
MOST_TEXTS = 10
"""Maximum number of texts of a row."""
MOST_SECONDS = 1e5
"""Maximum time of a label in seconds, longer than any recording."""
Span = tuple[int, int]
"""First frame and the frame after the last, from BABEL's seconds; spans may overlap and leave gaps."""


def read_babel_labels(folder: str | Path, spelling: str | Path | None = None) -> Annotations:
    """Read the frame labels in a folder's `train.json` and `val.json`, as TEACH uses them.

    These are processed labels, with transitions as actions, without sequences that are labelled only as a whole.
    Nothing is mirrored. `spelling` is a file of corrections, `{"wrong": "right"}` (we may not distribute TEACH's own).
    Raises `LayoutError` if a file has another format.
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
    """The conversion of recordings to rows.

    Training rows are `chains` of actions, each with the features of a motion that begins with it. In other splits every
    action is a row, and the whole recording, without rotation, is a clip without texts.

    Args:
        fps: Frame rate of the features.
        representation: Representation of the features.
        offsets: Offsets of the skeleton.
        shortest: Minimum duration of a training row in seconds.
        longest: Maximum duration of a training row in seconds.
    """

    fps: float | int
    representation: BabelRepresentation
    offsets: tuple[tuple[float, ...], ...]
    shortest: float | int
    longest: float | int

    def __call__(self, recording: Recording, entries: Sequence[Annotated]) -> Cache:
        """Convert one recording to clips; if it cannot be read, every entry is skipped with the reason."""
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
        """Return the actions within the recording by their frames; the later of two with the same frames wins."""

        def span_of(segment: Segment) -> Span:
            return int(segment.start * self.fps), frames if segment.end is None else int(segment.end * self.fps)

        spans = {}
        for segment in sorted(entry.segments, key=span_of):
            start, end = span_of(segment)
            if start < min(frames, end):
                spans[start, min(frames, end)] = segment.text
        return spans

    def _rows(self, labels: Mapping[Span, str], split: str) -> Iterator[tuple[list[int], list[str]]]:
        """Yield the edges between texts, and the texts."""
        shortest, longest = round(self.shortest * self.fps), round(self.longest * self.fps)
        rows = chains(labels, longest) if split == "train" else [(span,) for span in labels]
        for chain in rows:
            edges, texts = consecutive(chain), [labels[span] for span in chain]
            fits = shortest <= edges[-1] - edges[0] <= longest and texts != [TRANSITION]
            if (fits or split != "train") and all(begin < end for begin, end in pairwise(edges)):
                yield edges, texts


def chains(labels: Mapping[Span, str], most_frames: int) -> list[tuple[Span, ...]]:
    """Return all distinct rows of consecutive actions; only single actions may exceed `most_frames`.

    An action follows another one that it overlaps and outlasts, or from which a transition leads to it; the transition
    itself is not part of the row, unless it is what follows. A row ends where nothing follows, before it would become
    too long, and after `MOST_TEXTS`. An action that nothing follows is no row.
    """
    before = {span: [other for other in labels if _follows(span, other)] for span in labels}
    after = {span: [other for other in labels if _follows(other, span)] for span in labels}

    def extend(last: Span, row: tuple[Span, ...]) -> Iterator[tuple[Span, ...]]:
        if labels[last] == TRANSITION and last[0] and before[last] and after[last]:
            pairs = [(*row, end) if row else (begin, end) for begin, end in product(before[last], after[last])]
        elif actions := [span for span in after[last] if labels[span] != TRANSITION]:
            pairs = [(*row, end) if row else (last, end) for end in actions]
        else:
            for span in after[last] if row else ():
                yield from extend(span, row)
            if row and not after[last]:
                yield row
            return
        for pair in dict.fromkeys(tuple(sorted(pair)) for pair in pairs):
            if pair[-1][1] - pair[0][0] > most_frames or len(pair) > MOST_TEXTS:
                yield pair[:-1]
            else:
                yield from extend(pair[-1], pair)

    return list(dict.fromkeys(row for span in labels for row in extend(span, ())))


def consecutive(row: Sequence[Span]) -> list[int]:
    """Return the edges of a row's actions; two actions meet in the middle of their overlap or gap."""
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
    source = Path(path).expanduser()
    try:
        corrections = json.loads(source.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise LayoutError(f"{source} is not a JSON file of corrections: {error}") from error
    if not isinstance(corrections, dict) or not all(isinstance(word, str) for word in corrections.values()):
        raise LayoutError(f'{source} must be an object of texts, {{"wrong": "right"}}')
    return corrections
