"""Motions for robotics: tables of MuJoCo's `qpos`, and the skeleton as a MuJoCo model.

MuJoCo's conventions are z up, metres, quaternions relative to the parent with the real part first, and joints depth
first. A row of the table, without its time, is therefore the `qpos` of the model.
"""

from __future__ import annotations

import io
from typing import IO
from xml.sax.saxutils import quoteattr

import numpy as np
from jaxtyping import Float

from stmc.formats.axes import continued
from stmc.motion.body import JOINTS, NUM_ROTATIONS, PARENTS
from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import matrix_to_quaternion
from stmc.motion.motion import Motion
from stmc.timeline import Timeline

_THICK = 0.035
"""Radius of the model's bones, in metres."""


def save_csv(motion: Motion, file: IO[bytes], skeleton: Skeleton, timeline: Timeline | None) -> None:
    """Write a line of names, then one line per frame.

    A line holds the time (s), the position of the pelvis (m), and the quaternions w x y z of the 22 joints: that of the
    pelvis in the world, the others relative to their parents.

    Args:
        motion: Motion to write.
        file: Binary file.
        skeleton: Not used.
        timeline: Not used.
    """
    names = [f"{JOINTS[joint]}_q{axis}" for joint in depth_first() for axis in "wxyz"]
    header = ",".join(["time", "pelvis_x", "pelvis_y", "pelvis_z", *names])
    times = np.arange(motion.frames)[:, None] / motion.fps
    text = io.BytesIO()
    np.savetxt(text, np.concatenate([times, _qpos(motion)], axis=1), "%.6f", ",", header=header, comments="")
    file.write(text.getvalue())


def save_mjcf(motion: Motion, file: IO[bytes], skeleton: Skeleton, timeline: Timeline | None) -> None:
    """Write the skeleton as a MuJoCo model: a free pelvis, 21 ball joints, and capsules as bones.

    Each frame is a keyframe with its time; the timeline's JSON is a text named "timeline".

    Args:
        motion: Motion to write.
        file: Binary file.
        skeleton: Body to write.
        timeline: Timeline to store, or None.
    """
    times = [f"{frame / motion.fps:.6f}" for frame in range(motion.frames)]
    rows = [" ".join(f"{value:.6f}" for value in row) for row in _qpos(motion)]
    lines = ['<mujoco model="stmc">', '  <compiler angle="radian"/>', "  <worldbody>"]
    lines += ['    <light pos="0 0 4"/>', '    <geom type="plane" size="20 20 0.1" rgba="0.9 0.9 0.92 1"/>']
    lines += [*_body(0, skeleton, "    "), "  </worldbody>"]
    if timeline is not None:
        lines += [f'  <custom><text name="timeline" data={quoteattr(timeline.to_json())}/></custom>']
    keys = (f'    <key time="{time}" qpos="{row}"/>' for time, row in zip(times, rows, strict=True))
    lines += ["  <keyframe>", *keys, "  </keyframe>", "</mujoco>"]
    file.write(("\n".join(lines) + "\n").encode())


def depth_first(joint: int = 0) -> list[int]:
    """List a joint and its rotated descendants in the order of MuJoCo's `qpos`."""
    below = [index for index, parent in enumerate(PARENTS[:NUM_ROTATIONS]) if parent == joint]
    return [joint, *(descendant for child in below for descendant in depth_first(child))]


def _qpos(motion: Motion) -> Float[np.ndarray, "frames 91"]:
    turns = continued(matrix_to_quaternion(motion.rotations.double()))[:, depth_first()]
    return np.concatenate([motion.translation.double().cpu().numpy(), turns.reshape(motion.frames, -1)], axis=1)


def _body(joint: int, skeleton: Skeleton, indent: str) -> list[str]:
    """Return the lines of a joint's body and of its descendants."""
    offset, inner = skeleton.offsets[joint].tolist() if joint else [0.0, 0.0, 0.0], indent + "  "
    kind = '<freejoint name="pelvis"/>' if joint == 0 else f'<joint name="{JOINTS[joint]}" type="ball"/>'
    lines = [f'{indent}<body name="{JOINTS[joint]}" pos="{_numbers(offset)}">', inner + kind]
    ends = [skeleton.offsets[index].tolist() for index, parent in enumerate(PARENTS) if parent == joint]
    for end in ends or [[0.0, 0.0, 0.02]]:
        along = f'type="capsule" fromto="0 0 0 {_numbers(end)}" size="{_THICK}"'
        lines.append(f'{inner}<geom {along} contype="0" conaffinity="0"/>')
    for child in depth_first(joint)[1:]:
        lines += _body(child, skeleton, inner) if PARENTS[child] == joint else []
    return [*lines, f"{indent}</body>"]


def _numbers(values: list[float]) -> str:
    return " ".join(f"{value:.6f}" for value in values)
