"""Multi-track timeline (MTT) data sets: atomic prompts with their ground truth, and timelines made of them.

See STMC, section 4.1 and appendix C. Depends on texts, body parts, durations and the places of the ground truth;
independent of motions, models and metrics.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import astuple, dataclass, replace
from itertools import pairwise, product
from pathlib import Path

import numpy as np

from stmc.io.files import write_text
from stmc.io.untrusted import read_lines
from stmc.motion.body import BodyPart
from stmc.timeline import Prompt, Timeline, TimelineError

SHORTEST, LONGEST = 2.0, 9.2
"""Minimum and maximum duration of a prompt in seconds, as in the published timelines."""
MEAN, DEVIATION = 6.0, 1.2
"""Mean and standard deviation of durations in seconds. The paper gives a standard deviation of 1.0; its timelines have
1.2."""

LEGS_WEIGHT = 3
"""Weight of the legs, relative to 1 for any other body part, in draws for the first track."""
STRADDLES = 1 / 7
"""Fraction of the draws in which the third prompt overlaps both prompts of the first track."""
_HUNDREDTH = 100
"""Resolution of times: hundredths of a second."""
_KEYS = ("text", "body_parts", "clip", "start", "end", "shortest", "longest", "cyclic")
"""Keys of an atomic prompt in JSON."""


@dataclass(frozen=True)
class AtomicPrompt:
    """A text, the body parts that it describes, and a motion that shows it: seconds `[start, end)` of `clip`.

    A timeline may request it for `shortest` to `longest` seconds. Any part of a motion that shows a `cyclic` prompt
    shows it too.
    """

    text: str
    parts: frozenset[BodyPart]
    clip: str
    start: float
    end: float
    shortest: float | int = SHORTEST
    longest: float | int = LONGEST
    cyclic: bool = False


def read_atomic_prompts(path: str | Path, motions: str | Path | None = None) -> list[AtomicPrompt]:
    """Read atomic prompts in the published form, one per line, or from JSON.

    Args:
        path: File with lines `text # part # part` or, without `motions`, a JSON list like
            `assets/open_mtt/prompts.json`.
        motions: File with lines `clip # start # end`, in the same order.

    Raises:
        TimelineError: With the file and the line (or the entry), if the content is invalid or a text is duplicated,
            because retrieval could not distinguish the two.
    """
    path = Path(path)
    if motions is None:
        atomic_prompts = _read_json(path)
    else:
        texts, spans = _fields(path), _fields(Path(motions))
        if len(texts) != len(spans):
            raise TimelineError(
                f"{path} has {len(texts)} texts, but {motions} has {len(spans)} motions; each text needs one"
            )
        atomic_prompts = [
            _atomic_prompt(
                text, parts, *motion, place=f"{path}, line {number}" if len(motion) == 3 else f"{motions}, line {at}"
            )
            for (number, (text, *parts)), (at, motion) in zip(texts, spans, strict=True)
        ]
    return _unique(atomic_prompts, path)


def _unique(atomic_prompts: list[AtomicPrompt], path: Path) -> list[AtomicPrompt]:
    seen: set[str] = set()
    for prompt in atomic_prompts:
        if prompt.text in seen:
            raise TimelineError(f"{path}: {prompt.text!r} is duplicated")
        seen.add(prompt.text)
    return atomic_prompts


def read_texts(path: str | Path) -> list[AtomicPrompt]:
    """Read the texts and body parts of a file in the published form, `text # part # part`, without motions.

    `clip` is empty. Raises `TimelineError` as `read_atomic_prompts` does.
    """
    return _unique(
        [
            replace(_atomic_prompt(text, parts, "", 0.0, SHORTEST, place=f"{path}, line {number}"), end=0.0)
            for number, (text, *parts) in _fields(Path(path))
        ],
        Path(path),
    )


def write_atomic_prompts(atomic_prompts: Sequence[AtomicPrompt], path: str | Path) -> None:
    """Write atomic prompts as a JSON list, one per line; the file appears complete or not at all."""
    rows = [
        dict(zip(_KEYS, (prompt.text, sorted(prompt.parts), *astuple(prompt)[2:]), strict=True))
        for prompt in atomic_prompts
    ]
    lines = ",\n".join(map(json.dumps, rows))
    write_text(Path(path), f"[\n{lines}\n]\n")


def _fields(path: Path) -> list[tuple[int, list[str]]]:
    lines = enumerate(read_lines(path), start=1)
    return [(number, [field.strip() for field in line.split("#")]) for number, line in lines if line.strip()]


def _read_json(path: Path) -> list[AtomicPrompt]:
    try:
        rows = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise TimelineError(f"{path}: not JSON ({error})") from None
    if not isinstance(rows, list):
        raise TimelineError(f"{path}: not a list of prompts, each with {', '.join(_KEYS)}")
    for index, row in enumerate(rows):
        if not isinstance(row, dict) or set(row) != set(_KEYS):
            raise TimelineError(f"{path}, [{index}]: {json.dumps(row)[:60]} is not a prompt with {', '.join(_KEYS)}")
    return [_parse_row(row, f"{path}, [{index}]") for index, row in enumerate(rows)]


def _parse_row(row: dict, place: str) -> AtomicPrompt:
    *fields, shortest, longest, cyclic = (row[key] for key in _KEYS)
    if not (isinstance(cyclic, bool) and all(type(seconds) in (int, float) for seconds in (shortest, longest))):
        raise TimelineError(f"{place}: shortest and longest must be seconds, cyclic must be true or false")
    if not 0 < shortest <= longest:
        raise TimelineError(f"{place}: shortest ({shortest}) must be above 0 and at most longest ({longest})")
    return replace(_atomic_prompt(*fields, place=place), shortest=shortest, longest=longest, cyclic=cyclic)


def _atomic_prompt(text: str, parts: Sequence[str], *motion: str | float, place: str) -> AtomicPrompt:
    if len(motion) != 3:
        raise TimelineError(f"{place}: a motion is written clip # start # end (seconds)")
    clip, start, end = motion
    try:
        prompt = Prompt(text, float(start), float(end), parts)
    except (TypeError, ValueError) as error:
        raise TimelineError(f"{place}: {error}") from None
    return AtomicPrompt(prompt.text, prompt.claims, str(clip), prompt.start, prompt.end)


def sample_timelines(prompts: Sequence[AtomicPrompt], count: int, rng: np.random.Generator) -> list[Timeline]:
    """Draw timelines of three prompts on two tracks with the distribution of MTT.

    See STMC, section 4.1 and appendices C and E. Two prompts follow each other; a third one, on the second track, uses
    body parts that the prompts it overlaps leave free. In 6 of 7 draws the third lies within one of the two that lasts
    longer; in 1 of 7 it straddles both. The two are drawn with weights equal to their number of parts, where the legs
    count `LEGS_WEIGHT`; the third is drawn uniformly among those whose parts are free. Durations are normal (`MEAN`,
    `DEVIATION`), clipped to the range of the prompt; positions are uniform. A draw that does not fit is repeated as a
    whole, so that about 18 % of the timelines straddle and a text overlaps another one with probability 0.73. The paper
    does not specify all of this; the 500 published timelines do.

    The result depends on the arguments alone.

    Args:
        prompts: Atomic prompts.
        count: Number of timelines.
        rng: Random generator.

    Raises:
        TimelineError: If no two of the prompts can overlap.
    """
    pairs = product(prompts, repeat=2)
    if not any(_complementary(third, base.parts) and third.shortest <= base.longest for base, third in pairs):
        raise TimelineError(
            f"no two of the {len(prompts)} atomic prompts can overlap; add prompts with disjoint body parts"
        )
    weights = np.array([len(prompt.parts) + (LEGS_WEIGHT - 1) * (BodyPart.LEGS in prompt.parts) for prompt in prompts])
    timelines: list[Timeline] = []
    while len(timelines) < count:
        if drawn := _draw(prompts, weights / weights.sum(), rng):
            timelines.append(Timeline(drawn, f"{len(timelines):04d}", rows=(0, 0, 1)))
    return timelines


def _draw(
    prompts: Sequence[AtomicPrompt], weights: np.ndarray, rng: np.random.Generator
) -> tuple[Prompt, Prompt, Prompt] | None:
    """Draw the prompts of one timeline; return None if they do not fit."""
    straddles = rng.random() < STRADDLES
    pair = [prompts[index] for index in rng.choice(len(prompts), size=2, p=weights)]
    *durations, length = rng.normal(MEAN, DEVIATION, size=3)
    durations = [_hundredths(prompt, seconds) for prompt, seconds in zip(pair, durations, strict=True)]
    fitting = [index for index in (0, 1) if length * _HUNDREDTH <= durations[index]]
    if not (straddles or fitting):
        return None
    overlapped = [0, 1] if straddles else [fitting[rng.integers(len(fitting))]]
    claimed = frozenset().union(*(pair[index].parts for index in overlapped))
    free = [prompt for prompt in prompts if _complementary(prompt, claimed)]
    if not free:
        return None
    third = free[rng.integers(len(free))]
    bounds = [0, durations[0], sum(durations)]
    span = _place(_hundredths(third, length), bounds, overlapped, rng)
    before, after = (_to_prompt(prompt, *edges) for prompt, edges in zip(pair, pairwise(bounds), strict=True))
    return None if span is None else (before, after, _to_prompt(third, *span))


def _place(
    lasts: int, bounds: Sequence[int], overlapped: Sequence[int], rng: np.random.Generator
) -> tuple[int, int] | None:
    """Place a span of a given length in hundredths uniformly within those it overlaps; None if there is no room."""
    first, last = bounds[overlapped[0]], bounds[overlapped[-1] + 1] - lasts
    if len(overlapped) > 1:
        first, last = max(first, bounds[1] - lasts + 1), min(last, bounds[1] - 1)
    if first > last:
        return None
    start = int(rng.integers(first, last + 1))
    return start, start + lasts


def _hundredths(prompt: AtomicPrompt, seconds: float) -> int:
    """Clip `seconds` to the prompt's range, and convert them to whole hundredths."""
    return round(_HUNDREDTH * min(max(seconds, prompt.shortest), prompt.longest))


def _to_prompt(prompt: AtomicPrompt, start: int, end: int) -> Prompt:
    return Prompt(prompt.text, start / _HUNDREDTH, end / _HUNDREDTH, prompt.parts)


def _complementary(prompt: AtomicPrompt, claimed: frozenset[BodyPart]) -> bool:
    return not prompt.parts & claimed
