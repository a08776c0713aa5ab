"""Conditioning other than text: partially fixed motion (inpainting) and constraints.

Converts both to arguments of a `composing.Run`, and sampled features to motions in which kept parts are exact and
constraints hold. Depends on features and motions; independent of networks and of the sampling method.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain

import torch
from jaxtyping import Float
from torch import Tensor

from stmc.composing import Observed, Run
from stmc.diffusion.statistics import Statistics
from stmc.editing import Kept, changed_prompt, move_to_body
from stmc.editing.constraints import Constraint, Guidance, Order, Pose, project
from stmc.editing.constraints.pose import Place
from stmc.editing.generate_request import GenerateRequest
from stmc.motion.body import BodyPart
from stmc.motion.body_model import Skeleton
from stmc.motion.feet import clean_feet
from stmc.motion.motion import Motion
from stmc.motion.representation import JointsFrom, Representation, SmplRepresentation
from stmc.settings.records import SettingError
from stmc.timeline import Prompt

_STEP_FEATURES = ("root_velocity", "yaw_velocity")
"""Features of the step from a frame to the next: not observed in a motion's last frame."""
_BORDER = 0.9
"""Weight of a feature at a kept frame whose value is not observed."""
_REFINEMENT_PASSES = 4
"""Whole-body refinement passes after sampling, before limb IK."""


@dataclass(frozen=True, eq=False)
class Conditions:
    """The conditions of a batch of timelines with these numbers of `frames`.

    `kept` holds one entry per timeline, or none; `constraints` apply to all timelines. Raises `SettingError` for
    constraints on features without forward kinematics.
    """

    representation: Representation
    statistics: Statistics
    skeleton: Skeleton
    fps: float | int
    frames: Sequence[int]
    kept: Sequence[Kept] = ()
    constraints: Sequence[Constraint] = ()

    def __post_init__(self) -> None:
        if self.constraints and not isinstance(self.representation, SmplRepresentation):
            name = type(self.representation).__name__
            raise SettingError(f"constraints: {name} has no forward kinematics; use a model with SmplRepresentation")

    def observed(self, canvas: int, device: torch.device) -> Observed | None:
        """Return the kept motions as normalised features, padded to `canvas` frames; None if nothing is kept."""
        if not self.kept:
            return None
        x0 = torch.zeros(len(self.frames), canvas, self.representation.width)
        weights = torch.zeros_like(x0)
        for i, (raw, weight) in enumerate(zip(self._raw, self._weights, strict=True)):
            x0[i, : len(raw)] = self.statistics.normalise(raw).float()
            x0[i, len(raw) :] = torch.nan
            if len(raw) < len(weight):
                x0[i, len(raw) - 1] = x0[i, len(raw) - 1].where(weight[len(raw) - 1] == 1, torch.nan)
            weights[i, : len(weight)] = weight
        return Observed(x0.to(device), weights.to(device))

    def constraint_guidance(self) -> Callable[[Tensor], Tensor] | None:
        """Return a function that moves clean features [batch, frames, features] towards the constraints, or None."""
        if not self.constraints:
            return None
        assert isinstance(self.representation, SmplRepresentation)
        parts = (self.constraints, self.representation, self.statistics, self.skeleton, self.fps)
        guides = [
            Guidance(*parts, place, 1 - weight) for place, weight in zip(self._starts, self._weights, strict=True)
        ]

        def apply_constraints(x0: Float[Tensor, "batch frames features"]) -> Float[Tensor, "batch frames features"]:
            x0 = x0.clone()
            for row, guide, frames in zip(x0, guides, self.frames, strict=True):
                row[:frames] = guide(row[:frames])
            return x0

        return apply_constraints

    def sample(self, sample: Callable[[Run], Tensor], run: Run, joints_from: JointsFrom = "skeleton") -> list[Motion]:
        """Sample motions under these conditions: kept parts are exact, and constraints hold.

        Args:
            sample: Sampling function of a method.
            run: The run, without conditions.
            joints_from: Source of the joints; must be "skeleton" if there are constraints.

        Raises:
            SettingError: For constraints with a method that composes finished crops, or with joints from "features".
        """
        if self.constraints and joints_from != "skeleton":
            raise SettingError(f"constraints pose the joints, so joints_from={joints_from!r} must be 'skeleton'")
        canvas = max(self.frames) + (run.fixed_length or 0)
        guidance = self.constraint_guidance()
        features = sample(replace(run, observed=self.observed(canvas, run.device), constrain=guidance))
        if guidance is not None:
            for _ in range(_REFINEMENT_PASSES):
                features = guidance(features)
        restored = self.statistics.restore(features.cpu().double())
        skeleton = Skeleton(self.skeleton.offsets.double()) if joints_from == "skeleton" else None
        return [self._motion(i, restored[i, :frames], skeleton) for i, frames in enumerate(self.frames)]

    def _motion(self, i: int, features: Float[Tensor, "frames features"], skeleton: Skeleton | None) -> Motion:
        weight = self._weights[i]
        if self.kept:
            raw = self._raw[i]
            features = features.clone()
            features[: len(raw)] = torch.where(weight[: len(raw)] == 1, raw, features[: len(raw)])
        x, y, z, angle = self._starts[i]
        motion = self.representation.decode(features, self.fps, skeleton, angle)
        by = motion.translation.new_tensor([x, y, z])
        by[:2] -= motion.translation[0, :2]
        moved = Motion(motion.rotations, motion.translation + by, motion.joints + by, self.fps)
        if self.constraints and skeleton is not None:
            moved = project(moved, self.constraints, skeleton, self._free_parts(i))
        return moved.to(dtype=torch.float32)

    def _free_parts(self, i: int) -> Float[Tensor, "frames 5"]:
        return 1 - self.kept[i].weights.double() if self.kept else torch.ones(self.frames[i], len(BodyPart)).double()

    @cached_property
    def _raw(self) -> list[Float[Tensor, "frames features"]]:
        """Raw features of each kept motion, cut to the length of its timeline."""
        encoded = (self.representation.encode(kept.motion) for kept in self.kept)
        return [raw[:frames] for raw, frames in zip(encoded, self.frames, strict=True)]

    @cached_property
    def _weights(self) -> list[Float[Tensor, "frames features"]]:
        """Weights with which the features of each motion are kept."""
        if not self.kept:
            return [torch.zeros(frames, self.representation.width) for frames in self.frames]
        return [self._feature_weights(kept, raw) for kept, raw in zip(self.kept, self._raw, strict=True)]

    def _feature_weights(self, kept: Kept, raw: Tensor) -> Float[Tensor, "frames features"]:
        weights = torch.zeros(len(kept.weights), self.representation.width)
        for column, part in enumerate(BodyPart):
            weights[:, list(self.representation.columns[part])] = kept.weights[:, column, None]
        weights[len(raw) :] = weights[len(raw) :].clamp(max=_BORDER)  # formats that need a next frame lack the last one
        if len(raw) < len(weights):
            for name in set(_STEP_FEATURES) & set(self.representation.layout.slices):
                weights[len(raw) - 1, self.representation.layout[name]] = _BORDER
        return weights

    @cached_property
    def _starts(self) -> list[Place]:
        """The place where each motion begins. The first constraint of a kind wins, and headings override paths."""
        if self.kept:
            return [self._start(kept.motion) for kept in self.kept]
        place = (0.0, 0.0, 0.0, 0.0)
        for constraint in sorted(reversed(self.constraints), key=lambda constraint: constraint.order):
            place = constraint.begin_place(place)
        return [place] * len(self.frames)

    def _start(self, motion: Motion) -> Place:
        angle = float(motion.heading[0])
        decoded = self.representation.decode(self.representation.encode(motion), self.fps, None, angle)
        x, y, z = (motion.translation[0] - decoded.translation[0]).tolist()
        x, y = motion.translation[0, :2].tolist()
        return x, y, z, angle


