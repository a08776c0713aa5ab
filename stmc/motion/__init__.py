"""A moving person: body, rotations, kinematics, features, feet and skins. Independent of texts and networks."""

from lazy_loader import attach

__getattr__, __dir__, __all__ = attach(
    __name__,
    submodules=[
        "body",
        "body_model",
        "feet",
        "geometry",
        "inverse_kinematics",
        "kinematics",
        "loops",
        "motion",
        "representation",
        "retargeting",
        "skins",
    ],
)
