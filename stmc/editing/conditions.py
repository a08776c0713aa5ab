"""What a run is asked for beside its texts: a motion that is kept in part, constraints, and how results meet them.

Turns both into what a `composing.Run` takes, and sampled features into motions in which kept parts are the given
motion's own and constraints hold. Knows features and motions; knows no networks, and not how timelines are sampled.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain

import torch
from jaxtyping import Float
from torch import Tensor

from stmc.composing import Known, Run
from stmc.diffusion.statistics import Statistics
from stmc.editing import Kept, changed_prompt, on_body
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

_OF_STEPS = ("root_velocity", "yaw_velocity")
"""Fields that say how a frame leads to the next: unknown where a motion ends."""


_BORDER = 0.9
"""The weight of a feature that stands where a motion is kept, but is not known."""

_AGAIN = 4
"""Times that finished features are brought nearer to the constraints with the whole body, before limbs are bent."""


@dataclass(frozen=True, eq=False)
class Conditions:
    """For timelines of so many `frames` each: what is `kept` for each of them, or for none, and `constraints` on all.

    Raises `SettingError` for constraints on features without forward kinematics.
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
            raise SettingError(
                f"constraints: {name} has no forward kinematics; a model of SmplRepresentation is needed"
            )

    def known(self, canvas: int, device: torch.device) -> Known | None:
        """What is kept, as normalised features of `canvas` frames each; None where nothing is."""
        if not self.kept:
            return None
        content = torch.zeros(len(self.frames), canvas, self.representation.width)
        weights = torch.zeros_like(content)
        for i, (raw, share) in enumerate(zip(self._raw, self._shares, strict=True)):
            content[i, : len(raw)] = self.statistics.normalise(raw).float()
            content[i, len(raw) :] = torch.nan
            if len(raw) < len(share):
                content[i, len(raw) - 1] = content[i, len(raw) - 1].where(share[len(raw) - 1] == 1, torch.nan)
            weights[i, : len(share)] = share
        return Known(content.to(device), weights.to(device))

    def meet(self) -> Callable[[Tensor], Tensor] | None:
        """What brings clean features [batch, frames, features] nearer to the constraints; None where there are none."""
        if not self.constraints:
            return None
        guides = [
            Guidance(self.constraints, self.representation, self.statistics, self.skeleton, self.fps, place, 1 - share)
            for place, share in zip(self._places, self._shares, strict=True)
        ]

        def met(x0: Float[Tensor, "batch frames features"]) -> Float[Tensor, "batch frames features"]:
            x0 = x0.clone()
            for row, guide, frames in zip(x0, guides, self.frames, strict=True):
                row[:frames] = guide(row[:frames])
            return x0

        return met

    def sampled(self, sample: Callable[[Run], Tensor], run: Run, joints_from: JointsFrom = "skeleton") -> list[Motion]:
        """The motions that a method makes of a run under these conditions: kept parts exact, constraints met.

        Raises `SettingError` for constraints on a method that composes finished crops, and on joints "from features".
        """
        if self.constraints and joints_from != "skeleton":
            raise SettingError(f"constraints: joints are posed, so joints_from={joints_from!r} does not fit")
        canvas = max(self.frames) + (run.fixed_length or 0)
        meet = self.meet()
        features = sample(replace(run, known=self.known(canvas, run.device), meet=meet))
        for _ in range(_AGAIN if meet else 0):
            features = meet(features)
        restored = self.statistics.restore(features.cpu().double())
        skeleton = Skeleton(self.skeleton.offsets.double()) if joints_from == "skeleton" else None
        return [self._motion(i, restored[i, :frames], skeleton) for i, frames in enumerate(self.frames)]

    def _motion(self, i: int, features: Float[Tensor, "frames features"], skeleton: Skeleton | None) -> Motion:
        share = self._shares[i]
        if self.kept:
            raw = self._raw[i]
            features = features.clone()
            features[: len(raw)] = torch.where(share[: len(raw)] == 1, raw, features[: len(raw)])
        x, y, z, angle = self._places[i]
        motion = self.representation.decode(features, self.fps, skeleton, angle)
        by = motion.translation.new_tensor([x, y, z])
        by[:2] -= motion.translation[0, :2]
        moved = Motion(motion.rotations, motion.translation + by, motion.joints + by, self.fps)
        if self.constraints:
            moved = project(moved, self.constraints, skeleton, self._free_parts(i))
        return moved.to(dtype=torch.float32)

    def _free_parts(self, i: int) -> Float[Tensor, "frames 5"]:
        return 1 - self.kept[i].weights.double() if self.kept else torch.ones(self.frames[i], len(BodyPart)).double()

    @cached_property
    def _raw(self) -> list[Float[Tensor, "frames features"]]:
        """Of each kept motion, no longer than its timeline."""
        encoded = (self.representation.encode(kept.motion) for kept in self.kept)
        return [raw[:frames] for raw, frames in zip(encoded, self.frames, strict=True)]

    @cached_property
    def _shares(self) -> list[Float[Tensor, "frames features"]]:
        """How much of each feature is kept."""
        if not self.kept:
            return [torch.zeros(frames, self.representation.width) for frames in self.frames]
        return [self._share(kept, raw) for kept, raw in zip(self.kept, self._raw, strict=True)]

    def _share(self, kept: Kept, raw: Tensor) -> Float[Tensor, "frames features"]:
        share = torch.zeros(len(kept.weights), self.representation.width)
        for column, part in enumerate(BodyPart):
            share[:, list(self.representation.columns[part])] = kept.weights[:, column, None]
        share[len(raw) :] = share[len(raw) :].clamp(max=_BORDER)  # formats that need a next frame have no last one
        if len(raw) < len(share):
            for name in set(_OF_STEPS) & set(self.representation.layout.slices):
                share[len(raw) - 1, self.representation.layout[name]] = _BORDER
        return share

    @cached_property
    def _places(self) -> list[Place]:
        """Where each motion begins; the first constraint of a kind decides, and headings after paths."""
        if self.kept:
            return [self._place(kept.motion) for kept in self.kept]
        place = (0.0, 0.0, 0.0, 0.0)
        for constraint in sorted(reversed(self.constraints), key=lambda each: each.order):
            place = constraint.begin_place(place)
        return [place] * len(self.frames)

    def _place(self, motion: Motion) -> Place:
        angle = float(motion.heading[0])
        again = self.representation.decode(self.representation.encode(motion), self.fps, None, angle)
        x, y, z = (motion.translation[0] - again.translation[0]).tolist()
        x, y = motion.translation[0, :2].tolist()
        return x, y, z, angle


