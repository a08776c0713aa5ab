"""Guidance by forward kinematics: predicted clean features moved, as little as possible, to where constraints hold.

At every step of sampling the predicted features change by the least that brings the body near to what is demanded:
least in units of the features' standard deviations, and smooth in time. So reaching takes an arm, a lean and a step as
the data have them, and the network sees what was decided at the next step and does the rest. In the words of the
literature: a maximum a posteriori estimate of x0 with the network's prediction as the mean of the prior, as in
reconstruction guidance (Ho et al. 2022), through the kinematics as in OmniControl (Xie et al. 2024), but on x0 itself:
nothing is differentiated through the network. Knows constraints and features; knows no networks and no samplers.
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
"""Metres off that count as much as one standard deviation of one feature in one frame."""

ROOT = 0.3
"""How readily the root's velocities are changed, beside rotations: a change of them moves all that follows."""

_SMOOTH = 0.15
"""Seconds: the standard deviation of the Gaussian over which a change spreads."""

_ITERATIONS = 6
"""Of L-BFGS, at each step."""

_ROUNDS = 3
"""In which roots are led to a path: what is smoothed is left to the next."""


@dataclass(frozen=True, eq=False)
class Guidance:
    """Bring clean features of one motion, [frames, features] normalised, nearer to `constraints`.

    Features begin above the origin: `place` is where the motion begins. `free` says which features may change: 1 as
    they like, 0 not at all."""

    constraints: Sequence[Constraint]
    representation: SmplRepresentation
    statistics: Statistics
    skeleton: Skeleton
    fps: float | int
    place: Place
    free: Float[Tensor, "frames features"]

    def __call__(self, x0: Float[Tensor, "frames features"]) -> Float[Tensor, "frames features"]:
        """The features changed; those of positions follow from the rotations."""
        with torch.inference_mode(False), torch.enable_grad():
            x0 = x0.clone()
            with torch.no_grad():
                x0 = self._led(x0)
            readiness = (self.free.to(x0) * self._readiness(x0)).contiguous()
            change = self._least_change(x0, readiness)
            with torch.no_grad():
                moved = x0 + change
                return moved + self._positions(x0, moved) * self.free.to(x0)

    def pose(self, x0: Float[Tensor, "frames features"]) -> Pose:
        """How the features move the body, with gradients."""
        raw = self.statistics.restore(x0)
        *by, angle = self.place
        rotations, translation, _ = self.representation.integrate(raw, angle)
        translation = translation + translation.new_tensor(by)
        return Pose(rotations, translation, self.skeleton.pose(rotations, translation), self.fps)

    def _led(self, x0: Tensor) -> Tensor:
        """The features with the root turned and moved to where paths and headings want it, in closed form: where it is
        is a sum of steps, and a few iterations of a descent do not change many of those and all else together."""
        layout, std = self.representation.layout, self.statistics.std.to(x0)
        pose = self.pose(x0)
        for name, steps_of in (("yaw_velocity", _turns), ("root_velocity", _steps)):
            columns = layout[name]
            for constraint in [*self.constraints] * _ROUNDS:
                steps = steps_of(constraint, pose)
                if steps is None:
                    continue
                change = torch.zeros_like(x0)
                change[:-1, columns] = steps / std[columns]
                x0 = x0 + change * self.free.to(x0)
                pose = self.pose(x0)
        return x0

    def _least_change(self, x0: Tensor, readiness: Tensor) -> Tensor:
        smooth = _smoothing(len(x0), _SMOOTH * self.fps, x0)
        parameters = torch.zeros_like(x0, requires_grad=True)
        optimizer = torch.optim.LBFGS([parameters], max_iter=_ITERATIONS, line_search_fn="strong_wolfe")

        def cost() -> Tensor:
            optimizer.zero_grad()
            pose = self.pose(x0 + (smooth @ parameters) * readiness)
            off = sum(each.residuals(pose).square().sum() for each in self.constraints) / TOLERANCE**2
            total = parameters.square().sum() + off
            total.backward()
            return total

        optimizer.step(cost)
        return ((smooth @ parameters) * readiness).detach()

    def _readiness(self, x0: Tensor) -> Tensor:
        """1 for what moves the body; positions only say where joints are, and follow."""
        layout, ready = self.representation.layout, torch.zeros_like(x0)
        for name, much in (("root_height", 1.0), ("root_velocity", ROOT), ("yaw_velocity", ROOT), ("rotations", 1.0)):
            ready[:, layout[name]] = much
        return ready

    def _positions(self, before: Tensor, after: Tensor) -> Tensor:
        """What the features of positions change by when rotations do."""
        where = self.representation.layout["positions"]
        old, new = (_seen(self.pose(each)) for each in (before, after))
        change = torch.zeros_like(before)
        std = self.statistics.std.to(before)[where]
        change[:, where] = rearrange(new - old, "frames joints axes -> frames (joints axes)") / std
        return change


def _turns(constraint: Constraint, pose: Pose) -> Float[Tensor, "_ 1"] | None:
    """Changes of the heading from frame to frame."""
    turn = constraint.root_turn(pose)
    return None if turn is None else turn.diff()[:, None]


def _steps(constraint: Constraint, pose: Pose) -> Float[Tensor, "_ 2"] | None:
    """Changes of the pelvis' steps, as the body sees them."""
    shift = constraint.root_shift(pose)
    return None if shift is None else (shift.diff(dim=0)[:, None] @ rotation_z(pose.heading[:-1])[:, :2, :2])[:, 0]


def _seen(pose: Pose) -> Float[Tensor, "frames 23 3"]:
    """Joints from the pelvis, turned to heading zero."""
    return (pose.joints[:, 1:] - pose.joints[:, :1]) @ rotation_z(-heading(pose.rotations[:, 0])).mT


def _smoothing(frames: int, sigma: float, like: Tensor) -> Float[Tensor, "frames frames"]:
    """A Gaussian over time under which white noise keeps its variance."""
    frame = torch.arange(frames, device=like.device, dtype=like.dtype)
    kernel = torch.exp(-0.5 * ((frame - frame[:, None]) / sigma) ** 2)
    return kernel / kernel.norm(dim=1, keepdim=True)
