"""Constraints other than text: paths, headings, keyframes, hands and feet, applied while a motion is sampled."""

from stmc.editing.constraints.constraint import Constraint, Field, Order, project, span_fields
from stmc.editing.constraints.constraint_guidance import Guidance
from stmc.editing.constraints.limbs import Hold, Target
from stmc.editing.constraints.pose import Pose
from stmc.editing.constraints.reading import KINDS, constraint_of, read_constraints
from stmc.editing.constraints.root import Heading, Path
from stmc.editing.constraints.whole_body import Keyframe

__all__ = [
    "KINDS",
    "Constraint",
    "Field",
    "Guidance",
    "Heading",
    "Hold",
    "Keyframe",
    "Order",
    "Path",
    "Pose",
    "Target",
    "constraint_of",
    "project",
    "read_constraints",
    "span_fields",
]
