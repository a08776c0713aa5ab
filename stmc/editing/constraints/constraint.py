"""The base class of constraints: the interface for sampling, projection, JSON and the studio's page."""

from __future__ import annotations

import dataclasses
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, ClassVar, Literal, cast

from jaxtyping import Float
from torch import Tensor

from stmc.editing.constraints.pose import Place, Pose
from stmc.io.bounds import MOST_METRES, MOST_SECONDS
from stmc.motion.body_model import Skeleton
from stmc.motion.motion import Motion

Control = Literal["start", "end", "moment", "joint", "point", "angle", "number", "line", "motion", "motion_second"]
"""Value editors of the studio's page, from which it draws forms and marks of any constraint."""

_BOUNDS: dict[Control, tuple[float, float]] = {
    **dict.fromkeys(("start", "end", "moment", "motion_second"), (0, MOST_SECONDS)),
    **dict.fromkeys(("point", "line", "number"), (-MOST_METRES, MOST_METRES)),
}

_DISPLAYED = {"m": ("cm", 100.0), "rad": ("degrees", 180 / math.pi)}
"""Display unit of an error, and its factor."""


class Order(IntEnum):
    """The order of projection: each kind moves a body that earlier kinds have moved already."""

    POSE = 0
    PATH = 1
    HEADING = 2
    LIMB = 3


@dataclass(frozen=True)
class Field:
    """A value of a constraint's JSON that the studio's page edits.

    `default` is the value of a new constraint; for an "end", it is in seconds after the start.
    """

    name: str
    control: Control
    title: str
    default: Any = None
    choices: tuple[str, ...] = ()

    def describe(self) -> dict[str, Any]:
        """Return the field as JSON, with the least and the greatest value (None: no limit)."""
        least, most = _BOUNDS.get(self.control, (None, None))
        return {**dataclasses.asdict(self), "least": least, "most": most}


class Constraint(ABC):
    """A condition other than text, in the world's metres, radians and seconds.

    A kind is a frozen dataclass that inherits from this class. It must define `errors` and `residuals`; all other
    methods have defaults that constrain nothing. To be read from JSON and offered by the studio, it must also define
    `name`, `about` and `fields`.

    Examples:
        >>> reach, stay = stmc.Target("right_hand", (-0.2, -0.4, 1.2), start=0.5), stmc.Hold("left_hand")
        >>> [motion] = stmc.load().generate("walk # 0 # 1", steps=1, constraints=[reach, stay])
        >>> pose = stmc.editing.constraints.Pose.of(motion)
        >>> bool(reach.errors(pose).max() < 0.02), len(stay.errors(pose)), len(reach.residuals(pose))
        (True, 20, 3)
        >>> type(stay.anchored_at(pose)).__name__
        'Target'
        >>> reach.measure(motion)["error"] < 2
        True
    """

    name: ClassVar[str] = ""
    """The key in JSON, such as "path"."""

    about: ClassVar[str] = ""
    """Help text, in one sentence."""

    unit: ClassVar[Literal["m", "rad"]] = "m"
    """Unit of `errors` and `tolerance`."""

    tolerance: ClassVar[float] = 0.02
    """The largest error of a motion that meets the constraint."""

    order: ClassVar[Order] = Order.LIMB

    open_end: ClassVar[Literal["start", "end"]] = "end"
    """End of a span without an `end`: one frame after its start, or the motion's end."""

    fields: ClassVar[tuple[Field, ...]] = ()

    @abstractmethod
    def errors(self, pose: Pose) -> Float[Tensor, " _"]:
        """Compute the error in `unit` at each of `frames`; not negative."""

    @abstractmethod
    def residuals(self, pose: Pose) -> Float[Tensor, " _"]:
        """Compute values whose sum of squares guidance minimises: differentiable, in metres or on the same scale."""

    def frames(self, pose: Pose) -> slice:
        """Return the constrained frames; by default all."""
        return slice(0, len(pose.translation))

    def anchored_at(self, pose: Pose) -> Constraint:
        """Return the constraint with its open values taken from `pose`, such as the position of a held hand."""
        return self

    def begin_place(self, place: Place) -> Place:
        """Return the place where a motion begins, given the place without this constraint."""
        return place

    def root_turn(self, pose: Pose) -> Float[Tensor, " frames"] | None:
        """Compute the angle by which to turn the body, in radians, smooth over time; None if the heading is free."""
        return None

    def root_shift(self, pose: Pose) -> Float[Tensor, "frames 2"] | None:
        """Compute the shift of the pelvis over the floor, in metres, smooth over time; None if its path is free."""
        return None

    def project(self, motion: Motion, skeleton: Skeleton, free: Float[Tensor, "frames 5"]) -> Motion:
        """Edit a finished motion smoothly until the anchored constraint holds exactly.

        Args:
            motion: Finished motion.
            skeleton: Body of the motion.
            free: As in the function `project`.
        """
        return motion

    def leg_frames(self, pose: Pose) -> slice | None:
        """Return the frames in which the anchored constraint determines the legs, so that feet are not cleaned there.

        None if it does not affect the legs: a limb constraint is then projected again after the feet are cleaned.
        """
        return None

    def measure(self, motion: Motion) -> dict[str, Any]:
        """Measure the largest error of a motion: the constraint's name, the error, and its unit (cm or degrees)."""
        errors, (unit, scale) = self.errors(Pose.of(motion)), _DISPLAYED[self.unit]
        return {"name": self.name, "error": float(errors.max()) * scale if len(errors) else 0.0, "unit": unit}

    @classmethod
    def from_json(cls, find: Callable[[str], Motion], /, *items: Any, **values: Any) -> Constraint:
        """Make a constraint from the values of its JSON object; `find` returns a motion by its name."""
        return cls(*items, **values)

    def to_json(self, save: Callable[[Motion], str]) -> dict[str, dict[str, Any]]:
        """Return the JSON object for `constraint_of`, without defaults; `save` stores a motion and returns its name."""
        fields = dataclasses.fields(cast(Any, self))  # each kind is a dataclass
        values = {field.name: getattr(self, field.name) for field in fields}
        return {self.name: {field.name: values[field.name] for field in fields if values[field.name] != field.default}}

    @classmethod
    def describe(cls) -> dict[str, Any]:
        """Describe the kind for the studio's page: name, help, tolerance (cm or degrees) and fields."""
        return {
            "name": cls.name,
            "title": cls.name.replace("_", " ").capitalize(),
            "about": cls.about,
            "tolerance": cls.tolerance * _DISPLAYED[cls.unit][1],
            "open_end": cls.open_end,
            "fields": [field.describe() for field in cls.fields],
        }


def span_fields(seconds: float) -> tuple[Field, Field]:
    """Return the fields `start` and `end` of a kind; a new constraint lasts `seconds`."""
    return Field("start", "start", "Start (s)"), Field("end", "end", "End (s)", seconds)


def project(
    motion: Motion, constraints: Sequence[Constraint], skeleton: Skeleton, free: Float[Tensor, "frames 5"]
) -> Motion:
    """Edit a motion until every constraint holds as exactly as its kind can; corrections fade in and out over `RAMP`.

    Args:
        motion: Finished motion.
        constraints: Constraints to apply.
        skeleton: Body of the motion.
        free: Weight, from 0 to 1, with which each frame of each `BodyPart` may change; with 0, its rotations stay.
    """
    for constraint in sorted(constraints, key=lambda constraint: constraint.order):
        anchored = constraint.anchored_at(Pose.of(motion))
        motion = anchored.project(motion, skeleton, free.to(motion.translation))
    return motion
