"""Surveys: the choice of questions, their order and their sides, all drawn from one seed."""

from __future__ import annotations

import json
import random
from collections.abc import Sequence
from dataclasses import dataclass

from stmc.evaluation.study.clips import Clip
from stmc.evaluation.study.comparisons import Pair
from stmc.evaluation.study.key import RIGHT, WRONG, Entry, Key, Kind, StudyError
from stmc.timeline import Timeline

WARM_UPS = 3
_APART = WARM_UPS + 2
"""Number of warm-ups and honeypots of a survey, whose pairs it does not study."""


@dataclass(frozen=True, eq=False)
class Question:
    """A timeline and two clips, left and right, each with an opaque id."""

    id: str
    timeline: Timeline
    sides: tuple[tuple[str, Clip], tuple[str, Clip]]


@dataclass(frozen=True, eq=False)
class Survey:
    """The questions of one page."""

    id: str
    questions: tuple[Question, ...]


def design(pairs: Sequence[Pair], methods: tuple[str, str], seed: int = 0, size: int = 10) -> tuple[list[Survey], Key]:
    """Design surveys that cover every pair at least once, and their key (STMC, section 4.2).

    A survey has three warm-ups, then `size` pairs and two honeypots in random order. Warm-ups and honeypots use other
    pairs, so no timeline is shown twice. One honeypot shows the first method's motion beside the second's with
    stretched limbs; the other shows the first method's motion beside its motion of another timeline, which has other
    words and lasts about as long. If the pairs do not fill the last survey, it repeats pairs of the first one.

    In each survey, each method is on the left for half of the pairs. All choices depend on `seed` and the names of
    methods and pairs, not on the order of `pairs`, so a study is the same on every machine. Ids are meaningless in
    studies of other methods or seeds. Raises `StudyError` for too few pairs, and for equal names of methods or pairs.

    Args:
        pairs: Pairs of motions.
        methods: Names of the two methods.
        seed: Seed of the surveys.
        size: Number of pairs of a survey.
    """
    _check(pairs, methods, size)
    named = sorted(pairs, key=lambda pair: pair.name)
    rng = random.Random(json.dumps([seed, methods, [pair.name for pair in named]]))
    order = rng.sample(named, len(named))
    surveys, entries = [], {}
    for start in range(0, len(order), size):
        chosen = [order[place % len(order)] for place in range(start, start + size)]
        survey, own = _survey(chosen, order, methods, rng)
        surveys.append(survey)
        entries[survey.id] = own
    return surveys, Key(methods, entries)


def stranger(timeline: Timeline, others: Sequence[Pair]) -> Pair:
    """Choose the pair that makes the clearest wrong answer for a timeline: few common words and a similar duration.

    Pairs that share a text are excluded; the name breaks ties. Raises `StudyError` if all pairs share a text.
    """
    texts = {prompt.text for prompt in timeline.prompts}
    candidates = [pair for pair in others if texts.isdisjoint(prompt.text for prompt in pair.timeline.prompts)]
    if not candidates:
        raise StudyError(f"a honeypot needs a timeline without {', '.join(map(repr, sorted(texts)))}")

    def likeness(pair: Pair) -> tuple[float, str]:
        own, other = _words(timeline), _words(pair.timeline)
        longer = abs(pair.timeline.duration - timeline.duration) / timeline.duration
        return len(own & other) / len(own | other) + longer, pair.name

    return min(candidates, key=likeness)


def _survey(
    chosen: Sequence[Pair], pairs: Sequence[Pair], methods: tuple[str, str], rng: random.Random
) -> tuple[Survey, dict[str, Entry]]:
    names = {pair.name for pair in chosen}
    others = rng.sample([pair for pair in pairs if pair.name not in names], _APART)
    first = rng.sample([index % 2 == 0 for index in range(len(chosen))], len(chosen))
    counted = [_compare(Kind.PAIR, pair, methods, left, rng) for pair, left in zip(chosen, first, strict=True)]
    warm = [_compare(Kind.WARM_UP, pair, methods, rng.random() < 0.5, rng) for pair in others[:WARM_UPS]]
    limbs, lost = others[WARM_UPS:]
    counted.append(_honeypot(Kind.REALISM_HONEYPOT, limbs, Clip.of(limbs.second).stretched(), rng))
    other = stranger(lost.timeline, [pair for pair in pairs if pair is not lost])
    counted.append(_honeypot(Kind.TIMELINE_HONEYPOT, lost, Clip.of(other.first), rng))
    questions = [*warm, *rng.sample(counted, len(counted))]
    survey = Survey(_id(rng), tuple(question for question, _ in questions))
    return survey, {question.id: entry for question, entry in questions}


def _compare(
    kind: Kind, pair: Pair, methods: tuple[str, str], first_left: bool, rng: random.Random
) -> tuple[Question, Entry]:
    clips = (Clip.of(pair.first), Clip.of(pair.second))
    return _question(kind, pair, clips, methods, first_left, rng)


def _honeypot(kind: Kind, pair: Pair, wrong: Clip, rng: random.Random) -> tuple[Question, Entry]:
    return _question(kind, pair, (Clip.of(pair.first), wrong), (RIGHT, WRONG), rng.random() < 0.5, rng)


def _question(
    kind: Kind, pair: Pair, clips: tuple[Clip, Clip], behind: tuple[str, str], first_left: bool, rng: random.Random
) -> tuple[Question, Entry]:
    ids = (_id(rng), _id(rng))
    first, second = zip(ids, clips, strict=True)
    question = Question(_id(rng), pair.timeline, (first, second) if first_left else (second, first))
    return question, Entry(kind, pair.name, dict(sorted(zip(ids, behind, strict=True))))


def _check(pairs: Sequence[Pair], methods: tuple[str, str], size: int) -> None:
    if methods[0] == methods[1]:
        raise StudyError(f"both methods are called {methods[0]!r}; give them two names")
    if size < 1:
        raise StudyError(f"size={size}: a survey needs at least 1 pair")
    if len({pair.name for pair in pairs}) < len(pairs):
        raise StudyError("two pairs have the same name")
    if len(pairs) < size + _APART:
        raise StudyError(
            f"{len(pairs)} timelines have motions, but a survey of {size} pairs needs {size + _APART}, with {WARM_UPS} "
            "for warm-ups and 2 for honeypots; sample more timelines, or reduce size"
        )


def _words(timeline: Timeline) -> set[str]:
    return set(" ".join(prompt.text.lower() for prompt in timeline.prompts).split())


def _id(rng: random.Random) -> str:
    return f"{rng.getrandbits(64):016x}"
