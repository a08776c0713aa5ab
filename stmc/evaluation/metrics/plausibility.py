"""Validation of joints: people in metres, z up, in SMPL's order, not mirrored.

A wrong axis or order makes no metric fail but all of them meaningless. Depends on bodies and their proportions;
independent of particular metrics.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from stmc.motion.body import JOINTS, PARENTS
from stmc.motion.body_model import Skeleton

SIZES = (0.8, 2.8)
"""Legal mean of the larger side of the box around a person's joints in metres, from crouching to raised arms."""
UNITS = {"centimetres": 100.0, "millimetres": 1000.0, "inches": 39.37, "decimetres": 10.0}

LIMBS = ("knee", "ankle", "elbow", "wrist")
"""Joints at the ends of long bones. Other bones are shorter, and their lengths vary between skeletons."""
PROPORTION = 1.8
"""Maximum ratio between a long bone and the bundled skeleton's, relative to the other long bones."""
UPRIGHT = 0.5
"""Minimum mean cosine between trunks and the vertical in a set of motions; 1 is standing."""


class ImplausibleMotion(ValueError):
    """Joints that cannot be a person's; the message describes the joints and the expected ones."""


def check_joints(motions: Sequence[Float[Tensor, "_ _ 3"]]) -> None:
    """Raise `ImplausibleMotion` unless the motions, taken together, show people in metres, z up, mostly upright.

    Joints must be at least SMPL's first 22, in SMPL's order. All frames of all motions are judged together: a cartwheel
    among other motions is accepted, a set of lying people only is not.
    """
    if not motions:
        raise ImplausibleMotion("no motions to check; pass at least one")
    for number, joints in enumerate(motions):
        if not 22 <= joints.shape[1] <= len(JOINTS):
            raise ImplausibleMotion(
                f"motion {number} has {joints.shape[1]} joints; it needs SMPL's first 22, or all 24"
            )
        if not joints.isfinite().all():
            raise ImplausibleMotion(f"motion {number} has positions that are not finite")
    joints = torch.cat([joints[:, :22].double() for joints in motions])
    _check_size(joints)
    _check_order(joints)
    _check_upright(joints)
    _check_sides(joints)


def _check_size(joints: Tensor) -> None:
    box = joints.amax(dim=1) - joints.amin(dim=1)
    size = float(box.amax(dim=-1).median())
    if SIZES[0] <= size <= SIZES[1]:
        return
    for unit, factor in UNITS.items():
        if SIZES[0] <= size / factor <= SIZES[1]:
            raise ImplausibleMotion(f"bodies are {size:.4g} tall, which suggests {unit}; divide by {factor:g}")
    raise ImplausibleMotion(f"bodies are {size:.3g} m tall; people are {SIZES[0]} to {SIZES[1]} m; convert to metres")


def _check_order(joints: Tensor) -> None:
    lengths = (joints[:, 1:] - joints[:, list(PARENTS[1:22])]).norm(dim=-1).median(dim=0).values
    long = torch.tensor([joint.endswith(LIMBS) for joint in JOINTS[1:22]])
    ratio = lengths / Skeleton.default().offsets[1:22].double().norm(dim=-1)
    ratio = ratio / ratio[long].median()
    wrong = torch.where(long, (ratio > PROPORTION) | (ratio < 1 / PROPORTION), lengths > lengths[long].max())
    if wrong.any():
        bones = ", ".join(
            f"{JOINTS[PARENTS[bone + 1]]} to {JOINTS[bone + 1]} ({lengths[bone]:.2f} m)"
            for bone in wrong.nonzero()[:, 0].tolist()
        )
        raise ImplausibleMotion(f"joints are not in SMPL's order; implausible bones: {bones}")


def _check_upright(joints: Tensor) -> None:
    trunk = F.normalize(joints[:, JOINTS.index("neck")] - joints[:, 0], dim=-1).mean(dim=0)
    if float(trunk[2]) >= UPRIGHT:
        return
    axis = int(trunk.abs().argmax())
    if float(trunk[axis].abs()) < UPRIGHT:
        raise ImplausibleMotion(
            f"bodies do not stand; the mean direction of their trunks is {_format_vector(trunk)} "
            "and should be near z, (0, 0, 1)"
        )
    name = f"{'-' if trunk[axis] < 0 else ''}{'xyz'[axis]}"
    remedy = "; rotate it by (x, y, z) → (x, -z, y)" if name == "y" else ""
    raise ImplausibleMotion(f"the motion is {name} up, not z up{remedy}")


def _check_sides(joints: Tensor) -> None:
    across = joints[:, JOINTS.index("left_hip")] - joints[:, JOINTS.index("right_hip")]
    up = across.new_tensor([0.0, 0.0, 1.0]).expand_as(across)
    forward = F.normalize(torch.linalg.cross(across, up), dim=-1)
    left, right = (
        joints[:, JOINTS.index(f"{side}_foot")] - joints[:, JOINTS.index(f"{side}_ankle")] for side in ("left", "right")
    )
    if float((F.normalize(left + right, dim=-1) * forward).sum(dim=-1).mean()) < 0:
        raise ImplausibleMotion(
            "toes point backwards: left and right are exchanged, or the motion is mirrored (an axis negated or two "
            "exchanged without negating one)"
        )


def _format_vector(vector: Tensor) -> str:
    return f"({', '.join(f'{value:.2f}' for value in vector.tolist())})"
