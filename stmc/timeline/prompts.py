"""Timelines: short texts, each with a start and an end in seconds and the body parts it claims (STMC, section 3.1).

Knows seconds, tracks and SINC's order among prompts that hold at once; `files` and `drawing` know what they look like.
Frames appear only as `int(fps * seconds)`; who owns what, and what a denoiser is asked, are decided elsewhere.
"""

from __future__ import annotations

import html
import math
import warnings
from collections.abc import Collection, Iterable, Sequence
from dataclasses import InitVar, dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path

from stmc.body import BodyPart
from stmc.timeline import files
from stmc.timeline.drawing import draw
from stmc.timeline.files import Draft, Entry, TimelineError


class TimelineWarning(UserWarning):
    """Something a timeline can mean but hardly wants, such as one body part claimed by two prompts at once."""


@dataclass(frozen=True)
class Prompt:
    """A text that holds from `start` to `end`.

    Args:
        text: What to do. Runs of white space become one space.
        start: Seconds, 0 or later; kept as a float.
        end: Seconds, later than `start`; kept as a float.
        parts: The body parts the text is about, as `BodyPart` or by name; kept as a frozenset of `BodyPart`. None
            listed means the whole body: the prompt claims all five parts and yields to any prompt that lists some.

    Raises:
        TimelineError: For an empty text, times that are not finite, negative or not in order, or an unknown part.
    """

    text: str
    start: int | float
    end: int | float
    parts: Collection[str] = frozenset()

    def __post_init__(self) -> None:
        object.__setattr__(self, "text", " ".join(self.text.split()))
        if not self.text:
            raise TimelineError('the text is empty; say what to do, such as "walk forwards"')
        for name in ("start", "end"):
            object.__setattr__(self, name, _seconds(name, getattr(self, name)))
        if self.end <= self.start:
            raise TimelineError(f"end {self.end:g} must be later than start {self.start:g} (seconds)")
        listed = (self.parts,) if isinstance(self.parts, str) else self.parts
        try:
            object.__setattr__(self, "parts", frozenset(BodyPart.parse(part) for part in listed))
        except ValueError as error:
            raise TimelineError(str(error)) from None

    @property
    def claims(self) -> frozenset[BodyPart]:
        """The listed body parts, or all five where none is listed."""
        return self.parts or frozenset(BodyPart)


def _seconds(name: str, value: int | float) -> float:
    try:
        seconds = float(value)
    except OverflowError:  # an integer beyond the floats
        seconds = math.inf
    if not math.isfinite(seconds) or seconds < 0:
        raise TimelineError(f"{name} {value} must be a finite number of seconds, 0 or later")
    return seconds


