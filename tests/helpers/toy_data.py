"""A data set, an encoder and a layout that are small enough to know everything about."""

from collections.abc import Sequence

import torch
from torch import Tensor

from stmc.data.cache import Cache, Clip
from stmc.motion.representation import Field, Layout

LAYOUT = Layout((Field("root_velocity", 2), Field("rotations", 6), Field("positions", 3, ("head",))))
"""11 features."""

FPS = 20.0


class LetterCounts:
    """A text's only words: how often each of 8 letters occurs; one word more for every blank."""

    name, width = "letters", 8

    def encode(self, texts: Sequence[str]) -> tuple[Tensor, Tensor]:
        """One row per text, padded with zeros."""
        lengths = torch.tensor([1 + text.count(" ") for text in texts])
        words = torch.zeros(len(texts), int(lengths.max()), self.width)
        for row, text in enumerate(texts):
            for place, word in enumerate(text.split(" ")):
                words[row, place] = torch.tensor([float(word.count(letter)) for letter in "aeiklrtw"])
        return words, lengths


def features(frames: int, content: float, generator: torch.Generator) -> Tensor:
    """Smooth made-up motion with valid rotations; `content` sets its pace and its pose."""
    time = torch.arange(frames)[:, None] / FPS
    angle = content + 0.3 * torch.sin(content * time + torch.rand(1, generator=generator))
    zero, one = torch.zeros_like(angle), torch.ones_like(angle)
    rows = torch.cat([angle.cos(), -angle.sin(), zero, angle.sin(), angle.cos(), zero], dim=1)
    velocity = torch.cat([0.05 * content * one, 0.01 * torch.cos(time)], dim=1)
    return torch.cat([velocity, rows, torch.cat([0.1 * angle, time.sin(), one], dim=1)], dim=1)


def cache(plenty: int = 12, seed: int = 0) -> Cache:
    """Contents: "walk" (cyclic, `plenty` clips), "raise" (half), "kick" (one). Each sixth clip is for validation."""
    generator = torch.Generator().manual_seed(seed)
    clips, motion, start = [], [], 0
    for content, count, cyclic in (("walk", plenty, True), ("raise", plenty // 2, False), ("kick", 1, False)):
        for number in range(count):
            frames = 30 + int(torch.randint(90, (1,), generator=generator))
            split = "val" if number % 6 == 5 else "train"
            name = f"{content}-{number}"
            clips.append(Clip(name, content, "normal", content, ("legs",), cyclic, False, split, start, start + frames))
            motion.append(features(frames, 1.0 + len(content) % 4, generator))
            start += frames
    texts = {
        "walk": (("walk", 0.75), ("a walk", 0.25)),
        "raise": (("raise the arm", 1.0),),
        "kick": (("kick", 1.0),),
    }
    return Cache(FPS, "toy", torch.cat(motion), tuple(clips), texts)
