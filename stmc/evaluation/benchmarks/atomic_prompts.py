"""Multi-track timeline (MTT) data sets: atomic prompts with their ground truth, and timelines made of them
(STMC, section 4.1 and appendix C).

Knows texts, body parts, durations and where each ground truth lies; knows no motion, no model and no metric.
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
"""Seconds: what prompts last at least and at most, as in the published timelines."""

MEAN, DEVIATION = 6.0, 1.2
"""Seconds: of prompts' durations. The paper says 1.0 for the deviation; its timelines have 1.2."""

LEGS_WEIGHT = 3
"""How much legs count, where any other body part counts 1, in how often a prompt is drawn for the first track."""

STRADDLES = 1 / 7
"""The share of the draws in which the third prompt overlaps both of the first track."""

_HUNDREDTH = 100
"""Of a second: what times are whole numbers of."""

_KEYS = ("text", "body_parts", "clip", "start", "end", "shortest", "longest", "cyclic")
"""Of an atomic prompt in JSON."""


@dataclass(frozen=True)
class AtomicPrompt:
    """A text, the body parts that it is about, and the motion that shows it: seconds `[start, end)` of `clip`.

    A timeline may ask for it for `shortest` to `longest` seconds. Of a `cyclic` one any trim of a motion that shows it
    still does.
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
    """Atomic prompts in the published form, a line each: `path` says `text # part # part`, and `motions`, in the same
    order, `clip # start # end`. Without `motions`, `path` is a JSON list as `assets/open_mtt/prompts.json` is.

    Raises `TimelineError` with the file and the line (or the entry) for what is invalid, and for a text that
    is duplicated: retrieval could not tell the two apart.
    """
    path = Path(path)
    if motions is None:
        atomic_prompts = _of_json(path)
    else:
        texts, shown = _fields(path), _fields(Path(motions))
        if len(texts) != len(shown):
            raise TimelineError(f"{path} has {len(texts)} texts, {motions} {len(shown)} motions: each needs one")
        atomic_prompts = [
            _atomic_prompt(
                text, parts, *motion, place=f"{path}, line {number}" if len(motion) == 3 else f"{motions}, line {at}"
            )
            for (number, (text, *parts)), (at, motion) in zip(texts, shown, strict=True)
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
    """The texts and body parts of a file in the published form, `text # part # part`, without a motion that shows them
    (`clip` is empty). Raises `TimelineError` as `read_atomic_prompts` does."""
    return _unique(
        [
            replace(_atomic_prompt(text, parts, "", 0.0, SHORTEST, place=f"{path}, line {number}"), end=0.0)
            for number, (text, *parts) in _fields(Path(path))
        ],
        Path(path),
    )


def write_atomic_prompts(atomic_prompts: Sequence[AtomicPrompt], path: str | Path) -> None:
    """The atomic prompts as a JSON list, a line each; the file appears whole or not at all."""
    rows = [
        dict(zip(_KEYS, (each.text, sorted(each.parts), *astuple(each)[2:]), strict=True)) for each in atomic_prompts
    ]
    lines = ",\n".join(map(json.dumps, rows))
    write_text(Path(path), f"[\n{lines}\n]\n")


def _fields(path: Path) -> list[tuple[int, list[str]]]:
    lines = enumerate(read_lines(path), start=1)
    return [(number, [field.strip() for field in line.split("#")]) for number, line in lines if line.strip()]


def _of_json(path: Path) -> list[AtomicPrompt]:
    try:
        rows = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise TimelineError(f"{path}: not JSON ({error})") from None
    if not isinstance(rows, list):
        raise TimelineError(f"{path}: not a list of prompts, each with {', '.join(_KEYS)}")
    for index, row in enumerate(rows):
        if not isinstance(row, dict) or set(row) != set(_KEYS):
            raise TimelineError(f"{path}, [{index}]: {json.dumps(row)[:60]} is not a prompt with {', '.join(_KEYS)}")
    return [_of_row(row, f"{path}, [{index}]") for index, row in enumerate(rows)]


def _of_row(row: dict, place: str) -> AtomicPrompt:
    *described, shortest, longest, cyclic = (row[key] for key in _KEYS)
    if not (isinstance(cyclic, bool) and all(type(each) in (int, float) for each in (shortest, longest))):
        raise TimelineError(f"{place}: shortest and longest are seconds, cyclic is true or false")
    if not 0 < shortest <= longest:
        raise TimelineError(f"{place}: shortest ({shortest}) must be above 0 and at most longest ({longest})")
    return replace(_atomic_prompt(*described, place=place), shortest=shortest, longest=longest, cyclic=cyclic)


def _atomic_prompt(text: str, parts: Sequence[str], *motion: str | float, place: str) -> AtomicPrompt:
    if len(motion) != 3:
        raise TimelineError(f"{place}: a motion is written clip # start # end (seconds)")
    clip, *span = motion
    try:
        prompt = Prompt(text, *map(float, span), parts)
    except (TypeError, ValueError) as error:
        raise TimelineError(f"{place}: {error}") from None
    return AtomicPrompt(prompt.text, prompt.claims, str(clip), prompt.start, prompt.end)


def sample_timelines(prompts: Sequence[AtomicPrompt], count: int, rng: np.random.Generator) -> list[Timeline]:
    """`count` timelines of three prompts on two tracks, drawn as MTT's are (STMC, section 4.1 and appendices C and E):
    two that follow each other, and on the second track a third on body parts that those it overlaps leave free.

    In 6 of 7 draws the third lies within one of the two that lasts longer; in 1 of 7 it straddles both. The two are
    drawn by their number of parts, of which the legs count `LEGS_WEIGHT`; the third evenly among those whose parts are
    free. Durations are normal (`MEAN`, `DEVIATION`), cut to the prompt's own range; places are uniform.
    What does not fit is drawn again as a whole, so that some 18 % of the timelines straddle and a text overlaps another
    with probability 0.73. The paper does not say all of this: it is what the 500 published timelines have.

    A function of its arguments alone. Raises `TimelineError` where no two of the prompts can overlap.
    """
    pairs = product(prompts, repeat=2)
    if not any(_complementary(third, base.parts) and third.shortest <= base.longest for base, third in pairs):
        raise TimelineError(f"no two of the {len(prompts)} atomic prompts go together: one needs body parts of its own")
    weights = np.array([len(prompt.parts) + (LEGS_WEIGHT - 1) * (BodyPart.LEGS in prompt.parts) for prompt in prompts])
    timelines: list[Timeline] = []
    while len(timelines) < count:
        if drawn := _draw(prompts, weights / weights.sum(), rng):
            timelines.append(Timeline(drawn, f"{len(timelines):04d}", rows=(0, 0, 1)))
    return timelines


def _draw(
    prompts: Sequence[AtomicPrompt], shares: np.ndarray, rng: np.random.Generator
) -> tuple[Prompt, Prompt, Prompt] | None:
    """The prompts of one timeline; None where they do not fit."""
    straddles = rng.random() < STRADDLES
    pair = [prompts[index] for index in rng.choice(len(prompts), size=2, p=shares)]
    *lasting, length = rng.normal(MEAN, DEVIATION, size=3)
    lasting = [_hundredths(prompt, seconds) for prompt, seconds in zip(pair, lasting, strict=True)]
    fitting = [place for place in (0, 1) if length * _HUNDREDTH <= lasting[place]]
    if not (straddles or fitting):
        return None
    overlapped = [0, 1] if straddles else [fitting[rng.integers(len(fitting))]]
    claimed = frozenset().union(*(pair[place].parts for place in overlapped))
    free = [prompt for prompt in prompts if _complementary(prompt, claimed)]
    if not free:
        return None
    third = free[rng.integers(len(free))]
    bounds = [0, lasting[0], sum(lasting)]
    span = _placed(_hundredths(third, length), bounds, overlapped, rng)
    asked = [_asked(each, *within) for each, within in zip(pair, pairwise(bounds), strict=True)]
    return None if span is None else (*asked, _asked(third, *span))


def _placed(
    lasts: int, bounds: Sequence[int], overlapped: Sequence[int], rng: np.random.Generator
) -> tuple[int, int] | None:
    """Where so many hundredths lie, uniformly, within those of the pair that they overlap; None where there is no room.
    Both are overlapped by a hundredth at least."""
    first, last = bounds[overlapped[0]], bounds[overlapped[-1] + 1] - lasts
    if len(overlapped) > 1:
        first, last = max(first, bounds[1] - lasts + 1), min(last, bounds[1] - 1)
    if first > last:
        return None
    start = int(rng.integers(first, last + 1))
    return start, start + lasts


def _hundredths(prompt: AtomicPrompt, seconds: float) -> int:
    """`seconds` within the prompt's range, as a whole number of hundredths."""
    return round(_HUNDREDTH * min(max(seconds, prompt.shortest), prompt.longest))


def _asked(prompt: AtomicPrompt, start: int, end: int) -> Prompt:
    return Prompt(prompt.text, start / _HUNDREDTH, end / _HUNDREDTH, prompt.parts)


def _complementary(prompt: AtomicPrompt, claimed: frozenset[BodyPart]) -> bool:
    return not prompt.parts & claimed
