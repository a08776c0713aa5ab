"""A judge that needs no training, for benchmarks of held poses."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from stmc.motion.motion import Motion
from stmc.motion.representation import SmplRepresentation

REPRESENTATION = SmplRepresentation()


class Oracle:
    """Sees the mean pose; `shown` is the motion that holds a text's."""

    def __init__(self, fps: float, shown: Callable[[str], Motion]) -> None:
        self.fps, self._shown = fps, shown

    def features(self, motion: Motion) -> Tensor:
        return REPRESENTATION.encode(motion).float()

    def motions(self, features: Sequence[Tensor]) -> Tensor:
        rotations = REPRESENTATION.layout["rotations"]
        return torch.stack([rows[:, rotations].mean(dim=0) for rows in features])

    def texts(self, texts: Sequence[str]) -> Tensor:
        return self.motions([self.features(self._shown(text)) for text in texts])
