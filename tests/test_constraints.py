"""Constraints beside text: met, whatever a network that knows nothing says; and the way there is kinematics."""

import json
import math

import pytest
import torch
from helpers.motions import walking
from helpers.tiny_model import tiny

import stmc
from stmc.editing import Change, Kept
from stmc.editing.conditions import clean_motions
from stmc.editing.constraints import (
    Guidance,
    Heading,
    Hold,
    Keyframe,
    Path,
    Pose,
    Target,
    constraint_of,
    project,
    read_constraints,
)
from stmc.editing.constraints.pose import bump
from stmc.motion.body import JOINTS, PARENTS
from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import global_rotations
from stmc.motion.inverse_kinematics import bend_limb
from stmc.motion.motion import Motion
from stmc.settings.records import SettingError

WALK = "walk # 0 # 3 # legs"
SEEN = walking(seconds=3)
ALL_FREE = torch.ones(60, 5)


@pytest.fixture(scope="module")
def model() -> stmc.Model:
    return tiny()


@pytest.fixture(scope="module")
def free(model) -> Motion:
    """What is made of the text alone."""
    return model.generate(WALK, steps=4)[0]


def worst(constraint, motion: Motion) -> float:
    return float(constraint.errors(Pose.of(motion)).max())


@pytest.mark.parametrize(
    ("constraint", "most"),
    [
        (Path([(0, 0), (0, -0.6), (0.6, -0.6)]), 0.05),
        (Path([(1, 1), (1, 2)], end=2, facing=math.pi), 0.05),
        (Target("right_hand", (-0.35, -0.35, 1.25), 1.5), 0.02),
        (Target("left_foot", (0.12, -0.15, 0.2), 1.0, 1.5), 0.02),
        (Hold("left_hand", 1, 2), 0.02),
        (Keyframe(SEEN.trimmed(30, 31), 1.5), 0.02),
        (Heading(0.8, 1.5), 0.2),
    ],
    ids=lambda each: type(each).__name__,
)
def test_a_motion_meets_its_constraint(model, free, constraint, most):
    [met] = model.generate(WALK, steps=4, constraints=[constraint])
    assert worst(constraint, met) <= most < worst(constraint, free)


COMBINED = [
    Path([(0, 0), (0, -0.6), (0.6, -0.6)]),
    Keyframe(SEEN.trimmed(30, 31), 1.0),
    Target("right_foot", (-0.1, -0.5, 0.15), 0.5),
    Target("right_hand", (0.1, -1.0, 1.2), 2.0),
    Hold("left_hand", 2.4, 2.8),
]
TRACKS = WALK + "\nwave # 0.5 # 2 # right arm\nnod # 1 # 2.5 # head"


@pytest.mark.parametrize("clean_feet", [False, True])
def test_constraints_of_all_kinds_and_several_texts_hold_together_and_with_clean_feet(model, clean_feet):
    [met] = model.generate(TRACKS, steps=4, constraints=COMBINED, clean_feet=clean_feet)
    assert [worst(each, met) <= (0.05 if isinstance(each, Path) else 0.02) for each in COMBINED] == [True] * 5


def test_guidance_leads_the_root_to_a_path_and_a_heading_at_once(model):
    features = model.motion_statistics.normalise(model.representation.encode(SEEN).float())
    for each, most in ((Path([(0, 0), (0, -2), (2, -2)]), 0.06), (Heading(1.5, 1.0), 0.3)):
        guidance = Guidance([each], *parts_of(model), torch.ones_like(features))
        before, after = (float(each.errors(guidance.pose(values)).max()) for values in (features, guidance(features)))
        assert after < most < before / 3


def parts_of(model):
    return (model.representation, model.motion_statistics, model.skeleton, 20, (0.0, 0.0, 0.0, 0.0))


