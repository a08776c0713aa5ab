"""A motion says clearly what it does not accept, and moves in time, space and mirror as one."""

import dataclasses
import math
from xml.etree import ElementTree

import pytest
import torch
from conftest import golden, golden_sets
from helpers.motions import STANDING, walk
from torch.testing import assert_close

from stmc.motion.body import JOINTS, MIRROR
from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import axis_angle_to_matrix, mirror_positions, resample_positions, rotation_z
from stmc.motion.motion import Motion


def test_a_motion_knows_its_length_in_frames_and_seconds():
    motion = walk(30, 20.0)
    assert (motion.frames, len(motion), motion.duration) == (30, 30, 1.5)
    assert repr(motion) == "Motion(30 frames at 20 fps, 1.50 s)"


def test_posed_motions_have_the_pelvis_at_the_translation():
    motion = walk()
    assert_close(motion.joints[:, 0], motion.translation)


@pytest.mark.parametrize(("angle", "direction"), [(0.0, (0, -1, 0)), (math.pi / 2, (1, 0, 0)), (math.pi, (0, 1, 0))])
def test_the_heading_tells_where_the_body_faces(angle, direction):
    root = rotation_z(torch.tensor(angle, dtype=torch.float64)) @ STANDING
    rotations = torch.eye(3, dtype=torch.float64).repeat(2, 22, 1, 1)
    rotations[:, 0] = root
    motion = Motion.posed(rotations, torch.zeros(2, 3, dtype=torch.float64), 20.0, Skeleton.default())
    assert_close(motion.heading, torch.full((2,), angle, dtype=torch.float64))
    assert_close(motion.facing[0], torch.tensor(direction, dtype=torch.float64))
    toes = motion.joints[0, JOINTS.index("left_foot")] - motion.joints[0, JOINTS.index("left_ankle")]
    assert toes @ motion.facing[0] > 0.05
    left = motion.joints[0, JOINTS.index("left_hip")] - motion.joints[0, JOINTS.index("right_hip")]
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    assert_close(left / left.norm(), torch.linalg.cross(up, motion.facing[0]), atol=0.05, rtol=0)


def test_the_mirror_image_walks_on_the_other_side_and_twice_is_the_motion():
    motion = walk()
    mirrored = motion.mirrored()
    assert_close(mirrored.joints, mirror_positions(motion.joints, MIRROR))
    assert_close(mirrored.translation, mirrored.joints[:, 0])
    assert_close(mirrored.heading, -motion.heading)
    twice = mirrored.mirrored()
    assert_close(twice.rotations, motion.rotations)
    assert_close(twice.joints, motion.joints)


def test_another_frame_rate_keeps_the_duration_and_the_path():
    motion = walk(60, 30.0)
    resampled = motion.resampled(20.0)
    assert (resampled.frames, resampled.fps, resampled.duration) == (40, 20.0, 2.0)
    assert_close(resampled.translation[0], torch.lerp(motion.translation[0], motion.translation[1], 0.25))
    assert_close(resampled.joints[:, 0], resampled.translation)
    again = Motion.posed(resampled.rotations, resampled.translation, 20.0, Skeleton.default())
    assert_close(again.joints, resampled.joints, atol=1e-6, rtol=0)


def test_joints_that_rotations_do_not_pose_are_resampled_with_their_bones():
    """As of an estimate from video: a hand that is drawn out, a little more each frame."""
    motion = walk(60, 30.0)
    joints = motion.joints.clone()
    joints[:, -1, 2] += torch.linspace(0, 0.3, 60)
    resampled = dataclasses.replace(motion, joints=joints).resampled(60.0)
    straight = resample_positions(joints, 30.0, 60.0)
    assert_close(resampled.joints, straight, atol=1e-2, rtol=0)
    assert_close(resampled.trimmed(0, 1).joints, straight[:1], atol=1e-6, rtol=0)


def test_the_same_frame_rate_is_the_same_motion():
    motion = walk()
    assert_close(motion.resampled(motion.fps).rotations, motion.rotations)


