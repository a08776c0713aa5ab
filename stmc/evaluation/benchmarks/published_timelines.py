"""The draw by which the authors of STMC made MTT: of the 60 atomic prompts and their seed, the very 500 timelines that
they publish; of others, timelines of the same kind.

It is what `mtt/sampling_timelines.py` of the published code does, draw by draw; the paper (section 4.1, appendix C)
says less, and a deviation of 1.0 s. Knows texts, body parts and durations; knows no motion.
"""

from __future__ import annotations

import random
from collections.abc import Sequence

from stmc.evaluation.benchmarks.atomic_prompts import AtomicPrompt
from stmc.motion.body import BodyPart
from stmc.timeline import Prompt, Timeline, TimelineError

SEED = 1234
MEAN, DEVIATION, LONGEST = 6.0, 1.2, 9.2
"""Seconds of a prompt; with its transitions one of the longest still fits into what MDM makes at once."""

LEGS = 3
"""Of how many other body parts the legs count for, where prompts are drawn in proportion to theirs."""

ATTEMPTS = 1000
"""In a row without a timeline: then no three of the atomic prompts go together."""


def sample_published_timelines(
    atomic_prompts: Sequence[AtomicPrompt], count: int = 500, seed: int = SEED
) -> list[Timeline]:
    """`count` timelines of three prompts on two tracks, a function of its arguments alone.

    Two prompts follow each other, drawn in proportion to their body parts. The third lies on the second track beside
    one of them (6 of 7, the longer one twice as often) or anywhere beside both: it is no longer, and of body parts
    that those have not. The first two may be the same one: it has as many chances as it has parts. Raises
    `TimelineError` where no three of the atomic prompts go together.
    """
    rng, timelines, failed = random.Random(seed), list[Timeline](), 0
    weights = [sum(LEGS if part is BodyPart.LEGS else 1 for part in prompt.parts) for prompt in atomic_prompts]
    if len(atomic_prompts) < 2:
        raise TimelineError(f"no three of the {len(atomic_prompts)} atomic prompts go together")
    while len(timelines) < count:
        prompts = _drawn(atomic_prompts, weights, rng)
        failed = 0 if prompts else failed + 1
        if failed == ATTEMPTS:
            raise TimelineError(
                f"no three of the {len(atomic_prompts)} atomic prompts go together: one needs parts of its own"
            )
        if prompts:
            timelines.append(Timeline(prompts, f"{len(timelines):04d}", rows=(0, 0, 1)))
    return timelines


def _drawn(atomic_prompts: Sequence[AtomicPrompt], weights: Sequence[int], rng: random.Random) -> tuple[Prompt, ...]:
    """One attempt: three prompts, or none where no atomic prompt fits beside the first two."""
    first, second = rng.sample(range(len(atomic_prompts)), counts=weights, k=2)
    lasting = [min(round(rng.gauss(MEAN, DEVIATION), 2), LONGEST) for _ in range(2)]
    longer = "first" if lasting[0] > lasting[1] else "second"
    [beside] = rng.sample(["first", "second", longer, "both"], counts=[2, 2, 2, 1], k=1)
    neighbours = {"first": [first], "second": [second], "both": [first, second]}[beside]
    room = {"first": lasting[0], "second": lasting[1], "both": min(sum(lasting), LONGEST)}[beside]
    taken = frozenset[BodyPart]().union(*(atomic_prompts[index].parts for index in neighbours))
    third = round(MEAN + rng.gauss(0, 1) * DEVIATION, 2)
    free = [n for n, prompt in enumerate(atomic_prompts) if n not in (first, second) and not prompt.parts & taken]
    if third > room or not free:
        return ()
    chosen, third = rng.choice(free), min(third, LONGEST)
    start = round((lasting[0] if beside == "second" else 0.0) + rng.uniform(0, room - third), 2)
    times = ((0.0, lasting[0]), (lasting[0], sum(lasting)), (start, start + third))
    asked = zip((first, second, chosen), times, strict=True)
    return tuple(Prompt(atomic_prompts[n].text, *map(_hundredths, span), atomic_prompts[n].parts) for n, span in asked)


def _hundredths(seconds: float) -> float:
    """Cut off, not rounded, as in the published file."""
    return int(seconds * 100) / 100