def test_guidance_brings_clean_features_nearer_and_leaves_alone_what_is_not_free(model):
    features = model.motion_statistics.normalise(model.representation.encode(SEEN).float())
    guidance = Guidance([], *parts_of(model), torch.ones_like(features))
    hand = guidance.pose(features).joint("right_hand")[20]
    target = Target("right_hand", (hand + 0.15).tolist(), 1.0)
    free = torch.ones_like(features)
    free[:, model.representation.columns[stmc.BodyPart.LEGS]] = 0
    guidance = Guidance([target], *parts_of(model), free)
    moved = guidance(features)
    before, after = (float(target.errors(guidance.pose(each)).max()) for each in (features, moved))
    assert after < before / 2
    assert torch.equal(moved[:, free[0] == 0], features[:, free[0] == 0])
    assert (moved - features)[:10].abs().max() < (moved - features)[15:25].abs().max() / 10  # far away hardly


def test_positions_of_guided_features_are_those_of_their_rotations(model):
    features = model.motion_statistics.normalise(model.representation.encode(SEEN).float())
    target = Target("right_hand", (0.2, -1.0, 1.4), 1.0)
    moved = Guidance([target], *parts_of(model), torch.ones_like(features))(features)
    raw = model.motion_statistics.restore(moved)
    posed, told = (model.representation.decode(raw, 20, each) for each in (model.skeleton, None))
    assert (posed.joints - told.joints).norm(dim=-1).max() < 1e-3


def test_a_limb_bends_to_where_its_end_should_be_and_bones_keep_their_lengths():
    chain = [JOINTS.index(f"left_{joint}") for joint in ("shoulder", "elbow", "wrist")]
    world, joints = global_rotations(SEEN.rotations, PARENTS), SEEN.joints[:, chain]
    lengths = joints.diff(dim=1).norm(dim=-1)
    reach = 0.8 * lengths.sum(dim=1, keepdim=True) * torch.tensor([0.0, 0.6, 0.8], dtype=torch.float64)
    hinge = world[:, chain[0]] @ torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
    upper, lower = bend_limb(world[:, chain[0]], world[:, chain[1]], joints, reach, hinge)
    offsets = Skeleton.default().offsets.double()
    elbow = joints[:, 0] + upper @ offsets[chain[1]]
    assert ((elbow + lower @ offsets[chain[2]]) - joints[:, 0] - reach).norm(dim=-1).max() < 1e-6
    same_upper, same_lower = bend_limb(
        world[:, chain[0]], world[:, chain[1]], joints, joints[:, 2] - joints[:, 0], hinge
    )
    assert (same_upper - world[:, chain[0]]).abs().max() < 1e-6
    assert (same_lower - world[:, chain[1]]).abs().max() < 1e-6
    upper, lower = bend_limb(world[:, chain[0]], world[:, chain[1]], joints, 10 * reach, hinge)
    reached = joints[:, 0] + upper @ offsets[chain[1]] + lower @ offsets[chain[2]]
    assert ((reached - joints[:, 0]).norm(dim=-1) - lengths.sum(dim=1)).abs().max() < 1e-3


def test_projection_touches_nothing_far_from_the_demand_and_nothing_that_is_not_free():
    shoulder, hand = (SEEN.joints[30, JOINTS.index(f"right_{joint}")] for joint in ("shoulder", "hand"))
    target = Target("right_hand", (hand + 0.2 * (shoulder - hand)).tolist(), 1.5)
    skeleton = Skeleton(Skeleton.default().offsets.double())
    met = project(SEEN, [target], skeleton, ALL_FREE)
    assert worst(target, met) < 1e-6
    assert torch.equal(met.rotations[:20], SEEN.rotations[:20]) and torch.equal(met.rotations[45:], SEEN.rotations[45:])
    assert (met.joints.diff(dim=0) - SEEN.joints.diff(dim=0)).norm(dim=-1).max() < 0.06  # no pop
    kept = project(SEEN, [target], skeleton, torch.zeros(60, 5))
    assert torch.equal(kept.rotations, SEEN.rotations)


def test_a_bump_is_one_within_and_falls_smoothly():
    values = bump(20, slice(8, 12), 4, torch.zeros(1))
    assert (values[8:12] == 1).all() and values[:4].max() < 1e-6 and values.diff().abs().max() < 0.4