def clean_motions(motions: Sequence[Motion], kept: Sequence[Kept], constraints: Sequence[Constraint]) -> list[Motion]:
    """Clean the feet of motions (see `clean_feet`), then project constraints of other limbs again.

    Legs stay unchanged where they are kept and where constraints determine them; feet that stand there keep standing.

    Args:
        motions: Sampled motions.
        kept: Kept parts of each motion, or none.
        constraints: Constraints on all motions.
    """
    free = [1 - item.weights.double() for item in kept]
    free = free or [torch.ones(motion.frames, len(BodyPart)).double() for motion in motions]
    return [_clean(motion, weights, constraints) for motion, weights in zip(motions, free, strict=True)]


def _clean(motion: Motion, free: Float[Tensor, "frames 5"], constraints: Sequence[Constraint]) -> Motion:
    pose, limbs = Pose.of(motion), []
    legs = free[:, list(BodyPart).index(BodyPart.LEGS)] > 0
    for constraint in [constraint.anchored_at(pose) for constraint in constraints]:
        frames = constraint.leg_frames(pose)
        if frames is not None:
            legs[frames] = False
        elif constraint.order == Order.LIMB:
            limbs.append(constraint)
    clean = clean_feet(motion, free=legs)
    if not limbs or torch.equal(clean.translation, motion.translation):
        return clean
    exact = clean.to(dtype=torch.float64)
    skeleton = Skeleton.measured(exact.rotations, exact.joints)
    return project(exact, limbs, skeleton, free).to(dtype=clean.joints.dtype)


def prepare_kept(request: GenerateRequest, frames: Sequence[int], skeleton: Skeleton, fps: float | int) -> list[Kept]:
    """Return the kept parts of a request's motions, one per timeline; an empty list if the request keeps no motion.

    Args:
        request: The request.
        frames: Number of frames of each result.
        skeleton: Body of the results.
        fps: Frame rate of the results.

    Raises:
        SettingError: If every frame of a motion is kept, so that there is nothing to generate.
    """
    bodies = {id(motion): move_to_body(motion, skeleton, fps) for motion in request.keep}
    kept = []
    for motion, timeline, count in zip(request.keep, request.timelines, frames, strict=bool(request.keep)):
        changes = [changed_prompt(timeline, item) if isinstance(item, Prompt) else (item,) for item in request.change]
        kept.append(Kept.all_but(list(chain.from_iterable(changes)), bodies[id(motion)], count))
        if bool((kept[-1].weights == 1).all()):
            advice = "pass `change`, or make the timeline longer than the motion"
            raise SettingError(f"keep: every frame is kept, so there is nothing to generate; {advice}")
    return kept
