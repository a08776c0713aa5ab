"""A motion that is kept but for a change: equal outside it, new within, whatever the method and the sampler."""

import dataclasses
import math

import pytest
import torch
from helpers.motions import walking
from helpers.tiny_model import tiny

import stmc
from stmc.denoisers import MdmSmpl
from stmc.editing import Change, Kept, changed_prompt, changed_prompts, move_to_body
from stmc.motion.body import JOINTS, BodyPart
from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import rotation_z
from stmc.motion.motion import Motion
from stmc.settings.records import SettingError
from stmc.timeline import Prompt, Timeline

TIMELINE = Timeline.parse("walk # 0 # 4 # legs\nwave # 1 # 3 # right arm")
ARM, LEGS = (list(BodyPart).index(part) for part in (BodyPart.RIGHT_ARM, BodyPart.LEGS))
METHODS = ["stmc", "stmc_paper", "sinc", "sinc_slerp", "double_take", "multi_diffusion", "teach"]


@pytest.fixture(scope="module")
def model() -> stmc.Model:
    return tiny()


@pytest.fixture(scope="module")
def motion(model) -> Motion:
    return model.generate(TIMELINE, seed=0, steps=4)[0]


def apart(first: Motion, second: Motion, frames: slice) -> float:
    """Metres between the joints of two motions that is farthest."""
    return float((first.joints[frames] - second.joints[frames]).norm(dim=-1).max())


def carried_on(motion: Motion, frame: int) -> torch.Tensor:
    """Joints from a frame on, from where the body is and looks there."""
    motion = motion.to(dtype=torch.float64)
    floor = motion.translation[frame] * motion.translation.new_tensor([1.0, 1.0, 0.0])
    return (motion.joints[frame:] - floor) @ rotation_z(-motion.heading[frame]).mT


@pytest.mark.parametrize("method", METHODS)
def test_outside_of_a_change_a_motion_stays_what_it_was(model, motion, method):
    changed = model.generate(TIMELINE, seed=1, steps=4, method=method, keep=motion, change=Change(1, 2))[0]
    assert apart(changed, motion, slice(0, 20)) < 1e-6
    assert apart(changed, motion, slice(25, 35)) > 0.01
    assert (carried_on(changed, 40) - carried_on(motion, 40)).abs().max() < 1e-6


@pytest.mark.parametrize("sampler", ["ddim", "dpm_solver"])
def test_any_sampler_keeps_what_is_kept(model, motion, sampler):
    changed = model.generate(TIMELINE, seed=1, steps=3, sampler=sampler, keep=motion, change=Change(3))[0]
    assert apart(changed, motion, slice(0, 60)) < 1e-6 and apart(changed, motion, slice(66, 80)) > 0.01


def test_a_change_of_an_arm_leaves_the_path_and_all_other_rotations(model, motion):
    changed = model.generate(TIMELINE, seed=1, steps=4, keep=motion, change=TIMELINE.prompts[1])[0]
    arm = [joint in BodyPart.RIGHT_ARM.joints for joint in JOINTS]
    still = torch.tensor([not each for each in arm])
    assert (changed.joints - motion.joints)[:, still].abs().max() < 1e-6
    moved = (changed.joints - motion.joints).abs().amax(dim=(1, 2)) > 1e-4
    assert moved[22:58].all() and not moved[:20].any() and not moved[60:].any()


@pytest.mark.parametrize("method", ["stmc", "sinc"])
def test_only_crops_that_a_change_needs_are_denoised_and_nothing_else_changes(model, motion, method, monkeypatch):
    denoise, denoised = MdmSmpl.denoise, []

    def counting(self, x, *others):
        denoised.append(len(x))
        return denoise(self, x, *others)

    monkeypatch.setattr(MdmSmpl, "denoise", counting)

    def made() -> Motion:
        denoised.clear()
        arm = Change(1.5, 2.5, ["right arm"])
        return model.generate(TIMELINE, seed=1, steps=2, method=method, keep=motion, change=arm)[0]

    few, rows = made(), sum(denoised)
    monkeypatch.setattr("stmc.composing.running.crops_needed", lambda plans, *others: [True] * len(plans[0].crops))
    every, all_rows = made(), sum(denoised)
    assert apart(few, every, slice(None)) < 1e-5
    assert rows < all_rows


def test_a_motion_goes_on_behind_its_end(model, motion):
    longer = model.generate("walk # 0 # 6", seed=1, steps=4, keep=motion)[0]
    assert longer.frames == 120 and apart(longer, motion, slice(0, 80)) < 1e-6
    steps = longer.translation.diff(dim=0).norm(dim=-1)
    assert steps[79] < 3 * steps[:79].max()  # no jump where the new begins


def test_several_samples_of_a_change_share_what_is_kept_and_belong_to_their_seeds(model, motion):
    several = model.generate([TIMELINE] * 2, seed=[5, 6], steps=4, keep=motion, change=Change(1, 2))
    alone = model.generate(TIMELINE, seed=6, steps=4, keep=motion, change=Change(1, 2))[0]
    assert apart(*several, slice(0, 20)) < 1e-6 < 1e-3 < apart(*several, slice(20, 40))
    assert apart(several[1], alone, slice(None)) < 1e-4