def test_a_path_says_where_the_pelvis_is_at_every_frame():
    pose = Pose.of(SEEN)
    _, where, direction = Path([(0, 0), (0, -2), (2, -2)]).places(pose)
    assert torch.allclose(where[[0, 59]], where.new_tensor([[0.0, 0.0], [2.0, -2.0]]), atol=1e-6)
    assert direction[5] == pytest.approx(0, abs=1e-6) and direction[50] == pytest.approx(math.pi / 2, abs=1e-6)
    span, where, _ = Path([(0, 0), (1, 0), (1, 1)], times=[0.5, 1, 2]).places(pose)
    assert (span.start, span.stop) == (10, 40) and torch.allclose(where[10], where.new_tensor([1.0, 0.0]))


def test_a_motion_begins_where_its_path_does_and_looks_along_it(model):
    [motion] = model.generate(WALK, steps=4, constraints=[Path([(2, 1), (3, 1)])])
    assert (motion.translation[0, :2] - torch.tensor([2.0, 1.0])).norm() < 0.03
    assert float(motion.heading[0]) == pytest.approx(math.pi / 2, abs=0.3)


def test_a_motion_begins_as_a_heading_demands_that_starts_with_it(model):
    demanded = Heading(2.5)
    [motion] = model.generate(WALK, steps=4, constraints=[demanded])
    assert float(motion.heading[0]) == pytest.approx(2.5, abs=0.3)
    assert worst(demanded, motion) < 0.3
    [aside] = model.generate(WALK, steps=4, constraints=[Path([(2, 1), (3, 1)], facing=None), demanded])
    assert (aside.translation[0, :2] - torch.tensor([2.0, 1.0])).norm() < 0.03
    assert float(aside.heading[0]) == pytest.approx(2.5, abs=0.3)


def test_constraints_leave_alone_what_is_kept(model):
    [before] = model.generate(WALK, seed=1, steps=4)
    target = Target("right_hand", (-0.35, -0.35, 1.25), 2.0)
    change = Change(1, 3, ["right arm"])
    [after] = model.generate(WALK, seed=2, steps=4, keep=before, change=change, constraints=[target])
    still = torch.tensor([joint not in stmc.BodyPart.RIGHT_ARM.joints for joint in JOINTS])
    assert (after.joints - before.joints)[:, still].abs().max() < 1e-6
    assert (after.joints - before.joints)[:20].abs().max() < 1e-6
    assert worst(target, after) < worst(target, before)


@pytest.mark.parametrize("parts", [[], ["legs"]])
def test_feet_are_cleaned_of_what_is_new_alone_and_without_a_pop_at_its_border(parts):
    drift = torch.linspace(0, 0.3, 60, dtype=SEEN.translation.dtype)[:, None] * torch.tensor([1.0, 0.0, 0.0])
    slid = Motion.posed(SEEN.rotations, SEEN.translation + drift, 20, Skeleton.default())
    [clean] = clean_motions([slid], [Kept.all_but([Change(1, 2, parts)], slid, 60)], [])
    kept = torch.ones(60, dtype=torch.bool)
    kept[20:40] = False
    assert torch.equal(clean.joints[kept], slid.joints[kept])
    arms = [JOINTS.index(f"{side}_{joint}") for side in ("left", "right") for joint in ("shoulder", "elbow", "wrist")]
    assert torch.equal(clean.rotations[:, arms], slid.rotations[:, arms])
    assert (clean.joints - slid.joints)[20:40].abs().max() > 0.01
    largest = slid.joints.diff(dim=0).norm(dim=-1).max()
    assert clean.joints.diff(dim=0).norm(dim=-1).max() < 1.2 * largest


def test_what_is_kept_stays_when_feet_are_cleaned(model):
    change = Change(1, 2)
    made, clean = (
        model.generate(WALK, seed=2, steps=4, keep=SEEN, change=change, clean_feet=each)[0] for each in (False, True)
    )
    assert (clean.joints - made.joints)[:20].abs().max() < 1e-6
    assert (clean.joints - made.joints)[40:].abs().max() < 1e-6