@dataclass(frozen=True)
class Timeline:
    """An ordered tuple of prompts. The order is the file's and breaks all ties; two prompts may hold at once.

    Times count from 0, whenever the first prompt starts: a moment without a prompt, also the first one, is a gap.

    Args:
        prompts: One or more.
        name: What files made from this timeline are called; may be empty.
        rows: The track of each prompt, for drawing; by default each prompt goes to the first track that is free
            during its span. Not part of equality.
        places: How messages name each prompt, such as "line 3"; by default "prompt 3".

    Raises:
        TimelineError: For no prompt, or two prompts of one track at the same time.

    Warns:
        TimelineWarning: For a body part that two prompts claim at once, saying who gets it in SINC's order.
    """

    prompts: Sequence[Prompt]
    name: str = ""
    rows: Sequence[int] = field(default=(), compare=False, repr=False)
    places: InitVar[Sequence[str]] = ()

    def __post_init__(self, places: Sequence[str]) -> None:
        object.__setattr__(self, "prompts", tuple(self.prompts))
        if not self.prompts:
            raise TimelineError("the timeline is empty; it needs at least one prompt")
        if self.rows and len(self.rows) != len(self.prompts):
            raise TimelineError(f"{len(self.rows)} rows for {len(self.prompts)} prompts; give each prompt one, or none")
        order = sorted(set(self.rows))
        rows = tuple(order.index(row) for row in self.rows) or _first_fit(self.prompts)
        object.__setattr__(self, "rows", rows)
        places = places or [f"prompt {number}" for number in range(1, len(self.prompts) + 1)]
        _refuse_crowded_tracks(self, places)
        for message in _shared_claims(self.prompts, places):
            warnings.warn(message, TimelineWarning, stacklevel=3)

    @classmethod
    def parse(cls, text: str) -> Timeline:
        """The one timeline of a text: a prompt a line, `text # start # end # part # part`, times in seconds.

        Raises `TimelineError` naming the line for what it cannot mean, and for more than one timeline (a blank line
        starts the next): see `parse_all`.
        """
        return _only(cls.parse_all(text), "the text")

    @classmethod
    def parse_all(cls, text: str) -> list[Timeline]:
        """All timelines of a text, with blank lines between them. Errors as `parse`."""
        return [_from_draft(draft) for draft in files.parse_text(text)]

    @classmethod
    def read(cls, path: str | Path) -> Timeline:
        """The one timeline of a `.json` or `.txt` file. Errors as `read_all`, and for more than one timeline."""
        return _only(cls.read_all(path), str(path))

    @classmethod
    def read_all(cls, path: str | Path) -> list[Timeline]:
        """All timelines of a `.json` or `.txt` file, in order.

        JSON is one object or a list of `{"name": "…", "tracks": [[{"text": "…", "start": 0, "end": 4.2, "body_parts":
        ["legs"]}, …], …]}`; name and body_parts may be absent. Text is read as by `parse_all`.

        Raises `TimelineError` naming the line (text) or the path within the document (JSON), the value and the choices.
        """
        return [_from_draft(draft, f"{path}, ") for draft in files.read(Path(path))]

    @staticmethod
    def write_all(timelines: Sequence[Timeline], path: str | Path) -> None:
        """Write timelines to a `.json` or `.txt` file, which appears whole or not at all.

        JSON keeps names, tracks and order, text the order only. Raises `TimelineError` where text cannot hold a prompt
        (a `#` in it), before anything is written.
        """
        files.write([_draft(timeline) for timeline in timelines], Path(path))

    def write(self, path: str | Path) -> None:
        """Write this timeline alone: see `write_all`."""
        self.write_all([self], path)

    @property
    def duration(self) -> float:
        """Seconds from 0 to the last end."""
        return max(prompt.end for prompt in self.prompts)

    @cached_property
    def tracks(self) -> tuple[tuple[Prompt, ...], ...]:
        """The prompts by track, each track in the file's order; `rows` holds each prompt's place in this tuple."""
        numbered = list(zip(self.rows, self.prompts, strict=True))
        return tuple(tuple(p for row, p in numbered if row == track) for track in range(max(self.rows) + 1))

    def spans(self, fps: int | float) -> tuple[tuple[int, int], ...]:
        """Each prompt's (start, end) in frames, half-open: `int(fps * seconds)`. A very short prompt may have none."""
        if not (math.isfinite(fps) and fps > 0):
            raise ValueError(f"fps {fps} must be a positive number of frames per second")
        return tuple((int(fps * prompt.start), int(fps * prompt.end)) for prompt in self.prompts)

    def frames(self, fps: int | float) -> int:
        """How many frames the timeline lasts, from second 0 on."""
        return max(end for _, end in self.spans(fps))

    def shifted(self) -> Timeline:
        """The same timeline with its first start at 0, as the published code reads every file."""
        first = min(prompt.start for prompt in self.prompts)
        moved = [replace(prompt, start=prompt.start - first, end=prompt.end - first) for prompt in self.prompts]
        return replace(self, prompts=tuple(moved)) if first else self

    def __str__(self) -> str:
        """The tracks drawn to scale, then every prompt with its times and body parts."""
        return draw(_draft(self))

    def _repr_html_(self) -> str:
        return f"<pre>{html.escape(str(self))}</pre>"


def elementary(
    spans: Iterable[tuple[int | float, int | float]],
) -> list[tuple[int | float, int | float, tuple[int, ...]]]:
    """Cut time at every start and end: (start, end, indexes of the spans that hold throughout), gaps between included.

    Seconds or frames alike; empty spans are ignored (Appendix B, Figure A.1 left).
    """
    numbered = [(index, start, end) for index, (start, end) in enumerate(spans) if start < end]
    cuts = sorted({time for _, *times in numbered for time in times})
    return [
        (left, right, tuple(index for index, start, end in numbered if start <= left and right <= end))
        for left, right in pairwise(cuts)
    ]


