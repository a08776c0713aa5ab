"""The base class of constraints: the questions that sampling, projection, JSON and the studio's page ask of each kind.

Knows no particular kind, no features and no network.
"""

from __future__ import annotations

import dataclasses
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, ClassVar, Literal

from jaxtyping import Float
from torch import Tensor

from stmc.editing.constraints.pose import Place, Pose
from stmc.io.bounds import MOST_METRES, MOST_SECONDS
from stmc.motion.body_model import Skeleton
from stmc.motion.motion import Motion

Control = Literal["start", "end", "moment", "joint", "point", "angle", "number", "line", "motion", "motion_second"]
"""The editors of values that the studio's page has: it draws forms and marks by them, whatever the constraint."""

_BOUNDS: dict[Control, tuple[float, float]] = {
    **dict.fromkeys(("start", "end", "moment", "motion_second"), (0, MOST_SECONDS)),
    **dict.fromkeys(("point", "line", "number"), (-MOST_METRES, MOST_METRES)),
}

_DISPLAYED = {"m": ("cm", 100.0), "rad": ("degrees", 180 / math.pi)}
"""The unit in which people read an error, and its factor."""


class Order(IntEnum):
    """The order of projection: each kind moves a body that the kinds before it have moved already."""

    POSE = 0
    PATH = 1
    HEADING = 2
    LIMB = 3


@dataclass(frozen=True)
class Field:
    """A value of a constraint's JSON that the studio's page edits.

    `default` is the value of a new constraint; of an "end" it is the seconds behind the start."""

    name: str
    control: Control
    title: str
    default: Any = None
    choices: tuple[str, ...] = ()

    def describe(self) -> dict[str, Any]:
        """The field as JSON, with the least and the most that its value may be (None: anything)."""
        least, most = _BOUNDS.get(self.control, (None, None))
        return {**dataclasses.asdict(self), "least": least, "most": most}


class Constraint(ABC):
    """A demand beside the texts, in the world's metres, radians and seconds.

    A kind is a frozen dataclass below this class. It needs `errors` and `residuals`; all other methods have defaults
    that demand nothing. To be read from JSON and offered by the studio it needs `name`, `about` and `fields`, too.

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
    """A sentence for people who choose a constraint."""

    unit: ClassVar[Literal["m", "rad"]] = "m"
    """Of `errors` and `tolerance`."""

    tolerance: ClassVar[float] = 0.02
    """The largest error of a motion that meets the constraint."""

    order: ClassVar[Order] = Order.LIMB

    open_end: ClassVar[Literal["start", "end"]] = "end"
    """Where a span without an end stops: one frame behind its start, or at the motion's end."""

    fields: ClassVar[tuple[Field, ...]] = ()

    @abstractmethod
    def errors(self, pose: Pose) -> Float[Tensor, " _"]:
        """The distance from the demand in `unit`, at each of `frames`; not negative."""

    @abstractmethod
    def residuals(self, pose: Pose) -> Float[Tensor, " _"]:
        """Values that guidance brings to zero: differentiable, in metres or scaled like them. It minimises the sum of
        their squares."""

    def frames(self, pose: Pose) -> slice:
        """The frames that the constraint is about; by default all."""
        return slice(0, len(pose.translation))

    def anchored_at(self, pose: Pose) -> Constraint:
        """The constraint with all that it leaves to the motion decided by `pose`, such as where a hand is held."""
        return self

    def begin_place(self, place: Place) -> Place:
        """Where a motion begins that would begin at `place` otherwise."""
        return place

    def root_turn(self, pose: Pose) -> Float[Tensor, " frames"] | None:
        """The radians by which to turn the body, smooth over time; None where the heading is left open."""
        return None

    def root_shift(self, pose: Pose) -> Float[Tensor, "frames 2"] | None:
        """The metres by which to move the pelvis over the floor, smooth over time; None where that is left open."""
        return None

    def project(self, motion: Motion, skeleton: Skeleton, free: Float[Tensor, "frames 5"]) -> Motion:
        """Move a finished motion, smoothly, to where the anchored constraint holds exactly; `free` as in `project`."""
        return motion

    def leg_frames(self, pose: Pose) -> slice | None:
        """The frames in which the anchored constraint decides how the legs are, so that feet are not cleaned there.

        None where it leaves legs alone: a limb is then projected again after feet were cleaned."""
        return None

    def measure(self, motion: Motion) -> dict[str, Any]:
        """The largest error of a motion, for people: the constraint's name, the error, and its unit (cm or degrees)."""
        errors, (unit, scale) = self.errors(Pose.of(motion)), _DISPLAYED[self.unit]
        return {"name": self.name, "error": float(errors.max()) * scale if len(errors) else 0.0, "unit": unit}

    @classmethod
    def from_json(cls, find: Callable[[str], Motion], /, **values: Any) -> Constraint:
        """Make the constraint of the values of its JSON object; `find` returns a motion by its name."""
        return cls(**values)

    def to_json(self, save: Callable[[Motion], str]) -> dict[str, dict[str, Any]]:
        """Return the object that `constraint_of` reads, without defaults; `save` keeps a motion and names it."""
        fields = dataclasses.fields(self)
        values = {field.name: getattr(self, field.name) for field in fields}
        return {self.name: {field.name: values[field.name] for field in fields if values[field.name] != field.default}}

    @classmethod
    def describe(cls) -> dict[str, Any]:
        """The kind as the studio's page knows it: its name, its words, its tolerance (cm or degrees) and its fields."""
        return {
            "name": cls.name,
            "title": cls.name.replace("_", " ").capitalize(),
            "about": cls.about,
            "tolerance": cls.tolerance * _DISPLAYED[cls.unit][1],
            "open_end": cls.open_end,
            "fields": [field.describe() for field in cls.fields],
        }


def span_fields(seconds: float) -> tuple[Field, Field]:
    """The fields `start` and `end` of a kind that holds for so many seconds when it is new."""
    return Field("start", "start", "Start (s)"), Field("end", "end", "End (s)", seconds)


def project(
    motion: Motion, constraints: Sequence[Constraint], skeleton: Skeleton, free: Float[Tensor, "frames 5"]
) -> Motion:
    """The motion on `skeleton` with every constraint met as exactly as its kind can: corrections come and go within
    `RAMP`.

    `free`: how much each frame of each `BodyPart` may change, 0 to 1; where it is 0 they keep their rotations.
    """
    for constraint in sorted(constraints, key=lambda each: each.order):
        anchored = constraint.anchored_at(Pose.of(motion))
        motion = anchored.project(motion, skeleton, free.to(motion.translation))
    return motion
