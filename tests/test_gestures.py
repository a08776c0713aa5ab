"""Recipes of gestures: each makes clips that pass its own gate, on bodies that pass none, and the same ones again."""

import math
import pickle

import numpy as np
import pytest
import torch
from helpers.motions import standing_still

from stmc.data.sources.edited import gesture_gates as gates
from stmc.data.sources.edited.arm_gestures import RECIPES, STANDING
from stmc.data.sources.edited.gesture_bases import draw_base
from stmc.data.sources.edited.recipe import Base, Unusable
from stmc.editing import TurnKey, WristKey, reach, turn_trunk
from stmc.motion.body import JOINTS, PARENTS
from stmc.motion.feet import clean_feet
from stmc.motion.motion import Motion


def swaying(seconds: float, phase: float) -> Motion:
    """A stand whose trunk sways by some degrees."""
    motion = standing_still(round(seconds * 20))
    keys = [TurnKey(time, 1.0, pitch=0.03 * math.sin(time + phase)) for time in range(1, int(seconds))]
    return turn_trunk(motion, keys)


BASES = {"stand": [Base(f"stand/{n}", f"recording {n}", "normal", swaying(9, n)) for n in range(4)]}


def made(recipe, clip):
    """The first draw that passes, as the pipeline takes it."""
    rng = np.random.default_rng([7, clip])
    for _ in range(30):
        try:
            draft = recipe.make(BASES, rng)
        except Unusable:
            continue
        motion = clean_feet(draft.motion)
        if recipe.accept(motion):
            return motion
    raise AssertionError(f"{recipe.action}: no draw passes its gate")


@pytest.mark.parametrize("recipe", RECIPES, ids=lambda recipe: recipe.action)
def test_a_recipe_makes_whole_bodies_that_pass_and_rests_do_not(recipe):
    motion = made(recipe, 0)
    assert 3.4 < motion.duration < 9.1
    bones = (motion.joints[:, 1:] - motion.joints[:, list(PARENTS[1:])]).norm(dim=-1)
    assert (bones - bones[:1]).abs().max() < 1e-6
    assert motion.joints[..., 2].min() > -0.01
    assert (motion.joints.diff(dim=0).norm(dim=-1) * motion.fps).max() < 9
    assert not recipe.accept(BASES["stand"][0].motion)
    assert torch.equal(made(recipe, 0).joints, motion.joints)


@pytest.mark.parametrize("recipe", RECIPES, ids=lambda recipe: recipe.action)
def test_what_has_a_side_is_told_from_its_mirror_image(recipe):
    motion = made(recipe, 1)
    if recipe.action.endswith("-left"):
        assert not recipe.accept(motion.mirrored())


def test_the_gates_tell_gestures_apart():
    clips = {recipe.action: made(recipe, 2) for recipe in RECIPES}
    gestures = ("point-left", "wipe-left", "eat-left", "drink-left", "phone-left", "touch-head-left", "look-left")
    hands = (*gestures, "applause", "guitar", "violin")
    for recipe in RECIPES:
        if recipe.action in hands:
            assert [name for name in hands if recipe.accept(clips[name])] == [recipe.action]


def test_recipes_travel_to_other_processes():
    assert [recipe.action for recipe in pickle.loads(pickle.dumps(RECIPES))] == [recipe.action for recipe in RECIPES]


def test_swings_are_counted_from_turn_to_turn():
    time = torch.arange(100, dtype=torch.float64) / 20
    assert gates.count_swings(torch.sin(2 * math.pi * time), 0.5) == 11
    assert gates.count_swings(0.1 * torch.sin(2 * math.pi * time), 0.5) == 0
    assert gates.visits(torch.tensor([True, False, True, True])) == [1, 2]


def test_bases_are_calm_and_as_long_as_asked():
    rng = np.random.default_rng(0)
    for seconds in (4.0, 20.0):
        base = draw_base(BASES, rng, seconds, "stand")
        assert base.motion.frames == round(seconds * 20) and base.recording.startswith("recording")
        assert base.motion.joints.diff(dim=0).norm(dim=-1).max() < 0.02
    leaning = [Base("x", "x", "x", turn_trunk(standing_still(180), [TurnKey(1, 1, pitch=0.5)]))]
    with pytest.raises(Unusable, match="calm"):
        draw_base({"stand": leaning}, rng, 4.0, "stand")
    with pytest.raises(Unusable, match="calm"):
        draw_base({}, rng, 4.0, "sit")
    assert set(STANDING) == {"stand"}


def test_an_arm_that_waves_rests_in_a_base():
    waving = reach(swaying(9, 0), "left", [WristKey(1.0, 0.8, (0.3, 0.4, 0.1))])
    base = draw_base({"wave-left-hand": [Base("w", "w", "normal", waving)]}, np.random.default_rng(0), 4.0, "stand")
    left, right = (base.motion.joints[:, JOINTS.index(f"{side}_wrist"), 2] for side in ("left", "right"))
    assert (left - right).abs().max() < 0.05
