"""Guidance by forward kinematics: predicted clean features are moved as little as possible to satisfy constraints.

At every sampling step, the predicted features change by the least amount that brings the body near to the constraints:
least in units of the features' standard deviations, and smooth in time. A reach therefore uses the arm, a lean and a
step as in the data, and the network sees the result at the next step and completes it. This is a maximum a posteriori
estimate of x0 with the network's prediction as the mean of the prior, as in reconstruction guidance (Ho et al. 2022),
through the kinematics as in OmniControl (Xie et al. 2024), but on x0 itself: no gradient passes through the network.
Depends on constraints and features; independent of networks and samplers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor

from stmc.diffusion.statistics import Statistics
from stmc.editing.constraints.constraint import Constraint
from stmc.editing.constraints.pose import Place, Pose
from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import heading, rotation_z
from stmc.motion.representation import SmplRepresentation

TOLERANCE = 0.01
"""Error in metres that costs as much as one standard deviation of one feature in one frame."""
ROOT = 0.3
"""Weight of changes of the root's velocities relative to rotations: they move all later frames."""
_SMOOTH = 0.15
"""Standard deviation, in seconds, of the Gaussian over which a change spreads."""
_ITERATIONS = 6
"""Iterations of L-BFGS at each step."""
_ROUNDS = 3
"""Rounds in which roots are moved to a path; each round corrects what smoothing left in the previous one."""


@dataclass(frozen=True, eq=False)
class Guidance:
    """Move the clean features of one motion, [frames, features] normalised, towards `constraints`.

    Features begin above the origin; `place` is the place where the motion begins. `free` weights the change of each
    feature, from 0 (fixed) to 1 (free).
    """

    constraints: Sequence[Constraint]
    representation: SmplRepresentation
    statistics: Statistics
    skeleton: Skeleton
    fps: float | int
    place: Place
    free: Float[Tensor, "frames features"]

    def __call__(self, x0: Float[Tensor, "frames features"]) -> Float[Tensor, "frames features"]:
        """Return the changed features; position features follow from the rotations."""
        with torch.inference_mode(False), torch.enable_grad():
            x0 = x0.clone()
            with torch.no_grad():
                x0 = self._move_root(x0)
            weights = (self.free.to(x0) * self._feature_weights(x0)).contiguous()
            change = self._least_change(x0, weights)
            with torch.no_grad():
                moved = x0 + change
                return moved + self._position_change(x0, moved) * self.free.to(x0)

    def pose(self, x0: Float[Tensor, "frames features"]) -> Pose:
        """Compute the pose of the body from features, with gradients."""
        raw = self.statistics.restore(x0)
        *origin, angle = self.place
        rotations, translation, _ = self.representation.integrate(raw, angle)
        translation = translation + translation.new_tensor(origin)
        return Pose(rotations, translation, self.skeleton.pose(rotations, translation), self.fps)

    def _move_root(self, x0: Tensor) -> Tensor:
        """Turn and move the root to paths and headings, in closed form.

        The position of the root is a sum of steps, too many for a few iterations of a descent to change together with
        everything else.
        """
        layout, std = self.representation.layout, self.statistics.std.to(x0)
        pose = self.pose(x0)
        for name, compute_steps in (("yaw_velocity", _turns), ("root_velocity", _steps)):
            columns = layout[name]
            for constraint in [*self.constraints] * _ROUNDS:
                steps = compute_steps(constraint, pose)
                if steps is None:
                    continue
                change = torch.zeros_like(x0)
                change[:-1, columns] = steps / std[columns]
                x0 = x0 + change * self.free.to(x0)
                pose = self.pose(x0)
        return x0

    def _least_change(self, x0: Tensor, weights: Tensor) -> Tensor:
        smooth = _smoothing(len(x0), _SMOOTH * self.fps, x0)
        parameters = torch.zeros_like(x0, requires_grad=True)
        optimizer = torch.optim.LBFGS([parameters], max_iter=_ITERATIONS, line_search_fn="strong_wolfe")

        def cost() -> Tensor:
            optimizer.zero_grad()
            pose = self.pose(x0 + (smooth @ parameters) * weights)
            errors = sum(constraint.residuals(pose).square().sum() for constraint in self.constraints) / TOLERANCE**2
            total = parameters.square().sum() + errors
            total.backward()
            return total

        optimizer.step(cost)
        return ((smooth @ parameters) * weights).detach()

    def _feature_weights(self, x0: Tensor) -> Tensor:
        """Weight the features that move the body; position features have weight 0, since they follow."""
        layout, weights = self.representation.layout, torch.zeros_like(x0)
        for name, weight in (("root_height", 1.0), ("root_velocity", ROOT), ("yaw_velocity", ROOT), ("rotations", 1.0)):
            weights[:, layout[name]] = weight
        return weights

    def _position_change(self, before: Tensor, after: Tensor) -> Tensor:
        """Compute the change of position features that follows from a change of the others."""
        columns = self.representation.layout["positions"]
        old, new = (_local_joints(self.pose(x0)) for x0 in (before, after))
        change = torch.zeros_like(before)
        std = self.statistics.std.to(before)[columns]
        change[:, columns] = rearrange(new - old, "frames joints axes -> frames (joints axes)") / std
        return change


def _turns(constraint: Constraint, pose: Pose) -> Float[Tensor, "_ 1"] | None:
    """Compute changes of the heading from frame to frame."""
    turn = constraint.root_turn(pose)
    return None if turn is None else turn.diff()[:, None]


def _steps(constraint: Constraint, pose: Pose) -> Float[Tensor, "_ 2"] | None:
    """Compute changes of the pelvis' steps, in the frame of the body."""
    shift = constraint.root_shift(pose)
    return None if shift is None else (shift.diff(dim=0)[:, None] @ rotation_z(pose.heading[:-1])[:, :2, :2])[:, 0]


def _local_joints(pose: Pose) -> Float[Tensor, "frames 23 3"]:
    """Return joints relative to the pelvis, turned to heading zero."""
    return (pose.joints[:, 1:] - pose.joints[:, :1]) @ rotation_z(-heading(pose.rotations[:, 0])).mT


def _smoothing(frames: int, sigma: float, like: Tensor) -> Float[Tensor, "frames frames"]:
    """Make a Gaussian kernel over time that preserves the variance of white noise."""
    frame = torch.arange(frames, device=like.device, dtype=like.dtype)
    kernel = torch.exp(-0.5 * ((frame - frame[:, None]) / sigma) ** 2)
    return kernel / kernel.norm(dim=1, keepdim=True)