def cleaned(motions: Sequence[Motion], kept: Sequence[Kept], constraints: Sequence[Constraint]) -> list[Motion]:
    """The motions with feet that stand (see `clean_feet`), but for where legs are `kept` and where `constraints` say
    how they are: there they stay, and what stands there goes on standing. Other limbs are projected again."""
    free = [1 - each.weights.double() for each in kept]
    free = free or [torch.ones(motion.frames, len(BodyPart)).double() for motion in motions]
    return [_cleaned(motion, each, constraints) for motion, each in zip(motions, free, strict=True)]


def _cleaned(motion: Motion, free: Float[Tensor, "frames 5"], constraints: Sequence[Constraint]) -> Motion:
    pose, limbs = Pose.of(motion), []
    legs = free[:, list(BodyPart).index(BodyPart.LEGS)] > 0
    for constraint in [each.anchored_at(pose) for each in constraints]:
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


def kept_of(request: GenerateRequest, frames: Sequence[int], skeleton: Skeleton, fps: float | int) -> list[Kept]:
    """What a request keeps for each timeline, whose result has so many `frames`: all but the changes of its motion;
    nothing where it keeps none.

    Raises `SettingError` where nothing is left to make.
    """
    bodies = {id(motion): on_body(motion, skeleton, fps) for motion in request.keep}
    kept = []
    for motion, timeline, count in zip(request.keep, request.timelines, frames, strict=bool(request.keep)):
        own = [changed_prompt(timeline, each) if isinstance(each, Prompt) else (each,) for each in request.change]
        kept.append(Kept.but(list(chain.from_iterable(own)), bodies[id(motion)], count))
        if bool((kept[-1].weights == 1).all()):
            raise SettingError("keep: nothing to make anew; say what to change, or go on behind the motion's end")
    return kept
