"""Recordings as CMU's database is passed around, written from world rotations: the way back from what `cmu` reads."""

from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from stmc.data.sources.cmu import catalogue as cmu
from stmc.motion.body import JOINTS
from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import axis_angle_to_matrix

LEGS_APART = Rotation.from_euler("z", 20, degrees=True).as_matrix()
"""CMU's rest pose spreads the legs: the left one by this, the right one by its inverse."""

FRAMES = ("-10 20 30", "0 0 20", "180 -30 -90")
"""Axes that bones turn about, in an ASF file."""


@dataclass
class Actor:
    """Bones by the names of one of `cmu.FORMATS`: parents, rest offsets in the file's unit, and which SMPL joint's
    world rotation each has. `turns` [frames, 22, 3, 3] and `path` [frames, 3] are in the files' axes, y up."""

    names: dict
    turns: torch.Tensor
    path: torch.Tensor
    unit: float = 0.06

    def __post_init__(self):
        parents = {"pelvis": None, "spine1": "pelvis", "spine3": "spine1", "neck": "spine3", "head": "neck"}
        for side in ("left_", "right_"):
            for chain in ("spine3 collar shoulder elbow wrist", "pelvis hip knee ankle"):
                first, *rest = chain.split()
                links = [first, *(side + joint for joint in rest)]
                parents |= dict(zip(links[1:], links, strict=False))
        self.parents = parents
        rest = Skeleton.default().rest.double().numpy()
        place = {joint: rest[JOINTS.index(joint)] for joint in parents}
        self.offsets = {
            joint: (place[joint] - place[parent] if parent else np.zeros(3)) / self.unit
            for joint, parent in parents.items()
        }
        for side, apart in (("left_", LEGS_APART), ("right_", LEGS_APART.T)):
            for joint in ("knee", "ankle"):
                self.offsets[side + joint] = apart @ self.offsets[side + joint]

    def locals(self):
        """Each joint's rotation in its parent's frame, [frames, 3, 3]."""
        world = {joint: self.turns[:, JOINTS.index(joint)].numpy() for joint in self.parents}
        return {
            joint: world[parent].transpose(0, 2, 1) @ world[joint] if parent else world[joint]
            for joint, parent in self.parents.items()
        }

    def bvh(self, t_pose=False, rate=120):
        """With a first frame in which nothing is turned, and what a conversion leaves behind it, if `t_pose`."""
        order, columns, turned = list(self._depth_first("pelvis")), [], self.locals()
        for joint in order:
            columns += [self.path.numpy() / self.unit] if joint == "pelvis" else []
            columns.append(Rotation.from_matrix(turned[joint]).as_euler("ZYX", degrees=True))
        rows = np.concatenate(columns, axis=1)
        if t_pose:
            damaged = [7 * rows[:1]] * cmu.DAMAGED if self.names == cmu.DAZ else []
            rows = np.concatenate([0 * rows[:1], *damaged, rows])
        text = "\n".join(" ".join(f"{value:.9f}" for value in row) for row in rows)
        head = f"MOTION\nFrames: {len(rows)}\nFrame Time: {1 / rate:.7f}\n"
        return f"HIERARCHY\n{self._hierarchy('pelvis')}{head}{text}\n"

    def _depth_first(self, joint):
        yield joint
        for child, parent in self.parents.items():
            if parent == joint:
                yield from self._depth_first(child)

    def _hierarchy(self, joint):
        below = "".join(self._hierarchy(child) for child, parent in self.parents.items() if parent == joint)
        turns = "Zrotation Yrotation Xrotation"
        channels = f"6 Xposition Yposition Zposition {turns}" if joint == "pelvis" else f"3 {turns}"
        offset = " ".join(f"{value:.9f}" for value in self.offsets[joint])
        kind = "ROOT" if joint == "pelvis" else "JOINT"
        below = below or "End Site\n{\nOFFSET 0 1 0\n}\n"
        return f"{kind} {self.names[joint]}\n{{\nOFFSET {offset}\nCHANNELS {channels}\n{below}}}\n"

    def asf(self):
        """A bone's direction leads to where its children begin, so that siblings come behind bones of their own."""
        bones, tree = [], []
        for number, (joint, parent) in enumerate(self.parents.items()):
            if parent is None:
                continue
            length = np.linalg.norm(self.offsets[joint])
            direction = " ".join(f"{value:.12f}" for value in self.offsets[joint] / length)
            link, own = f"to_{self.names[joint]}", self.names[joint]
            frame = FRAMES[number % 3]
            bones.append(f"begin\n id {number}\n name {link}\n direction {direction}\n length {length:.12f}\n")
            bones.append(f" axis 0 0 0  XYZ\nend\nbegin\n name {own}\n direction 0 1 0\n length 1\n")
            bones.append(f" axis {frame}  XYZ\n")
            bones.append(" dof rx ry rz\n limits (-180.0 180.0)\n        (-90.0 90.0)\nend\n")
            tree += [f"{self.names[parent]}_end {link}" if parent != "pelvis" else f"root {link}", f"{link} {own}"]
            zero = f"begin\n name {own}_end\n direction 0 -1 0\n length 1\n axis 0 0 0 XYZ\nend\n"
            bones.append(zero)
            tree.append(f"{own} {own}_end")
        head = ":version 1.10 # a comment\n:name VICON\n:units\n  mass 1.0\n  length 0.45\n  angle deg\n"
        root = ":root\n order TX TY TZ RX RY RZ\n axis XYZ\n position 0 0 0\n orientation 0 0 0\n"
        lines = "\n".join(tree)
        return f"{head}{root}:bonedata\n{''.join(bones)}:hierarchy\n begin\n{lines}\n end\n"

    def amc(self):
        turned, blocks = self.locals(), []
        for number, (joint, parent) in enumerate(self.parents.items()):
            axes = Rotation.from_euler("xyz", [float(word) for word in FRAMES[number % 3].split()], degrees=True)
            axes = axes.as_matrix() if parent else np.eye(3)
            angles = Rotation.from_matrix(axes.T @ turned[joint] @ axes).as_euler("xyz", degrees=True)
            place = [] if parent else [self.path.numpy() / self.unit]
            blocks.append((self.names[joint], np.concatenate([*place, angles], axis=1)))
        lines = ["# a comment", ":FULLY-SPECIFIED", ":DEGREES"]
        for frame in range(len(self.path)):
            lines.append(str(frame + 1))
            lines += [f"{name} {' '.join(f'{value:.9f}' for value in values[frame])}" for name, values in blocks]
        return "\n".join(lines) + "\n"


def moving(frames=240, seed=0, size=0.4):
    """Smooth world rotations of every joint, in the files' axes, and a path: two seconds at CMU's rate."""
    generator = torch.Generator().manual_seed(seed)
    waves = size * torch.randn(2, 22, 3, generator=generator, dtype=torch.float64)
    phase = torch.linspace(0, 3, frames, dtype=torch.float64)
    turns = torch.sin(phase)[:, None, None] * waves[0] + torch.cos(phase)[:, None, None] * waves[1]
    turns[:, JOINTS.index("spine2")] = turns[:, JOINTS.index("spine1")]
    for side in ("left", "right"):
        turns[:, JOINTS.index(f"{side}_foot")] = turns[:, JOINTS.index(f"{side}_ankle")]
    path = torch.stack([torch.zeros_like(phase), torch.full_like(phase, 0.9), phase / 2], dim=-1)
    return axis_angle_to_matrix(turns), path
