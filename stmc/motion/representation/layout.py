"""Feature vectors as named fields; slices and each body part's columns follow from names, joints and widths.

Defines the position and the owner of each field; independent of formulas (see `smpl`) and tensors.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

from stmc.motion.body import JOINTS, NUM_ROTATIONS, BodyPart


@dataclass(frozen=True)
class Field:
    """A block of features: `width` numbers for each of `joints`, joint after joint, owned by the joints' body parts.

    Quantities of the whole body (root height, velocities) are fields of the pelvis. Raises `ValueError` if the width is
    below one, if there is no joint, or if a joint is repeated or not in `body.JOINTS`.
    """

    name: str
    width: int
    joints: tuple[str, ...] = ("pelvis",)

    def __post_init__(self) -> None:
        if self.width < 1 or not self.joints:
            raise ValueError(f"field {self.name!r} is empty: width {self.width}, {len(self.joints)} joints")
        if unknown := [joint for joint in self.joints if joint not in JOINTS]:
            raise ValueError(f"field {self.name!r} has unknown joints {unknown}; choose from {', '.join(JOINTS)}")
        if len(set(self.joints)) < len(self.joints):
            raise ValueError(f"field {self.name!r} names a joint twice: {', '.join(self.joints)}")

    @property
    def size(self) -> int:
        """Number of features per frame."""
        return self.width * len(self.joints)


@dataclass(frozen=True)
class Layout:
    """Consecutive fields. Raises `ValueError` if two have the same name."""

    fields: tuple[Field, ...]

    def __post_init__(self) -> None:
        names = [field.name for field in self.fields]
        if len(set(names)) < len(names):
            raise ValueError(f"two fields of a layout share a name: {', '.join(names)}")

    @cached_property
    def width(self) -> int:
        """Number of features per frame."""
        return sum(field.size for field in self.fields)

    @cached_property
    def slices(self) -> Mapping[str, slice]:
        """Slice of each field in the feature vector."""
        slices, start = {}, 0
        for field in self.fields:
            slices[field.name] = slice(start, start + field.size)
            start += field.size
        return slices

    @cached_property
    def columns(self) -> dict[BodyPart, tuple[int, ...]]:
        """The columns that each body part owns, in ascending order; every column has exactly one owner."""
        part_of = {joint: part for part in BodyPart for joint in part.joints}
        owners = [part_of[joint] for field in self.fields for joint in field.joints for _ in range(field.width)]
        return {part: tuple(column for column, owner in enumerate(owners) if owner is part) for part in BodyPart}

    def filled(self, values: Mapping[str, float], otherwise: float) -> tuple[float, ...]:
        """Return one number per feature: the value of its field, or `otherwise`.

        Raises `ValueError` if a field does not exist.
        """
        if unknown := set(values) - set(self.slices):
            raise ValueError(f"unknown fields {sorted(unknown)}; choose from {', '.join(self.slices)}")
        return tuple(float(values.get(field.name, otherwise)) for field in self.fields for _ in range(field.size))

    def __getitem__(self, name: str) -> slice:
        """Return the slice of the field `name`. Raises `KeyError` with the existing names."""
        if name not in self.slices:
            raise KeyError(f"no field {name!r}; choose from {', '.join(self.slices)}")
        return self.slices[name]


SMPL_LAYOUT = Layout(
    (
        Field("root_height", 1),
        Field("root_velocity", 2),
        Field("yaw_velocity", 1),
        Field("rotations", 6, JOINTS[:NUM_ROTATIONS]),
        Field("positions", 3, JOINTS[1:]),
    )
)
"""The 205 features of MDM-SMPL (STMC, appendix D); see `SmplRepresentation`."""

HUMANML3D_LAYOUT = Layout(
    (
        Field("yaw_velocity", 1),
        Field("root_velocity", 2),
        Field("root_height", 1),
        Field("positions", 3, JOINTS[1:22]),
        Field("rotations", 6, JOINTS[1:22]),
        Field("velocities", 3, JOINTS[:22]),
        Field("contacts", 1, ("left_ankle", "left_foot", "right_ankle", "right_foot")),
    )
)
"""The 263 features of HumanML3D (Guo et al. 2022); see `HumanML3DRepresentation`."""

BABEL_LAYOUT = Layout(
    (Field("root_height", 1), Field("root_velocity", 2), Field("rotations", 6, JOINTS[:NUM_ROTATIONS]))
)
"""The 135 features of models trained on BABEL; see `BabelRepresentation`."""