def test_a_trimmed_motion_is_the_frames_asked_for_where_they_were():
    motion = walk(10)
    trimmed = motion.trimmed(2, 7)
    assert trimmed.frames == 5
    assert_close(trimmed.joints, motion.joints[2:7])
    assert_close(trimmed.rotations, motion.rotations[2:7])


@pytest.mark.parametrize(("start", "end"), [(-1, 5), (5, 5), (6, 5), (0, 11)])
def test_frames_that_are_not_there_cannot_be_kept(start, end):
    with pytest.raises(ValueError, match="cannot trim 10 frames to"):
        walk(10).trimmed(start, end)


def test_a_motion_changes_dtype_as_a_whole():
    motion = walk().to(dtype=torch.float32)
    assert {motion.rotations.dtype, motion.translation.dtype, motion.joints.dtype} == {torch.float32}


@pytest.mark.parametrize("fps", [0.0, -20.0, math.nan, math.inf])
def test_a_frame_rate_must_be_a_positive_number(fps):
    with pytest.raises(ValueError, match=r"fps must be from 1 to 1000, not"):
        dataclasses.replace(walk(), fps=fps)
    with pytest.raises(ValueError, match=r"fps must be from 1 to 1000, not"):
        walk().resampled(fps)


def test_no_frames_are_no_motion():
    empty = torch.zeros(0, 3)
    with pytest.raises(ValueError, match="at least one frame"):
        Motion(torch.zeros(0, 22, 3, 3), empty, torch.zeros(0, 24, 3), 20.0)


@pytest.mark.parametrize("name", ["rotations", "translation", "joints"])
def test_values_that_are_not_finite_are_named_with_their_frame(name):
    motion = walk()
    broken = getattr(motion, name).clone()
    broken[3] = math.nan
    with pytest.raises(ValueError, match=rf"{name} has values that are not finite, first in frame 3"):
        dataclasses.replace(motion, **{name: broken})


def test_a_matrix_that_is_no_rotation_is_named_with_its_joint():
    rotations = walk().rotations.clone()
    rotations[4, 18] *= 1.5
    with pytest.raises(ValueError, match=r"rotations\[4, 18\] \(left_elbow\) is not a rotation"):
        dataclasses.replace(walk(), rotations=rotations)
    rotations = walk().rotations.clone()
    rotations[0, 1] *= -1
    with pytest.raises(ValueError, match=r"rotations\[0, 1\] \(left_hip\) is not a rotation"):
        dataclasses.replace(walk(), rotations=rotations)


def test_mixed_dtypes_are_an_error():
    motion = walk()
    with pytest.raises(ValueError, match=r"translation is torch\.float32"):
        dataclasses.replace(motion, translation=motion.translation.float())


@pytest.mark.parametrize("frames", [1, 3, 60])
def test_a_notebook_shows_moments_of_a_motion_as_stick_figures(frames):
    html = walk(frames)._repr_html_()
    assert html.startswith(f"<div>Motion({frames} frames at 20 fps")
    drawing = ElementTree.fromstring(html.partition("</div>")[2])
    times = [text.text for text in drawing.iter("{http://www.w3.org/2000/svg}text")]
    assert len(times) == min(frames, 8)
    assert (times[0], times[-1]) == ("0.0 s", f"{(frames - 1) / 20:.1f} s")


@pytest.mark.golden
@pytest.mark.parametrize("folder", golden_sets("stmc"))
def test_mirrored_motions_agree_with_the_published_preparation(folder):
    data = golden(folder, "amass_prepare.npz")
    poses, trans, out_poses, out_trans = (
        torch.from_numpy(data[name])
        for name in ("mirror_poses", "mirror_trans", "mirror_out_poses", "mirror_out_trans")
    )
    motion = Motion.posed(axis_angle_to_matrix(poses.reshape(-1, 22, 3)), trans, 20.0, Skeleton.default()).mirrored()
    assert_close(motion.rotations, axis_angle_to_matrix(out_poses.reshape(-1, 22, 3)), atol=1e-12, rtol=0)
    assert_close(motion.translation, out_trans, atol=1e-12, rtol=0)
