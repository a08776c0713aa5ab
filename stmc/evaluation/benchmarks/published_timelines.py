"""The authors' own draw of MTT: with their 60 atomic prompts and seed, it returns the 500 published timelines.

With other prompts it returns timelines of the same kind. It reproduces `mtt/sampling_timelines.py` of the published
code draw by draw; the paper (section 4.1, appendix C) specifies less, and a standard deviation of 1.0 s. Depends on
texts, body parts and durations; independent of motions.
"""

from __future__ import annotations

import random
from collections.abc import Sequence

from stmc.evaluation.benchmarks.atomic_prompts import AtomicPrompt
from stmc.motion.body import BodyPart
from stmc.timeline import Prompt, Timeline, TimelineError

SEED = 1234
MEAN, DEVIATION, LONGEST = 6.0, 1.2, 9.2
"""Mean, standard deviation and maximum of the duration of a prompt in seconds; with its transitions, a prompt of
maximum duration still fits the longest crop of MDM."""

LEGS = 3
"""Weight of the legs, relative to 1 for other body parts, when prompts are drawn in proportion to their parts."""
ATTEMPTS = 1000
"""Number of consecutive failed draws after which no three of the atomic prompts can be combined."""


def sample_published_timelines(
    atomic_prompts: Sequence[AtomicPrompt], count: int = 500, seed: int = SEED
) -> list[Timeline]:
    """Draw timelines of three prompts on two tracks; the result depends on the arguments alone.

    Two prompts follow each other, drawn in proportion to their body parts. The third, on the second track, overlaps one
    of them (6 of 7 draws, the longer one twice as often) or any part of both: it is no longer than they are, and has
    other body parts. The first two may be the same prompt, which has as many chances as it has parts.

    Args:
        atomic_prompts: Atomic prompts.
        count: Number of timelines.
        seed: Seed of the draw.

    Raises:
        TimelineError: If no three of the atomic prompts can be combined.
    """
    rng, timelines, failed = random.Random(seed), list[Timeline](), 0
    weights = [sum(LEGS if part is BodyPart.LEGS else 1 for part in prompt.parts) for prompt in atomic_prompts]
    if len(atomic_prompts) < 2:
        raise TimelineError(f"no three of the {len(atomic_prompts)} atomic prompts can be combined; pass at least two")
    while len(timelines) < count:
        prompts = _draw(atomic_prompts, weights, rng)
        failed = 0 if prompts else failed + 1
        if failed == ATTEMPTS:
            raise TimelineError(
                f"no three of the {len(atomic_prompts)} atomic prompts can be combined; add one with other body parts"
            )
        if prompts:
            timelines.append(Timeline(prompts, f"{len(timelines):04d}", rows=(0, 0, 1)))
    return timelines


def _draw(atomic_prompts: Sequence[AtomicPrompt], weights: Sequence[int], rng: random.Random) -> tuple[Prompt, ...]:
    """Try to draw three prompts; return none if no atomic prompt fits beside the first two."""
    first, second = rng.sample(range(len(atomic_prompts)), counts=weights, k=2)
    durations = [min(round(rng.gauss(MEAN, DEVIATION), 2), LONGEST) for _ in range(2)]
    longer = "first" if durations[0] > durations[1] else "second"
    [beside] = rng.sample(["first", "second", longer, "both"], counts=[2, 2, 2, 1], k=1)
    neighbours = {"first": [first], "second": [second], "both": [first, second]}[beside]
    room = {"first": durations[0], "second": durations[1], "both": min(sum(durations), LONGEST)}[beside]
    taken = frozenset[BodyPart]().union(*(atomic_prompts[index].parts for index in neighbours))
    third = round(MEAN + rng.gauss(0, 1) * DEVIATION, 2)
    free = [n for n, prompt in enumerate(atomic_prompts) if n not in (first, second) and not prompt.parts & taken]
    if third > room or not free:
        return ()
    fitting, third = rng.choice(free), min(third, LONGEST)
    start = round((durations[0] if beside == "second" else 0.0) + rng.uniform(0, room - third), 2)
    times = ((0.0, durations[0]), (durations[0], sum(durations)), (start, start + third))
    spans = zip((first, second, fitting), times, strict=True)
    return tuple(
        Prompt(atomic_prompts[n].text, _hundredths(first), _hundredths(last), atomic_prompts[n].parts)
        for n, (first, last) in spans
    )


def _hundredths(seconds: float) -> float:
    """Truncate to hundredths, as in the published file."""
    return int(seconds * 100) / 100
