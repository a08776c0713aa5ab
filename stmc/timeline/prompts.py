"""Timelines: short texts, each with a start and an end in seconds and the body parts it claims (STMC, section 3.1).

This module checks seconds and limits. `overlaps` finds the prompts that hold at each time, `rows` the tracks;
`timeline_files` and `printing` read, write and draw. Frames appear only as `int(fps * seconds)`.
"""

from __future__ import annotations

import html
import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from stmc.io.bounds import MOST_SECONDS
from stmc.io.untrusted import quote
from stmc.motion.body import BodyPart
from stmc.timeline import timeline_files as files
from stmc.timeline.advice import advise
from stmc.timeline.overlaps import Precedence, sweep
from stmc.timeline.printing import draw, typed
from stmc.timeline.rows import crowded, first_fit, renumbered
from stmc.timeline.timeline_files import Draft, Entry, TimelineError

LATEST = MOST_SECONDS
"""Maximum end of a prompt in seconds (four hours): the features of a model alone then take 0.25 GB at 20 fps."""

MOST_FRAMES, MOST_PROMPTS = 10_000_000, 10_000
"""Maximum frames (at any frame rate) and prompts of a timeline; 10,000 prompts take a second to read and plan."""

LONGEST_TEXT = 1_000_000
"""Maximum number of characters of a text; text encoders read some hundred words."""


@dataclass(frozen=True)
class Prompt:
    """A text that holds from `start` to `end`.

    Args:
        text: Description of the action, with at most `LONGEST_TEXT` characters. Runs of white space become one space.
        start: Start in seconds, 0 or later; stored as a float.
        end: End in seconds, later than `start` and not after `LATEST`; stored as a float.
        parts: Body parts that the text describes, as `BodyPart` or by name; stored as a frozenset of `BodyPart`. An
            empty collection means the whole body: the prompt claims all five parts and yields to any prompt that lists
            some.

    Raises:
        TimelineError: If the text is empty, too long or has a lone surrogate, if a time is not finite, negative or too
            late, if `end` is not later than `start`, or if a part is unknown.

    Examples:
        >>> prompt = stmc.Prompt("wave", 0, 2.5, ["right arm"])
        >>> prompt.text, prompt.end, sorted(prompt.parts)
        ('wave', 2.5, [<BodyPart.RIGHT_ARM: 'right arm'>])
    """

    text: str
    start: int | float
    end: int | float
    if TYPE_CHECKING:  # the constructor converts `parts`
        parts: frozenset[BodyPart]

        def __init__(self, text: str, start: int | float, end: int | float, parts: Collection[str] = frozenset()): ...

    else:
        parts: Collection[str] = frozenset()

    def __post_init__(self) -> None:
        if not isinstance(self.text, str) or not isinstance(self.parts, Collection):
            raise TimelineError(f"a prompt needs a text and a list of body parts; got {quote([self.text, self.parts])}")
        object.__setattr__(self, "text", " ".join(self.text.split()))
        if not self.text:
            raise TimelineError('the text is empty; say what to do, such as "walk forwards"')
        if len(self.text) > LONGEST_TEXT:
            raise TimelineError(f"the text {quote(self.text)} is longer than {LONGEST_TEXT:,} characters, the limit")
        _check_surrogates("text", self.text)
        for name in ("start", "end"):
            object.__setattr__(self, name, _seconds(name, getattr(self, name)))
        if self.end <= self.start:
            raise TimelineError(f"end {self.end:g} must be later than start {self.start:g} (seconds)")
        if self.end > LATEST:
            raise TimelineError(f"end {self.end:g} is later than {LATEST} seconds, the limit")
        parts = []
        for part in (self.parts,) if isinstance(self.parts, str) else self.parts:
            try:
                parts.append(BodyPart.parse(part))
            except ValueError:
                raise TimelineError(f"unknown body part {quote(part)}; choose from {', '.join(BodyPart)}") from None
        object.__setattr__(self, "parts", frozenset(parts))

    def __repr__(self) -> str:
        return typed(self.text, self.start, self.end, [str(part) for part in BodyPart if part in self.parts])

    @property
    def claims(self) -> frozenset[BodyPart]:
        """The listed body parts, or all five if none is listed."""
        return self.parts or frozenset(BodyPart)


