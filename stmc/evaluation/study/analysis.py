"""Analysis of answers: attentive raters, the majority for each pair, and shares of pairs with intervals.

See STMC, section 4.2, "Perceptual study", and Fig. 4. This module knows answers and the key; it knows no motion.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from stmc.evaluation.study.answers import NO_PREFERENCE, Answers
from stmc.evaluation.study.key import RIGHT, Aspect, Key, Kind

CONFIDENCE = 0.95
_QUESTIONS = {Aspect.REALISM: "more realistic", Aspect.TIMELINE: "better at following the timeline"}


class Vote(StrEnum):
    """The answer of a rater, or of the majority, about a pair."""

    FIRST = "first"
    NEITHER = "no preference"
    SECOND = "second"


@dataclass(frozen=True)
class Preference:
    """Votes in one aspect, by the name of the pair."""

    votes: Mapping[str, Counter[Vote]]

    @property
    def outcomes(self) -> dict[str, Vote]:
        """The majority's answer for each pair; a tie is no preference."""
        return {pair: _majority(votes) for pair, votes in self.votes.items()}

    def count(self, *outcomes: Vote) -> int:
        """Count the pairs for which the majority gave one of these answers."""
        return sum(outcome in outcomes for outcome in self.outcomes.values())

    @property
    def raters(self) -> float:
        """The mean number of raters per pair."""
        return sum(votes.total() for votes in self.votes.values()) / max(len(self.votes), 1)


@dataclass(frozen=True)
class Discarded:
    """Discarded answers with the reasons."""

    answers: Answers
    reasons: tuple[str, ...]


@dataclass(frozen=True)
class Analysis:
    """Result of a study: preferences between its two methods, and discarded answers."""

    methods: tuple[str, str]
    kept: tuple[Answers, ...]
    discarded: tuple[Discarded, ...]
    preferences: Mapping[Aspect, Preference]
    unjudged: tuple[str, ...]
    """Pairs without any counted answers."""

    def text(self) -> str:
        """Return the report as text."""
        lines = [f"{self.methods[0]} against {self.methods[1]}"]
        lines.append(f"{len(self.kept)} answer files counted, {len(self.discarded)} discarded")
        lines += [f"  {each.answers.source}: {'; '.join(each.reasons)}" for each in self.discarded]
        if self.unjudged:
            lines.append(f"{len(self.unjudged)} pairs have no answers: {', '.join(self.unjudged)}")
        for aspect, preference in self.preferences.items():
            lines += ["", self._paragraph(aspect, preference)]
        lines += [
            "",
            "Number of pairs by majority (a tie is no preference), share, and Wilson's 95 % interval over pairs.",
        ]
        return "\n".join(lines) + "\n"

    def data(self) -> dict[str, Any]:
        """Return the result as plain data for JSON, with the votes on every pair."""
        return {
            "methods": list(self.methods),
            "kept": [each.source for each in self.kept],
            "discarded": [
                {"file": each.answers.source, "rater": each.answers.rater, "reasons": list(each.reasons)}
                for each in self.discarded
            ],
            "unjudged": list(self.unjudged),
            "confidence": CONFIDENCE,
            "preferences": {aspect: _plain(preference) for aspect, preference in self.preferences.items()},
        }

    def _paragraph(self, aspect: Aspect, preference: Preference) -> str:
        pairs = len(preference.votes)
        head = f"{_QUESTIONS[aspect]}: {pairs} pairs, {preference.raters:.1f} raters each on average"
        if not pairs:
            return head
        first, second = self.methods
        wide = max(len(first), len(second), len(Vote.NEITHER)) + 13
        rows = [
            _share(name.ljust(wide), preference.count(*outcomes), pairs)
            for name, outcomes in (
                (first, (Vote.FIRST,)),
                (Vote.NEITHER.value, (Vote.NEITHER,)),
                (second, (Vote.SECOND,)),
                (f"{first} or similar", (Vote.FIRST, Vote.NEITHER)),
            )
        ]
        return "\n".join([head, *rows])


