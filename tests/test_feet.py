"""What the loss sees of the feet: zero where they stand, one where they move as they do in the data."""

import pytest
import torch
from helpers.motions import walk, walking
from helpers.toy_data import LetterCounts

from stmc.data.cache import Cache, Clip, assemble
from stmc.motion.body import JOINTS
from stmc.motion.geometry import rotation_z
from stmc.motion.representation import HUMANML3D_LAYOUT, SmplRepresentation
from stmc.training.data.dataset import Dataset
from stmc.training.data.limb_velocity import FootVelocity, LimbVelocity


def clip(name: str, split: str) -> Clip:
    return Clip(name, "walk", "normal", "walk", ("legs",), True, False, split, 0, 0)


@pytest.fixture(scope="module")
def dataset() -> Dataset:
    encode = SmplRepresentation().encode
    rows = [(clip(f"walk-{i}", "train"), encode(walking(2.0 + 0.2 * i, turn=0.1 * i)).float()) for i in range(5)]
    rows.append((clip("shaking", "val"), encode(walk(40)).float()))
    clips, features = assemble(rows)
    return Dataset(
        Cache(20, "smpl", features, clips, {"walk": (("walk", 1.0),)}), LetterCounts(), SmplRepresentation.layout
    )


def test_steps_are_in_units_of_those_of_the_training_clips(dataset):
    steps = FootVelocity(dataset)
    training = [each for each in dataset.clips if each.split == "train"]
    moved = torch.cat([steps(dataset.motion.normalise(dataset.features[None, c.start : c.end]))[0] for c in training])
    torch.testing.assert_close(moved.square().mean(dim=0), torch.ones(6), atol=1e-3, rtol=0)


def test_a_body_that_stands_takes_no_steps(dataset):
    standing = dataset.features[:1].clone()
    standing[:, dataset.velocity] = 0
    steps = FootVelocity(dataset)(dataset.motion.normalise(standing).expand(1, 8, -1))
    assert steps.shape == (1, 7, 6)
    assert steps.abs().max() < 1e-4


def test_features_of_another_layout_are_an_error_and_not_steps_of_nonsense():
    clips, features = assemble([(clip(f"walk-{i}", "train"), torch.randn(20, 263)) for i in range(5)])
    cache = Cache(20, "humanml3d", features, clips, {"walk": (("walk", 1.0),)})
    with pytest.raises(ValueError, match="the 205 features of SmplRepresentation, not 263"):
        FootVelocity(Dataset(cache, LetterCounts(), HUMANML3D_LAYOUT))


def test_a_gliding_body_is_seen_and_its_gradient_slows_it(dataset):
    motion = dataset.motion.normalise(dataset.features[:1]).expand(1, 8, -1).clone().requires_grad_()
    FootVelocity(dataset)(motion).square().mean().backward()
    velocity = dataset.layout["root_velocity"]
    ahead = dataset.features[0, velocity]
    assert (motion.grad[0, :-1, velocity] @ ahead > 0).all()


def test_hands_that_move_are_seen_in_units_of_the_data_beside_the_feet(dataset):
    steps = LimbVelocity(dataset)
    training = [each for each in dataset.clips if each.split == "train"]
    moved = torch.cat([steps(dataset.motion.normalise(dataset.features[None, c.start : c.end]))[0] for c in training])
    torch.testing.assert_close(moved.square().mean(dim=0), torch.ones(12), atol=1e-3, rtol=0)
    torch.testing.assert_close(
        moved[:, :6],
        torch.cat(
            [
                FootVelocity(dataset)(dataset.motion.normalise(dataset.features[None, c.start : c.end]))[0]
                for c in training
            ]
        ),
    )


def test_wrists_move_as_those_of_the_decoded_motion_do_beside_the_pelvis():
    representation = SmplRepresentation()
    motion = walk(30)
    features = representation.encode(motion)
    steps = representation.wrist_velocities(features, representation.skeleton)
    posed = representation.decode(features, 20.0, representation.skeleton)
    for column, name in ((slice(0, 3), "left_wrist"), (slice(3, 6), "right_wrist")):
        seen = posed.joints[:, JOINTS.index(name)] - posed.joints[:, 0]
        seen = (rotation_z(-posed.heading) @ seen[..., None])[..., 0]
        torch.testing.assert_close(steps[:, column], seen.diff(dim=0), atol=1e-4, rtol=0)