def test_feet_of_kept_legs_are_left_alone(model):
    change = Change(1, 2, ["right arm"])
    made, clean = (
        model.generate(WALK, seed=2, steps=4, keep=SEEN, change=change, clean_feet=each)[0] for each in (False, True)
    )
    assert torch.equal(clean.joints, made.joints)


def test_a_motion_under_constraints_does_not_depend_on_its_batch(model):
    constraints = [Hold("left_hand", 1, 2)]
    together = model.generate([WALK, "wave # 0 # 4"], seed=[3, 4], steps=2, constraints=constraints)
    [alone] = model.generate(WALK, seed=3, steps=2, constraints=constraints)
    assert (together[0].joints - alone.joints).abs().max() < 1e-3


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Path([(0, 0)]), "at least two"),
        (lambda: Path([(0, 0), (1, math.nan)]), "finite"),
        (lambda: Path([(0, 0), (1, 0)], times=[1, 1]), "increase"),
        (lambda: Target("left_wing", (0, 0, 0), 1), "left_wing"),
        (lambda: Target("left_hand", (0, 0), 1), "3 finite numbers"),
        (lambda: Hold("left_hand", 2, 1), "in order"),
        (lambda: Heading(math.inf), "finite"),
        (lambda: Keyframe(SEEN, -1), "from 0"),
    ],
)
def test_a_constraint_that_cannot_be_is_refused(make, message):
    with pytest.raises(SettingError, match=message):
        make()


def test_methods_and_joints_that_constraints_do_not_fit_are_refused(model):
    with pytest.raises(SettingError, match="composes at every step"):
        model.generate(WALK, steps=1, method="sinc", constraints=[Heading(1.0)])
    with pytest.raises(SettingError, match="joints_from"):
        model.generate(WALK, steps=1, joints_from="features", constraints=[Heading(1.0)])


def test_a_keyframe_is_the_pose_at_its_second_and_none_beyond_the_motion():
    def read(second: object) -> Motion:
        return constraint_of({"keyframe": {"motion": "it", "at": 0, "second": second}}, {"it": SEEN}.__getitem__).pose

    for second, frame in ((0, 0), (1.15, 23), (2.99, 59)):
        assert torch.equal(read(second).joints, SEEN.joints[frame : frame + 1])
    for second in (3.0, -0.1, math.inf, math.nan):
        with pytest.raises(SettingError, match=r"it has no pose at .* must be from 0 to below 3"):
            read(second)
    with pytest.raises(SettingError, match="keyframe"):
        read("1")


def test_constraints_are_read_from_json(tmp_path):
    stmc.write(SEEN, tmp_path / "seen.npz")
    entries = [
        {"path": {"points": [[0, 0], [0, -3]], "end": 4}},
        {"heading": {"angle": 1.5, "start": 2}},
        {"target": {"joint": "right_hand", "point": [0, -1, 1.2], "start": 2}},
        {"hold": {"joint": "left_hand", "start": 1, "end": 2}},
        {"keyframe": {"at": 2, "motion": str(tmp_path / "seen.npz"), "second": 1.0}},
    ]
    file = tmp_path / "constraints.json"
    file.write_text(json.dumps(entries))
    *read, key = read_constraints(file)
    target = Target("right_hand", (0, -1, 1.2), 2)
    assert read == [Path([(0, 0), (0, -3)], end=4), Heading(1.5, 2), target, Hold("left_hand", 1, 2)]
    assert torch.allclose(key.pose.joints[0], SEEN.joints[20].float(), atol=1e-5)


@pytest.mark.parametrize("text", ["{", "{}", '[{"fly": {}}]', '[{"path": {"wings": 2}}]', "[3]"])
def test_a_file_that_has_no_constraints_is_refused_in_one_line(tmp_path, text):
    file = tmp_path / "bad.json"
    file.write_text(text)
    with pytest.raises(SettingError, match=r"bad\.json") as refused:
        read_constraints(file)
    assert "\n" not in str(refused.value)
