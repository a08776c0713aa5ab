"""What the loss sees of the feet: zero where they stand, one where they move as they do in the data."""

import pytest
import torch
from test_motion import walk
from toys import LetterCounts
from walker import walking

from stmc.data.cache import Cache, Clip, assemble
from stmc.data.dataset import Corpus
from stmc.data.feet import FootSteps
from stmc.representation import HUMANML3D_LAYOUT, SmplRepresentation


def clip(name: str, split: str) -> Clip:
    return Clip(name, "walk", "normal", "walk", ("legs",), True, False, split, 0, 0)


@pytest.fixture(scope="module")
def corpus() -> Corpus:
    encode = SmplRepresentation().encode
    rows = [(clip(f"walk-{i}", "train"), encode(walking(2.0 + 0.2 * i, turn=0.1 * i)).float()) for i in range(5)]
    rows.append((clip("shaking", "val"), encode(walk(40)).float()))
    clips, features = assemble(rows)
    return Corpus(
        Cache(20, "smpl", features, clips, {"walk": (("walk", 1.0),)}), LetterCounts(), SmplRepresentation.layout
    )


def test_steps_are_in_units_of_those_of_the_training_clips(corpus):
    steps = FootSteps(corpus)
    training = [each for each in corpus.clips if each.split == "train"]
    moved = torch.cat([steps(corpus.motion.normalise(corpus.features[None, c.start : c.end]))[0] for c in training])
    torch.testing.assert_close(moved.square().mean(dim=0), torch.ones(6), atol=1e-3, rtol=0)


def test_a_body_that_stands_takes_no_steps(corpus):
    standing = corpus.features[:1].clone()
    standing[:, corpus.velocity] = 0
    steps = FootSteps(corpus)(corpus.motion.normalise(standing).expand(1, 8, -1))
    assert steps.shape == (1, 7, 6)
    assert steps.abs().max() < 1e-4


def test_features_of_another_layout_are_an_error_and_not_steps_of_nonsense():
    clips, features = assemble([(clip(f"walk-{i}", "train"), torch.randn(20, 263)) for i in range(5)])
    cache = Cache(20, "humanml3d", features, clips, {"walk": (("walk", 1.0),)})
    with pytest.raises(ValueError, match="SmplRepresentation's 205 features alone, not of 263"):
        FootSteps(Corpus(cache, LetterCounts(), HUMANML3D_LAYOUT))


def test_a_gliding_body_is_seen_and_its_gradient_slows_it(corpus):
    motion = corpus.motion.normalise(corpus.features[:1]).expand(1, 8, -1).clone().requires_grad_()
    FootSteps(corpus)(motion).square().mean().backward()
    velocity = corpus.layout["root_velocity"]
    ahead = corpus.features[0, velocity]
    assert (motion.grad[0, :-1, velocity] @ ahead > 0).all()
