"""Hypothesis strategies that several tests share, and the mark that keeps their legal but unwise timelines quiet."""

import pytest
from hypothesis import strategies as st

from stmc.motion.body import BodyPart
from stmc.timeline import Prompt, Timeline

TEXTS = ("walk forwards", "raise the right arm", "wave with both hands", "sit down", "nod", "turn left")

quietly = pytest.mark.filterwarnings(
    "ignore::stmc.timeline.TimelineWarning",
    "ignore:Do not use the `random` module inside strategies",  # beartype does, to check a random item
)


@st.composite
def timelines(draw, most_prompts: int = 8, longest: float = 12.0) -> Timeline:
    """Legal timelines of 1 to `most_prompts` prompts that end by `longest` seconds and last at least 0.1 s.

    Starts and ends come from a small pool of moments, so that gaps (also before the first prompt), touching prompts and
    identical spans are common; the pool holds off-grid moments too, so that prompts may be shorter than a frame.
    """
    moment = st.one_of(st.integers(0, int(longest * 20)).map(lambda frame: frame / 20), st.floats(0, longest))
    pool = draw(st.lists(moment, min_size=2, max_size=6, unique=True))
    if max(pool) < 0.1:
        pool.append(0.1)
    parts = st.frozensets(st.sampled_from(BodyPart))
    prompts = []
    for index in range(draw(st.integers(1, most_prompts))):
        pair = st.lists(st.sampled_from(pool), min_size=2, max_size=2, unique=True).map(sorted)
        start, end = (min(pool), max(pool)) if index == 0 else draw(pair)
        prompts.append(Prompt(draw(st.sampled_from(TEXTS)), start, end, draw(parts)))
    return Timeline(draw(st.permutations(prompts)), draw(st.sampled_from(("", "0001"))))
