"""Constraints beside text: paths, headings, keyframes, hands and feet, met while a motion is sampled."""

from stmc.editing.constraints.constraint_guidance import Guidance
from stmc.editing.constraints.limbs import Hold, Target
from stmc.editing.constraints.pose import Constraint, Pose
from stmc.editing.constraints.projection import project
from stmc.editing.constraints.reading import constraint_of, read_constraints
from stmc.editing.constraints.root import Heading, Path
from stmc.editing.constraints.whole_body import Keyframe

__all__ = [
    "Constraint",
    "Guidance",
    "Heading",
    "Hold",
    "Keyframe",
    "Path",
    "Pose",
    "Target",
    "constraint_of",
    "project",
    "read_constraints",
]
