"""Multi-track timeline (MTT) data sets: atomic prompts with their ground truth, and timelines made of them
(STMC, section 4.1 and appendix C).

Knows texts, body parts, durations and where each ground truth lies; knows no motion, no model and no metric.
"""

from __future__ import annotations

import json
import random
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from stmc.body import BodyPart
from stmc.files import write_text
from stmc.timeline import Prompt, Timeline, TimelineError

SHORTEST = 2.0
"""Seconds: the least that an atomic prompt lasts, as in the published timelines."""

_KEYS = ("text", "body_parts", "clip", "start", "end")
"""Of an atomic prompt in JSON."""


@dataclass(frozen=True)
class AtomicPrompt:
    """A text, the body parts that it is about, and the motion that shows it: seconds `[start, end)` of `clip`."""

    text: str
    parts: frozenset[BodyPart]
    clip: str
    start: float
    end: float


def read_atomic_prompts(path: str | Path, motions: str | Path | None = None) -> list[AtomicPrompt]:
    """Atomic prompts in the published form, a line each: `path` says `text # part # part`, and `motions`, in the same
    order, `clip # start # end`. Without `motions`, `path` is a JSON list as `assets/open_mtt/prompts.json` is.

    Raises `TimelineError` with the file and the line (or the entry) for what is invalid, and for a text that
    is duplicated: retrieval could not tell the two apart.
    """
    path = Path(path)
    if motions is None:
        atoms = _of_json(path)
    else:
        texts, shown = _fields(path), _fields(Path(motions))
        if len(texts) != len(shown):
            raise TimelineError(f"{path} has {len(texts)} texts, {motions} {len(shown)} motions: each needs one")
        atoms = [
            _atom(text, parts, *motion, place=f"{path}, line {number}" if len(motion) == 3 else f"{motions}, line {at}")
            for (number, (text, *parts)), (at, motion) in zip(texts, shown, strict=True)
        ]
    seen: set[str] = set()
    for atom in atoms:
        if atom.text in seen:
            raise TimelineError(f"{path}: {atom.text!r} is duplicated")
        seen.add(atom.text)
    return atoms


def write_atomic_prompts(atoms: Sequence[AtomicPrompt], path: str | Path) -> None:
    """The atomic prompts as a JSON list, a line each; the file appears whole or not at all."""
    rows = [(each.text, sorted(each.parts), each.clip, each.start, each.end) for each in atoms]
    lines = ",\n".join(json.dumps(dict(zip(_KEYS, row, strict=True))) for row in rows)
    write_text(Path(path), f"[\n{lines}\n]\n")


def _fields(path: Path) -> list[tuple[int, list[str]]]:
    lines = enumerate(path.read_text(encoding="utf-8").splitlines(), start=1)
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
    return [_atom(*(row[key] for key in _KEYS), place=f"{path}, [{index}]") for index, row in enumerate(rows)]


def _atom(text: str, parts: Sequence[str], *motion: str | float, place: str) -> AtomicPrompt:
    if len(motion) != 3:
        raise TimelineError(f"{place}: a motion is written clip # start # end (seconds)")
    clip, *span = motion
    try:
        prompt = Prompt(text, *map(float, span), parts)
    except (TypeError, ValueError) as error:
        raise TimelineError(f"{place}: {error}") from None
    return AtomicPrompt(prompt.text, prompt.claims, str(clip), prompt.start, prompt.end)


def sample_timelines(
    atoms: Sequence[AtomicPrompt], count: int, seed: int, mean: float | int = 6.0, deviation: float | int = 1.0
) -> list[Timeline]:
    """`count` timelines of three prompts on two tracks: two that follow each other, and at a random place on the second
    track a third whose body parts are claimed by neither.

    A function of its arguments alone. Durations are normal with `mean` and `deviation` seconds (at least `SHORTEST`),
    to hundredths. Raises `TimelineError` where no three of the atoms go together.
    """
    if not any(_fit(a, b, c) for a in atoms for b in atoms for c in atoms):
        raise TimelineError(f"no three of the {len(atoms)} atomic prompts go together: one needs body parts of its own")
    chance = random.Random(seed)

    def lasting(longest: float = float("inf")) -> float:
        return round(min(max(chance.gauss(mean, deviation), SHORTEST), longest), 2)

    timelines = []
    while len(timelines) < count:
        first, second, third = chance.choice(atoms), chance.choice(atoms), chance.choice(atoms)
        if not _fit(first, second, third):
            continue
        change = lasting()
        end = round(change + lasting(), 2)
        length = lasting(end)
        start = round(chance.uniform(0, end - length), 2)
        prompts = (
            Prompt(first.text, 0.0, change, first.parts),
            Prompt(second.text, change, end, second.parts),
            Prompt(third.text, start, min(end, round(start + length, 2)), third.parts),
        )
        timelines.append(Timeline(prompts, f"{len(timelines):04d}", rows=(0, 0, 1)))
    return timelines


def _fit(first: AtomicPrompt, second: AtomicPrompt, third: AtomicPrompt) -> bool:
    return first.text != second.text and not third.parts & (first.parts | second.parts)
