"""The three-dimensional part of a page: a body that moves and changes colours over a floor, recorded with viser."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import rich
import roma
import torch
from jaxtyping import Float

from stmc.io.extras import named_extra
from stmc.motion.body import BodyPart
from stmc.motion.motion import Motion
from stmc.motion.skins import PARTS, Skin
from stmc.viewing.camera import framing

with named_extra():
    import viser

FOV = math.radians(38.0)
ASPECTS = (0.35, 0.5, 0.7, 1.0, 1.4, 1.9, 2.6)
"""Windows that a camera is ready for: their width over the height that the tracks leave."""
ASPECT = 1.9
"""The one that the recording begins with, until the page has measured its window."""
REST = 0.5
"""Seconds for which the last frame stands before the page starts again."""
_LEGS = PARTS.index("legs")


def record(motion: Motion, skin: Skin, colours: Float[np.ndarray, "frames parts 3"]) -> str:
    """viser's self-contained page: the motion played in a loop, `colours` (0 to 1) of the parts in each frame."""
    with _server() as server:
        _light(server)
        _ground(server, motion, colours)
        _aim(server, motion)
        pieces = _Pieces(server, motion, skin, colours)
        serializer = server.get_scene_serializer()
        for frame in range(1, motion.frames):
            serializer.insert_sleep(1.0 / motion.fps)
            pieces.show(frame)
        serializer.insert_sleep(1.0 / motion.fps + REST)
        return serializer.as_html()


@contextmanager
def _server() -> Iterator[viser.ViserServer]:
    """A server that nobody visits, on any free local port: viser records what a server's scene is told."""
    console = rich.get_console()
    quiet, console.quiet = console.quiet, True  # viser greets and takes leave, whatever `verbose` says
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    try:
        yield server
    finally:
        server.stop()
        console.quiet = quiet


class _Pieces:
    """The five parts of the body, each a mesh on those of the 24 bones that move it."""

    def __init__(
        self, server: viser.ViserServer, motion: Motion, skin: Skin, colours: Float[np.ndarray, "frames parts 3"]
    ) -> None:
        rotations, self._places = skin.bones(motion)
        self._turns = roma.quat_xyzw_to_wxyz(roma.rotmat_to_unitquat(torch.from_numpy(rotations))).numpy()
        self._colours = np.round(255 * colours).astype(int)
        rest = skin.skeleton.rest.double().numpy()
        self._meshes = []
        for part in BodyPart:
            piece = skin.only(part)
            bones = np.flatnonzero(piece.weights.any(axis=0))
            mesh = server.scene.add_mesh_skinned(
                f"/body/{part}",
                piece.vertices,
                piece.faces,
                bone_wxyzs=np.tile([1.0, 0.0, 0.0, 0.0], (len(bones), 1)),
                bone_positions=rest[bones],
                skin_weights=piece.weights[:, bones],
                color=tuple(self._colours[0, PARTS.index(part)]),
            )
            self._meshes.append((mesh, bones))
        self.show(0)

    def show(self, frame: int) -> None:
        """Pose and colour the parts as in one frame; what stays as it was is not sent again."""
        for index, (mesh, bones) in enumerate(self._meshes):
            for handle, bone in zip(mesh.bones, bones, strict=True):
                handle.wxyz = self._turns[frame, bone]
                handle.position = self._places[frame, bone]
            colour = self._colours[frame, index]
            if frame == 0 or (colour != self._colours[frame - 1, index]).any():
                mesh.color = tuple(int(value) for value in colour)


def _light(server: viser.ViserServer) -> None:
    server.scene.set_up_direction("+z")
    server.scene.configure_default_lights(enabled=True, cast_shadow=True)


def _ground(server: viser.ViserServer, motion: Motion, colours: Float[np.ndarray, "frames parts 3"]) -> None:
    """A floor of metre tiles, and on it the pelvis' path in the colours of the legs."""
    server.scene.add_grid(
        "/floor", infinite_grid=True, cell_size=0.5, section_size=1.0, cell_color=(226, 229, 234),
        section_color=(205, 209, 216), plane_color=(246, 247, 249), plane_opacity=1.0, shadow_opacity=0.28,
        fade_distance=30.0,
    )  # fmt: skip
    if motion.frames < 2:
        return
    path = motion.translation.double().cpu().numpy() * [1.0, 1.0, 0.0] + [0.0, 0.0, 0.004]
    # viser takes the colours of lines as linear light
    linear = np.round(255 * colours[:, _LEGS] ** 2.2).astype(np.uint8)
    server.scene.add_line_segments(
        "/path", np.stack([path[:-1], path[1:]], axis=1), np.stack([linear[:-1], linear[1:]], axis=1), thickness=0.022
    )


def cameras(motion: Motion) -> list[dict[str, Any]]:
    """For windows of several shapes, from narrow to wide, where a camera sees all of the motion: "aspect", "position"
    and "target" (metres, z up)."""
    joints, facing = motion.joints.double().cpu().numpy(), motion.facing[0].double().cpu().numpy()
    found = [(aspect, *framing(joints, facing, FOV, aspect)) for aspect in ASPECTS]
    return [
        {"aspect": aspect, "position": position.round(3).tolist(), "target": target.round(3).tolist()}
        for aspect, position, target in found
    ]


def _aim(server: viser.ViserServer, motion: Motion) -> None:
    camera = server.initial_camera
    chosen = next(each for each in cameras(motion) if each["aspect"] == ASPECT)
    camera.position, camera.look_at = chosen["position"], chosen["target"]
    camera.up = (0.0, 0.0, 1.0)
    camera.fov = FOV
