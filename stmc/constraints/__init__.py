"""Constraints beside text: paths, headings, keyframes, hands and feet, met while a motion is sampled."""

from stmc.constraints.guidance import Guidance
from stmc.constraints.limbs import Hold, Target
from stmc.constraints.pose import Constraint, Pose
from stmc.constraints.projection import project
from stmc.constraints.reading import constraint_of, read_constraints
from stmc.constraints.root import Heading, Path
from stmc.constraints.whole_body import Keyframe

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
