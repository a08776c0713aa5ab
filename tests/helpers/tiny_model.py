"""A model that is whole but for its size and its training: random weights, texts as hashes, a standing body as mean."""

import hashlib
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from stmc.denoisers import MdmSmpl
from stmc.diffusion import Schedule
from stmc.diffusion.statistics import Statistics
from stmc.diffusion.tensors import pad
from stmc.model import Model
from stmc.motion.body import NUM_ROTATIONS
from stmc.motion.body_model import Skeleton
from stmc.motion.motion import Motion
from stmc.motion.representation import SmplRepresentation

WIDTH = 384
"""Of a word: MiniLM's, so that the config can name a text encoder that comes with the library."""

CONFIG: dict[str, Any] = {
    "denoiser": {
        "_target_": "stmc.denoisers.MdmSmpl",
        "features": 205,
        "text_width": WIDTH,
        "width": 16,
        "feedforward": 32,
        "layers": 1,
        "heads": 2,
    },
    "schedule": {"_target_": "stmc.diffusion.Schedule.cosine", "steps": 100},
    "text_encoder": {"_target_": "stmc.text.MiniLM", "pooling": "tokens"},
    "representation": {"_target_": "stmc.motion.representation.SmplRepresentation"},
}


class Hashes:
    """Each word of a text as random numbers that only the word determines; counts the texts it is given."""

    name, width = "hashes", WIDTH

    def __init__(self) -> None:
        self.encoded: list[str] = []

    def encode(self, texts: Sequence[str]) -> tuple[Tensor, Tensor]:
        self.encoded += texts
        return pad([torch.stack([_numbers(word) for word in text.split(" ")]) for text in texts])


def _numbers(word: str) -> Tensor:
    seed = int.from_bytes(hashlib.sha256(word.encode()).digest()[:6], "big")
    return torch.randn(WIDTH, generator=torch.Generator().manual_seed(seed))


def tiny(fps: float | int = 20, longest: int = 100) -> Model:
    """Motions of it are near a T-pose that wanders and trembles."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        arguments = {key: value for key, value in CONFIG["denoiser"].items() if key != "_target_"}
        denoiser = MdmSmpl(**arguments).eval().requires_grad_(False)
    upright = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    rotations = torch.eye(3).repeat(1, NUM_ROTATIONS, 1, 1)
    rotations[:, 0] = upright
    standing = Motion.posed(rotations, torch.tensor([[0.0, 0.0, 1.0]]), fps, Skeleton.default())
    representation = SmplRepresentation()
    [mean] = representation.encode(standing)
    return Model(
        denoiser=denoiser,
        schedule=Schedule.cosine(100),
        text_encoder=Hashes(),
        representation=representation,
        motion_statistics=Statistics(mean, torch.full_like(mean, 0.05)),
        text_statistics=Statistics(torch.full((WIDTH,), 0.1), torch.full((WIDTH,), 2.0)),
        skeleton=Skeleton.default(),
        fps=fps,
        longest=longest,
        config=CONFIG,
    )