def _seconds(name: str, value: int | float) -> float:
    try:
        seconds = float(value)
    except (OverflowError, TypeError, ValueError):  # an integer beyond the float range, a text, a list
        seconds = math.inf
    if not math.isfinite(seconds) or seconds < 0:
        raise TimelineError(f"{name} {quote(value)} must be a finite number of seconds, 0 or later")
    return seconds


def _check_surrogates(name: str, text: str) -> None:
    try:
        text.encode("utf-8")
    except UnicodeEncodeError as error:
        raise TimelineError(f"the {name} {quote(text)} has a lone surrogate, {quote(text[error.start])}") from None


@dataclass(frozen=True)
class Timeline:
    """An ordered tuple of prompts. The order is that of the file and breaks all ties; prompts may overlap in time.

    Times count from 0, whenever the first prompt starts: a time without a prompt, also at the beginning, is a gap.

    Args:
        prompts: One to `MOST_PROMPTS` prompts.
        name: Name of the files made from this timeline; may be empty.
        rows: Track of each prompt, for drawing; by default the first free track. Ignored by equality.
        places: Name of each prompt in messages, such as "line 3"; by default "prompt 3". Ignored by equality.

    Raises:
        TimelineError: If there are no or too many prompts, two prompts of a track overlap, or the name has a lone
            surrogate.

    Warns:
        TimelineWarning: Once, if two prompts claim a body part at the same time; names the prompt that gets the part.

    Examples:
        >>> print(stmc.Timeline([stmc.Prompt("walk", 0, 4), stmc.Prompt("wave", 1, 3, ["right arm"])]))
        timeline: 4 s, 2 prompts
        0 s      0.5       1        1.5       2        2.5       3        3.5       4
        [1 walk····································································]
                           [2 wave······························]
        1  walk  0 to 4 s  whole body
        2  wave  1 to 3 s  right arm
    """

    prompts: Sequence[Prompt]
    name: str = ""
    rows: Sequence[int] = field(default=(), compare=False, repr=False)
    places: Sequence[str] = field(default=(), compare=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "prompts", tuple(self.prompts))
        if not self.prompts:
            raise TimelineError("the timeline is empty; it needs at least one prompt")
        count = len(self.prompts)
        places = tuple(self.places) or tuple(f"prompt {number}" for number in range(1, count + 1))
        if count > MOST_PROMPTS:
            raise TimelineError(f"{places[MOST_PROMPTS]}: a timeline of {count} prompts; the limit is {MOST_PROMPTS}")
        for name, values in (("rows", self.rows), ("places", places)):
            if values and len(values) != count:
                raise TimelineError(f"{len(values)} {name} for {count} prompts; pass one per prompt, or none")
        _check_surrogates("name", self.name)
        spans = [(prompt.start, prompt.end) for prompt in self.prompts]
        object.__setattr__(self, "places", places)
        object.__setattr__(self, "rows", renumbered(self.rows) or first_fit(spans))
        if overlap := crowded(spans, self.rows):
            raise TimelineError(_crowded_track(self, *overlap))
        if message := _shared_claims(self.prompts, places):
            advise(message)

    @classmethod
    def parse(cls, text: str, suffix: str = ".txt") -> Timeline:
        r"""Parse one timeline: text with one prompt per line, `text # start # end # part # part` (seconds), or JSON.

        `suffix` is that of a file in the same format. Raises `TimelineError` if the document is invalid (the message
        names the place) or holds several timelines (in text, a blank line starts the next one); see `parse_all`.

        Examples:
            >>> timeline = stmc.Timeline.parse("walk # 0 # 4 # legs\nwave # 1 # 3 # right arm")
            >>> [prompt.text for prompt in timeline.prompts]
            ['walk', 'wave']
            >>> stmc.Timeline.parse(timeline.to_json(), ".json") == timeline
            True
        """
        return _only(cls.parse_all(text, suffix), "the text")

    @classmethod
    def parse_all(cls, text: str, suffix: str = ".txt") -> list[Timeline]:
        r"""Parse all timelines of a document in the format of files with that suffix; errors as for `read_all`.

        Examples:
            >>> len(stmc.Timeline.parse_all("walk # 0 # 4\n\nwave # 0 # 2\nnod # 2 # 3"))
            2
        """
        return [_from_draft(draft) for draft in files.parse(text, suffix)]

    @classmethod
    def read(cls, path: str | Path) -> Timeline:
        """Read a `.json` or `.txt` file that holds one timeline; errors as for `read_all`, and for several timelines.

        Examples:
            >>> stmc.Timeline.parse("walk # 0 # 4").write("walk.txt")
            >>> stmc.Timeline.read("walk.txt").duration
            4.0
        """
        return _only(cls.read_all(path), files.named(path))

    @classmethod
    def read_all(cls, path: str | Path) -> list[Timeline]:
        r"""Read all timelines of a `.json` or `.txt` file, in order.

        JSON is one object or a list of `{"name": "…", "tracks": [[{"text": "…", "start": 0, "end": 4.2, "body_parts":
        ["legs"]}, …], …]}`; name and body_parts are optional. Text has one prompt per line, as in `parse`, with blank
        lines between timelines. Raises `TimelineError` with the line (text) or the path within the document (JSON), the
        value and the legal values.

        Examples:
            >>> stmc.Timeline.write_all(stmc.Timeline.parse_all("walk # 0 # 4\n\nwave # 0 # 2"), "two.json")
            >>> [timeline.duration for timeline in stmc.Timeline.read_all("two.json")]
            [4.0, 2.0]
        """
        return [_from_draft(draft, f"{files.named(path)}, ") for draft in files.read(Path(path))]

    @staticmethod
    def write_all(timelines: Sequence[Timeline], path: str | Path) -> None:
        """Write timelines to a `.json` or `.txt` file, which appears complete or not at all.

        JSON preserves names, tracks and order; text preserves the order only. Raises `TimelineError`, before anything
        is written, if text cannot represent a prompt (because it contains a `#`).

        Examples:
            >>> stmc.Timeline.write_all([stmc.Timeline.parse("walk # 0 # 4")], "walk.txt")
            >>> print(open("walk.txt").read().strip())
            walk # 0.0 # 4.0
        """
        files.write([_draft(timeline) for timeline in timelines], Path(path))

    def write(self, path: str | Path) -> None:
        """Write this timeline alone; see `write_all`.

        Examples:
            >>> stmc.Timeline.parse("walk # 0 # 4").write("walk.json")
        """
        self.write_all([self], path)

    def to_json(self) -> str:
        """Return the JSON that `write` puts into a `.json` file.

        Examples:
            >>> print(stmc.Timeline.parse("walk # 0 # 4 # legs").to_json())
            {"name": "", "tracks": [
              [{"text": "walk", "start": 0.0, "end": 4.0, "body_parts": ["legs"]}]]}
            <BLANKLINE>
        """
        return files.to_json([_draft(self)])

    def to_text(self) -> str:
        r"""Return the text that `write` puts into a `.txt` file. Raises `TimelineError` if a prompt contains a `#`.

        Examples:
            >>> stmc.Timeline.parse("walk # 0 # 4 # legs").to_text()
            'walk # 0.0 # 4.0 # legs\n'
        """
        return files.to_text([_draft(self)])

    @property
    def duration(self) -> float:
        """Seconds from 0 to the last end."""
        return max(prompt.end for prompt in self.prompts)

    @cached_property
    def tracks(self) -> tuple[tuple[Prompt, ...], ...]:
        """The prompts by track, each track in the file's order; `rows` holds each prompt's index in this tuple."""
        tracks: list[list[Prompt]] = [[] for _ in range(max(self.rows) + 1)]
        for row, prompt in zip(self.rows, self.prompts, strict=True):
            tracks[row].append(prompt)
        return tuple(map(tuple, tracks))

    def spans(self, fps: int | float) -> tuple[tuple[int, int], ...]:
        r"""Convert each prompt to frames: half-open (start, end), computed as `int(fps * seconds)`.

        The span of a very short prompt may be empty. Raises `TimelineError` if the timeline has more than `MOST_FRAMES`
        frames, and `ValueError` if `fps` is not positive and finite.

        Examples:
            >>> timeline = stmc.Timeline.parse("walk # 0 # 4 # legs\nwave # 1 # 3 # right arm")
            >>> timeline.spans(fps=20)
            ((0, 80), (20, 60))
        """
        if not (fps > 0 and fps < math.inf):
            raise ValueError(f"fps {fps} must be a positive number of frames per second")
        if fps > MOST_FRAMES / self.duration:
            length = f"{self.duration:g} s at {quote(fps)} fps are more than {MOST_FRAMES:,} frames, the limit"
            raise TimelineError(f"{self.place}: {length}")
        return tuple((int(fps * prompt.start), int(fps * prompt.end)) for prompt in self.prompts)

    @property
    def place(self) -> str:
        """The timeline's name in messages: its own name, if any, and the place of its first prompt."""
        return f"timeline {quote(self.name)}, {self.places[0]}" if self.name else self.places[0]

    def frames(self, fps: int | float) -> int:
        """Count the frames of the timeline, from second 0 on.

        Examples:
            >>> stmc.Timeline.parse("walk # 0 # 4").frames(fps=20)
            80
        """
        return max(end for _, end in self.spans(fps))

    def shifted(self) -> Timeline:
        """Return the same timeline with its first start at 0, as the published code reads every file.

        Examples:
            >>> stmc.Timeline.parse("walk # 1 # 4").shifted().duration
            3.0
        """
        first = min(prompt.start for prompt in self.prompts)
        prompts = [replace(prompt, start=prompt.start - first, end=prompt.end - first) for prompt in self.prompts]
        return replace(self, prompts=tuple(prompts)) if first else self

    def __str__(self) -> str:
        """Draw the tracks to scale, then list every prompt with its times and body parts."""
        return draw(_draft(self))

    def _repr_html_(self) -> str:
        return f"<pre>{html.escape(str(self))}</pre>"


