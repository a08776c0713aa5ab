"""Small humanoid robots made by code, as MJCF and as URDF: one body, hinges with limits, arms that hang at rest."""

from dataclasses import dataclass

import numpy as np

AXES = {"roll": "1 0 0", "pitch": "0 1 0", "yaw": "0 0 1"}


@dataclass
class Part:
    """A hinge with the link behind it: where it is from its parent's, its axis, its limits in radians, its shape."""

    name: str
    parent: str
    place: tuple[float, float, float]
    axis: str
    lower: float
    upper: float
    box: tuple[float, ...] = ()
    """The half lengths of a box's sides, and its middle."""


def parts() -> list[Part]:
    """Hips, shoulders and ankles of several hinges, of which some are apart; knees and elbows of one; a waist."""
    made = [
        Part("waist", "pelvis", (0, 0, 0.1), "yaw", -1.0, 1.0),
        Part("chest", "waist", (0, 0, 0), "pitch", -0.4, 0.8),
    ]
    made.append(Part("neck", "chest", (0, 0, 0.45), "yaw", -1.0, 1.0))
    for side, sign in (("left", 1), ("right", -1)):
        made += [
            Part(f"{side}_hip_pitch", "pelvis", (0, sign * 0.06, 0), "pitch", -2.4, 0.6),
            Part(f"{side}_hip_roll", f"{side}_hip_pitch", (0, sign * 0.03, 0), "roll", -0.6, 0.6),
            Part(f"{side}_hip_yaw", f"{side}_hip_roll", (0, 0, -0.1), "yaw", -0.8, 0.8),
            Part(f"{side}_knee", f"{side}_hip_yaw", (0, 0, -0.25), "pitch", 0.0, 2.5),
            Part(f"{side}_ankle_pitch", f"{side}_knee", (0, 0, -0.33), "pitch", -0.9, 0.9),
            Part(
                f"{side}_ankle_roll",
                f"{side}_ankle_pitch",
                (0, 0, 0),
                "roll",
                -0.4,
                0.4,
                (0.1, 0.04, 0.02, 0.04, 0, -0.05),
            ),
            Part(f"{side}_shoulder_pitch", "chest", (0, sign * 0.18, 0.38), "pitch", -3.0, 1.5),
            Part(f"{side}_shoulder_roll", f"{side}_shoulder_pitch", (0, 0, 0), "roll", -2.8, 2.8),
            Part(f"{side}_shoulder_yaw", f"{side}_shoulder_roll", (0, 0, -0.1), "yaw", -1.6, 1.6),
            Part(f"{side}_elbow", f"{side}_shoulder_yaw", (0, 0, -0.15), "pitch", -2.4, 0.0),
            Part(f"{side}_wrist", f"{side}_elbow", (0, 0, -0.24), "yaw", -1.5, 1.5, (0.02, 0.02, 0.04, 0, 0, -0.05)),
        ]
    return made


def mjcf(made: list[Part] | None = None, free: str = "<freejoint name='root'/>", more: str = "") -> str:
    """The robot as a model of MuJoCo, in degrees; elbows' values are 0.3 rad higher than their turns from rest."""
    made = parts() if made is None else made

    def bodies(parent: str) -> str:
        return "".join(body(part) for part in made if part.parent == parent)

    def body(part: Part) -> str:
        zero = np.degrees(0.3) if "elbow" in part.name else 0.0
        low, high = np.degrees([part.lower, part.upper]) + zero
        text = f"<body name='{part.name}_body' pos='{_text(part.place)}'><joint name='{part.name}' class='limited' "
        text += f"axis='{AXES[part.axis]}' range='{low:.6f} {high:.6f}' ref='{zero:.6f}'/>"
        half, middle = part.box[:3] or (0.02, 0.02, 0.02), part.box[3:] or (0, 0, 0)
        return text + f"<geom type='box' size='{_text(half)}' pos='{_text(middle)}'/>{bodies(part.name)}</body>"

    return (
        "<mujoco model='robot'>"
        "<default><default class='limited'><joint type='hinge' limited='true'/></default></default>"
        f"<worldbody><geom type='plane' size='9 9 1'/>{more}<body name='pelvis' pos='0 0 0.75'>{free}"
        f"<geom type='sphere' size='0.1'/>{bodies('pelvis')}</body></worldbody></mujoco>"
    )


def urdf(made: list[Part] | None = None, speed: float = 20.0, more: str = "") -> str:
    """The robot as URDF, with speed limits and a fixed frame at each sole."""
    made = parts() if made is None else made
    text = "<robot name='robot'><link name='pelvis'/>"
    for part in made:
        shape = ""
        if part.box:
            size = _text([2 * each for each in part.box[:3]])
            shape = (
                f"<collision><origin xyz='{_text(part.box[3:])}'/><geometry><box size='{size}'/></geometry></collision>"
            )
        text += (
            f"<link name='{part.name}_link'>{shape}</link><joint name='{part.name}' type='revolute'>"
            f"<parent link='{part.parent if part.parent == 'pelvis' else part.parent + '_link'}'/>"
            f"<child link='{part.name}_link'/><origin xyz='{_text(part.place)}'/><axis xyz='{AXES[part.axis]}'/>"
            f"<limit lower='{part.lower}' upper='{part.upper}' velocity='{speed}'/></joint>"
        )
    return text + more + "</robot>"


def renamed(made: list[Part]) -> list[Part]:
    """The same robot with names that say nothing."""
    names = {part.name: f"m{number}" for number, part in enumerate(made)} | {"pelvis": "pelvis"}
    return [
        Part(names[part.name], names[part.parent], part.place, part.axis, part.lower, part.upper, part.box)
        for part in made
    ]


def _text(numbers) -> str:
    return " ".join(f"{number:g}" for number in numbers)
