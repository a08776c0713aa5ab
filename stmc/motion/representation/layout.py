"""Feature vectors as named fields: slices and each body part's columns follow from names, joints and widths.

Knows which field stands where and who owns it; knows no formula (see `smpl`) and no tensor.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

from stmc.motion.body import JOINTS, NUM_ROTATIONS, BodyPart


@dataclass(frozen=True)
class Field:
    """`width` numbers for each of `joints`, joint after joint. A body part owns its joints' numbers.

    Quantities of the whole body (root height, velocities) are fields of the pelvis. Raises `ValueError` for a width
    below one, no joint, a joint twice or one that `body.JOINTS` does not have.
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
        """Numbers per frame."""
        return self.width * len(self.joints)


@dataclass(frozen=True)
class Layout:
    """Fields one after the other. Raises `ValueError` where two have the same name."""

    fields: tuple[Field, ...]

    def __post_init__(self) -> None:
        names = [field.name for field in self.fields]
        if len(set(names)) < len(names):
            raise ValueError(f"two fields of a layout share a name: {', '.join(names)}")

    @cached_property
    def width(self) -> int:
        """Numbers per frame."""
        return sum(field.size for field in self.fields)

    @cached_property
    def slices(self) -> Mapping[str, slice]:
        """Where each field stands in the feature vector."""
        slices, start = {}, 0
        for field in self.fields:
            slices[field.name] = slice(start, start + field.size)
            start += field.size
        return slices

    @cached_property
    def columns(self) -> dict[BodyPart, tuple[int, ...]]:
        """The columns that each body part owns, ascending; together all columns, each once."""
        part_of = {joint: part for part in BodyPart for joint in part.joints}
        owners = [part_of[joint] for field in self.fields for joint in field.joints for _ in range(field.width)]
        return {part: tuple(column for column, owner in enumerate(owners) if owner is part) for part in BodyPart}

    def filled(self, values: Mapping[str, float], otherwise: float) -> tuple[float, ...]:
        """A number for every feature: its field's, or `otherwise`. Raises `ValueError` for fields that do not exist."""
        if unknown := set(values) - set(self.slices):
            raise ValueError(f"unknown fields {sorted(unknown)}; choose from {', '.join(self.slices)}")
        return tuple(float(values.get(field.name, otherwise)) for field in self.fields for _ in range(field.size))

    def __getitem__(self, name: str) -> slice:
        """The slice of the field `name`; `KeyError` names the fields there are."""
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
"""The 205 numbers of MDM-SMPL (STMC, appendix D); see `SmplRepresentation`."""

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
"""The 263 numbers of HumanML3D (Guo et al. 2022)."""

BABEL_LAYOUT = Layout(
    (
        Field("root_height", 1),
        Field("root_velocity", 2),
        Field("rotations", 6, JOINTS[:NUM_ROTATIONS]),
    )
)
"""The 135 numbers of models of BABEL; see `BabelRepresentation`."""
