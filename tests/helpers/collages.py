"""What tests of the collage share: small timelines, denoisers whose answers are known, and their texts."""

import torch
from torch import Tensor

from stmc.composing import distinct_texts, guided_crops
from stmc.denoisers import MdmSmpl
from stmc.diffusion import Schedule
from stmc.motion.body import BodyPart
from stmc.timeline import Prompt, Timeline
from stmc.timeline.planning import Plan, plan

FPS = 20
COLUMNS = {part: (i, 9 - i) for i, part in enumerate(BodyPart)}
"""Ten features: each part owns two, out of order."""


def timeline(*prompts: tuple) -> Timeline:
    """From (text, start frame, end frame, *parts)."""
    return Timeline(
        tuple(Prompt(text, a / FPS, b / FPS, frozenset(map(BodyPart.parse, parts))) for text, a, b, *parts in prompts)
    )


WALK_WAVE = timeline(("walk", 0, 40, "legs"), ("run", 40, 74, "legs", "spine"), ("wave", 14, 52, "right arm"))
STAND_NOD = timeline(("stand", 0, 55, "legs", "spine"), ("nod", 3, 30, "left arm", "head"))
GAP = timeline(("walk", 0, 20, "legs"), ("run", 35, 60, "legs"))


def plans_of(*timelines: Timeline, overlap: int = 10) -> list[Plan]:
    return [plan(each, FPS, overlap) for each in timelines]


class Constant:
    """Predicts, for every frame, the number that stands for the text; counts the rows it is given."""

    def __init__(self) -> None:
        self.calls: list[tuple[int, int]] = []

    def __call__(self, x: Tensor, t: Tensor, text: Tensor, text_mask=None, mask=None) -> Tensor:
        self.calls.append(x.shape[:2])
        return text[:, :1, :1].expand_as(x)


def embeddings(plans: list[Plan]) -> dict[str, Tensor]:
    """The empty text stands for 100, the others for 1, 2, 3, … in order of appearance."""
    return {text: torch.full((1, 1), float(i or 100)) for i, text in enumerate(distinct_texts(plans))}


def small_network(features: int = 10, text_width: int = 4, words: int | None = None) -> MdmSmpl:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return MdmSmpl(features, text_width, width=16, feedforward=32, layers=2, heads=2, words=words).eval()


def random_embeddings(plans: list[Plan], width: int = 4) -> dict[str, Tensor]:
    texts = distinct_texts(plans)
    values = torch.randn(len(texts), 1, width, generator=torch.Generator().manual_seed(1))
    return dict(zip(texts, values, strict=True))


def padding_of(plans: list[Plan], **how) -> float:
    """What `guided_crops` says of its padding for these plans."""
    return guided_crops(Constant(), Schedule.cosine(100), plans, embeddings(plans), **how).padding


def last(generator) -> Tensor:
    for x0 in generator:  # noqa: B007
        pass
    return x0
