"""A made-up but plausible motion for tests of export and viewing: someone walks a curve and raises the right arm."""

import math

import torch

from stmc.motion.body import JOINTS, NUM_ROTATIONS
from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import axis_angle_to_matrix, matrix_to_axis_angle, rotation_z
from stmc.motion.motion import Motion

STANDING = axis_angle_to_matrix(torch.tensor([math.pi / 2, 0.0, 0.0], dtype=torch.float64))
"""Turns SMPL's rest pose (y up, facing z) to a z-up world: it faces -y with its left towards +x."""

_UPRIGHT = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]], dtype=torch.float64)


def walking(seconds: float = 6.0, fps: float = 20.0, speed: float = 1.1, turn: float = 0.18) -> Motion:
    """Walks at `speed` m/s, turns left by `turn` rad/s; the right arm is up in the middle third."""
    time = torch.arange(int(seconds * fps), dtype=torch.float64) / fps
    step = 2 * math.pi * 0.9 * time
    zero = torch.zeros_like(time)
    poses = torch.zeros(len(time), NUM_ROTATIONS, 3, dtype=torch.float64)

    def bend(joint: str, x=zero, y=zero, z=zero) -> None:
        poses[:, JOINTS.index(joint)] = torch.stack([x, y, z], dim=-1)

    for side, sign in (("left", 1.0), ("right", -1.0)):
        swing = sign * torch.sin(step)
        bend(f"{side}_hip", x=-0.12 - 0.42 * swing)
        bend(f"{side}_knee", x=0.25 + 0.45 * torch.clamp(sign * torch.cos(step), min=0) + 0.1 * swing)
        bend(f"{side}_ankle", x=-0.05 + 0.15 * swing)
        bend(f"{side}_collar", z=zero - sign * 0.1)
        bend(f"{side}_elbow", y=-sign * (0.35 + 0.15 * swing))
    up = torch.clamp(torch.sin(torch.pi * (3 * time / seconds - 1)), min=0) ** 0.5 * (time > seconds / 3)
    for side, sign, lift in (("left", 1.0, zero), ("right", -1.0, up)):
        hang = axis_angle_to_matrix(torch.stack([zero, zero, -sign * (1.25 - 2.3 * lift)], -1))
        forth = axis_angle_to_matrix(torch.stack([0.45 * sign * torch.sin(step) * (1 - lift), zero, zero], -1))
        poses[:, JOINTS.index(f"{side}_shoulder")] = matrix_to_axis_angle(forth @ hang)
    bend("spine2", x=zero + 0.05, y=0.08 * torch.sin(step))
    bend("head", x=zero + 0.05, y=0.25 * torch.sin(2 * torch.pi * time / seconds))
    rotations = axis_angle_to_matrix(poses)
    heading = turn * time
    rotations[:, 0] = rotation_z(heading) @ _UPRIGHT @ rotations[:, 0]
    velocity = speed / fps * torch.stack([torch.sin(heading), -torch.cos(heading), zero], -1)
    translation = torch.cumsum(velocity, 0)
    skeleton = Skeleton(Skeleton.default().offsets.double())
    motion = Motion.posed(rotations, translation, fps, skeleton)
    grounded = translation.clone()
    grounded[:, 2] = -motion.joints[:, :, 2].amin(dim=1) + 0.02
    return Motion.posed(rotations, grounded, fps, skeleton)


def standing_still(frames: int, fps: float = 20.0) -> Motion:
    """Stands on the floor with a little bent knees and hanging arms, and faces -y."""
    poses = torch.zeros(NUM_ROTATIONS, 3, dtype=torch.float64)
    for side, sign in (("left", 1.0), ("right", -1.0)):
        for name, angle in (("hip", -0.1), ("knee", 0.2), ("ankle", -0.1)):
            poses[JOINTS.index(f"{side}_{name}"), 0] = angle
        poses[JOINTS.index(f"{side}_shoulder"), 2] = -sign * 1.35
        poses[JOINTS.index(f"{side}_elbow"), 1] = -sign * 0.2
    rotations = axis_angle_to_matrix(poses).repeat(frames, 1, 1, 1)
    rotations[:, 0] = STANDING
    skeleton = Skeleton(Skeleton.default().offsets.double())
    motion = Motion.posed(rotations, torch.zeros(frames, 3, dtype=torch.float64), fps, skeleton)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64) * -motion.joints[..., 2].min()
    return Motion.posed(rotations, motion.translation + up, fps, skeleton)


def walk(frames=12, fps=20.0, seed=0, dtype=torch.float64) -> Motion:
    """Anybody's pose and place at random, changing little from frame to frame."""
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(frames, 22, 3, generator=generator, dtype=torch.float64).cumsum(dim=0) * 0.05
    rotations = axis_angle_to_matrix(noise)
    rotations[:, 0] = STANDING @ rotations[:, 0]
    translation = torch.randn(frames, 3, generator=generator, dtype=torch.float64).cumsum(dim=0) * 0.03 + 1
    return Motion.posed(rotations.to(dtype), translation.to(dtype), fps, Skeleton.default())