def analyse(key: Key, answers: Sequence[Answers]) -> Analysis:
    """Discard raters that failed a honeypot, and take the majority's answer about each pair.

    Any answer but the right one, in the aspect that a honeypot tests, fails it; all files of the rater are then
    discarded, in all surveys. Warm-ups do not count. The paper does not define ties: here the answer with the most
    votes of the three wins, and a tie for the most is "no preference". A rater who sees a pair in two surveys has one
    vote, that of the first file.
    """
    failures: dict[str, list[tuple[Answers, str]]] = {each.rater: [] for each in answers}
    for each in answers:
        failures[each.rater] += [(each, reason) for reason in _failures(key, each)]
    kept = tuple(each for each in answers if not failures[each.rater])
    discarded = tuple(
        Discarded(each, tuple(_format_reason(each, source, reason) for source, reason in failures[each.rater]))
        for each in answers
        if failures[each.rater]
    )
    pairs = [entry.pair for entries in key.surveys.values() for entry in entries.values() if entry.kind == Kind.PAIR]
    preferences = {aspect: _preference(key, kept, aspect) for aspect in Aspect}
    unjudged = [pair for pair in dict.fromkeys(pairs) if pair not in preferences[Aspect.REALISM].votes]
    return Analysis(key.methods, kept, discarded, preferences, tuple(unjudged))


def wilson(count: int, total: int) -> tuple[float, float]:
    """Return Wilson's 95 % interval (1927) of the share `count` / `total`, within 0 and 1 even for few.

    Raises `ValueError` if `count` is not from 0 to `total`, or `total` is 0.
    """
    if not 0 <= count <= total or not total:
        raise ValueError(f"{count} of {total} is not a share")
    from scipy.stats import binomtest  # not at the top: it is slow to import

    interval = binomtest(count, total).proportion_ci(CONFIDENCE, method="wilson")
    return float(interval.low), float(interval.high)


def _failures(key: Key, answers: Answers) -> list[str]:
    reasons = []
    for question, entry in key.surveys[answers.survey].items():
        if entry.kind.tests is None:
            continue
        choice = answers.choices[question][entry.kind.tests]
        if choice == NO_PREFERENCE:
            reasons.append(f"{entry.kind} failed: no preference")
        elif entry.sides[choice] != RIGHT:
            wrong = "the stretched motion" if entry.kind == Kind.REALISM_HONEYPOT else "another timeline's motion"
            reasons.append(f"{entry.kind} failed: chose {wrong}")
    return reasons


def _format_reason(answers: Answers, source: Answers, reason: str) -> str:
    return reason if source is answers else f"{reason} (the same rater in {source.source})"


def _preference(key: Key, kept: Sequence[Answers], aspect: Aspect) -> Preference:
    votes: dict[str, dict[str, Vote]] = {}
    for each in kept:
        for question, entry in key.surveys[each.survey].items():
            if entry.kind == Kind.PAIR:
                vote = _vote(key, entry.sides, each.choices[question][aspect])
                votes.setdefault(entry.pair, {}).setdefault(each.rater, vote)
    return Preference({pair: Counter(by_rater.values()) for pair, by_rater in votes.items()})


def _vote(key: Key, sides: Mapping[str, str], choice: str) -> Vote:
    if choice == NO_PREFERENCE:
        return Vote.NEITHER
    return Vote.FIRST if sides[choice] == key.methods[0] else Vote.SECOND


def _majority(votes: Counter[Vote]) -> Vote:
    (vote, most), *others = votes.most_common()
    return Vote.NEITHER if others and others[0][1] == most else vote


def _plain(preference: Preference) -> dict[str, Any]:
    pairs = len(preference.votes)
    shares = {vote.value: preference.count(vote) for vote in Vote}
    shares["first or no preference"] = preference.count(Vote.FIRST, Vote.NEITHER)
    return {
        "pairs": pairs,
        "raters_per_pair": preference.raters,
        "shares": {
            name: {"pairs": count, "share": count / pairs, "interval": list(wilson(count, pairs))}
            for name, count in shares.items()
        }
        if pairs
        else {},
        "votes": {
            pair: {vote.value: votes[vote] for vote in Vote} | {"majority": preference.outcomes[pair].value}
            for pair, votes in preference.votes.items()
        },
    }


def _share(name: str, count: int, total: int) -> str:
    low, high = wilson(count, total)
    return f"  {name} {count:4d}  {100 * count / total:5.1f} %  [{100 * low:.1f}, {100 * high:.1f}]"