MAX_PAIRS_NAMED, MAX_PAIRS_COUNTED = 3, 50
"""Pairs of prompts with a shared part: the number that a warning names, and the number up to which it counts."""


def _shared_claims(prompts: Sequence[Prompt], places: Sequence[str]) -> str:
    """Describe the prompts that claim a part at once; a prompt that lists no part yields silently."""
    shared: dict[tuple[int, int], tuple[float, set[BodyPart]]] = {}
    precedence = Precedence([prompt.parts for prompt in prompts])
    for start, _, ended, started in sweep((prompt.start, prompt.end) for prompt in prompts):
        precedence.update(ended, started)
        for part in BodyPart:
            if (owner := precedence.owner(part)) is not None:
                for rival in precedence.rivals(part):
                    shared.setdefault((rival, owner), (start, set()))[1].add(part)
        if len(shared) > MAX_PAIRS_COUNTED:
            break
    names = [f"{quote(prompt.text)} ({place})" for prompt, place in zip(prompts, places, strict=True)]
    conflicts = [
        f"{names[loser]} and {names[winner]} both claim {_listed(parts)} at {start:g} s; {names[winner]} gets it"
        for (loser, winner), (start, parts) in list(shared.items())[:MAX_PAIRS_NAMED]
    ]
    if len(shared) > MAX_PAIRS_NAMED:
        most = f"more than {MAX_PAIRS_COUNTED}" if len(shared) > MAX_PAIRS_COUNTED else str(len(shared))
        conflicts.append(f"these are {MAX_PAIRS_NAMED} of {most} such pairs")
    return "\n".join(conflicts)


def _crowded_track(timeline: Timeline, later: int, earlier: int) -> str:
    one, other = (
        f"({quote(prompt.text)}, {prompt.start:g} to {prompt.end:g} s)"
        for prompt in (timeline.prompts[later], timeline.prompts[earlier])
    )
    return (
        f"{timeline.places[later]} {one} is in the same track as {timeline.places[earlier]} {other} at the same time; "
        "the prompts of a track follow each other: move one in time or to another track"
    )


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