def test_the_result_is_where_the_kept_motion_is(model):
    recorded = walking(seconds=3).to(dtype=torch.float32)
    turn = rotation_z(torch.tensor(0.5))
    rotations = torch.cat([turn @ recorded.rotations[:, :1], recorded.rotations[:, 1:]], dim=1)
    place = recorded.translation @ turn.mT + torch.tensor([3.0, -2.0, 0.4])
    moved = Motion.posed(rotations, place, 20.0, Skeleton.default())
    changed = model.generate("walk # 0 # 3", steps=4, keep=moved, change=Change(2))[0]
    assert apart(changed, moved, slice(0, 40)) < 1e-5


def test_a_recording_of_another_body_and_frame_rate_is_put_on_the_models(model):
    tall = Skeleton(Skeleton.default().offsets.double() * 1.2)
    own = walking(seconds=3, fps=30.0)
    recorded = Motion.posed(own.rotations, own.translation * 1.2, 30.0, tall)
    body = move_to_body(recorded, model.skeleton, 20)
    assert body.frames == 60 and body.fps == 20
    expected = walking(seconds=3, fps=30.0).resampled(20)
    assert (body.translation - expected.translation)[:, :2].abs().max() < 0.02
    changed = model.generate("walk # 0 # 3", steps=2, keep=recorded, change=Change(2))[0]
    assert apart(changed, body.to(dtype=torch.float32), slice(0, 40)) < 1e-5
    giant = Skeleton(Skeleton.default().offsets.double() * 3)
    with pytest.raises(SettingError, match="its legs are"):
        move_to_body(Motion.posed(own.rotations, own.translation, 30.0, giant), model.skeleton, 20)


def test_what_a_prompt_decides_and_where_timelines_differ():
    assert changed_prompt(TIMELINE, TIMELINE.prompts[1]) == (Change(1, 3, ["right arm"]),)
    later = Timeline.parse("walk # 0 # 4 # legs\nwave # 2 # 3 # right arm")
    [first, second] = changed_prompts(TIMELINE, later)
    assert (first.start, first.end, second.start, second.end) == (1.0, 2.0, 2.0, 3.0)
    assert first.parts == second.parts == {BodyPart.RIGHT_ARM}
    assert changed_prompts(TIMELINE, TIMELINE) == ()
    [without] = changed_prompts(TIMELINE, Timeline(TIMELINE.prompts[:1]))  # the arm walked before and after it
    assert (without.start, without.end, without.parts) == (1.0, 3.0, {BodyPart.RIGHT_ARM})
    with pytest.raises(SettingError, match="not a prompt"):
        changed_prompt(TIMELINE, Prompt("nod", 0, 1))


def test_weights_are_one_outside_and_fade_within(motion):
    weights = Kept.all_but([Change(1, 2, ["right arm"], border=0.2)], motion, 80).weights
    assert (weights[:20] == 1).all() and (weights[40:] == 1).all() and (weights[:, LEGS] == 1).all()
    arm = weights[20:40, ARM]
    assert torch.allclose(arm[:5], torch.tensor([0.8, 0.6, 0.4, 0.2, 0.0])) and torch.equal(arm, arm.flip(0))
    at_start = Kept.all_but([Change(0, 1)], motion, 80).weights
    assert (at_start[:15] == 0).all()  # nothing stands before it


@pytest.mark.parametrize(
    ("change", "message"),
    [((2, 1), "end after"), ((-1, 1), "from 0"), ((0, 1, ["wing"]), "wing"), ((0, 1, (), math.nan), "border")],
)
def test_a_change_that_cannot_be_is_refused(change, message):
    with pytest.raises(SettingError, match=message):
        Change(*change)


def test_what_cannot_be_kept_is_refused(model, motion):
    with pytest.raises(SettingError, match="pass the motion"):
        model.generate(TIMELINE, steps=1, change=Change(1, 2))
    with pytest.raises(SettingError, match="nothing to generate"):
        model.generate(TIMELINE, steps=1, keep=motion)
    with pytest.raises(SettingError, match="2 motions for 1"):
        model.generate(TIMELINE, steps=1, keep=[motion, motion], change=Change(1, 2))


def test_a_change_is_read_as_a_prompt_without_a_text():
    assert Change.parse("2 # 4 # right arm # legs") == Change(2.0, 4.0, ["right arm", "legs"])
    assert Change.parse("2") == Change(2.0)
    with pytest.raises(SettingError, match="must be start"):
        Change.parse("soon")


def test_what_is_known_stands_in_every_prediction_of_a_flow_of_texts_too(motion):
    from test_methods import OneWord

    from stmc.denoisers import FlowMdm

    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = FlowMdm(205, 384, absolute_from=90, width=16, feedforward=32, layers=1, heads=2, attention_window=20)
    flow = dataclasses.replace(tiny(), denoiser=network.eval(), text_encoder=OneWord())
    changed = flow.generate(TIMELINE, seed=1, steps=3, method="flow_mdm", keep=motion, change=Change(1, 2))[0]
    assert apart(changed, motion, slice(0, 20)) < 1e-6 and apart(changed, motion, slice(25, 35)) > 0.01