def sinc_order(prompts: Sequence[Prompt], active: Iterable[int]) -> list[int]:
    """The active prompts' indexes in SINC's order: the base first, then each may override those before it.

    The base is the prompt with most parts among those that claim the legs, or among all if none does; the others
    follow in decreasing number of parts. Ties fall to the file's order (Appendix B; R2). So a part claimed twice goes
    to the prompt with fewer parts, then to the later one; the base always yields.
    """
    ranked = sorted(sorted(active), key=lambda index: -len(prompts[index].claims))
    base = next((index for index in ranked if BodyPart.LEGS in prompts[index].claims), ranked[0])
    return [base, *(index for index in ranked if index != base)]


def _shared_claims(prompts: Sequence[Prompt], places: Sequence[str]) -> list[str]:
    """One message per pair of prompts that claim a part at once; a prompt that lists none yields without a word."""
    shared: dict[tuple[int, int], set[BodyPart]] = {}
    for _, _, active in elementary((prompt.start, prompt.end) for prompt in prompts):
        order = sinc_order(prompts, active) if active else []
        for part in BodyPart:
            claimants = [index for index in order if part in prompts[index].claims]
            for loser in claimants[:-1]:
                if bool(prompts[loser].parts) == bool(prompts[claimants[-1]].parts):
                    shared.setdefault((loser, claimants[-1]), set()).add(part)
    return [
        f"{places[loser]} ({prompts[loser].text!r}) and {places[winner]} ({prompts[winner].text!r}) claim "
        f"{_listed(parts)} at the same time; {places[winner]} gets it, as in SINC's order"
        for (loser, winner), parts in shared.items()
    ]


def _refuse_crowded_tracks(timeline: Timeline, places: Sequence[str]) -> None:
    for later, prompt in enumerate(timeline.prompts):
        for earlier, other in enumerate(timeline.prompts[:later]):
            if timeline.rows[earlier] == timeline.rows[later] and _together(prompt, other):
                raise TimelineError(
                    f"{places[later]} ({prompt.text!r}, {prompt.start:g} to {prompt.end:g} s) is in the same track as "
                    f"{places[earlier]} ({other.text!r}, {other.start:g} to {other.end:g} s) at the same time; "
                    "the prompts of a track follow each other: move one in time or to another track"
                )


def _first_fit(prompts: Sequence[Prompt]) -> tuple[int, ...]:
    tracks: list[list[Prompt]] = []
    rows = []
    for prompt in prompts:
        free = (row for row, track in enumerate(tracks) if not any(_together(prompt, other) for other in track))
        row = next(free, len(tracks))
        if row == len(tracks):
            tracks.append([])
        tracks[row].append(prompt)
        rows.append(row)
    return tuple(rows)


def _together(one: Prompt, other: Prompt) -> bool:
    return one.start < other.end and other.start < one.end


def _listed(parts: Collection[BodyPart]) -> str:
    return ", ".join(part for part in BodyPart if part in parts)


def _only(timelines: list[Timeline], source: str) -> Timeline:
    if len(timelines) > 1:
        raise TimelineError(f"{source} holds {len(timelines)} timelines, not one; use read_all or parse_all")
    return timelines[0]


def _draft(timeline: Timeline) -> Draft:
    rows = zip(timeline.rows, timeline.prompts, strict=True)
    entries = [
        Entry("", row, prompt.text, prompt.start, prompt.end, tuple(part for part in BodyPart if part in prompt.parts))
        for row, prompt in rows
    ]
    return Draft("", timeline.name, entries)


def _from_draft(draft: Draft, source: str = "") -> Timeline:
    if not draft.entries:
        raise TimelineError(f"{source}{draft.place or 'the document'}: the timeline is empty; it needs a prompt")
    places = [f"{source}{entry.place}" for entry in draft.entries]
    prompts = []
    for place, entry in zip(places, draft.entries, strict=True):
        try:
            prompts.append(Prompt(entry.text, entry.start, entry.end, entry.parts))
        except TimelineError as error:
            raise TimelineError(f"{place}: {error}") from None
    rows = [entry.track for entry in draft.entries if entry.track is not None]
    return Timeline(prompts, draft.name, rows, places)
