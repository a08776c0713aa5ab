"""The poses of a character without its mesh, for a player that holds the character's file.

Knows the nodes of glTF and the world in which our motions are shown: metres, y up, facing z.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from stmc.formats.axes import Z_UP_TO_Y_UP
from stmc.formats.characters.characters import CharacterMotion
from stmc.formats.characters.gltf_file import CharacterError, Gltf, animation_of, with_animation
from stmc.formats.characters.gltf_rig import GltfRig
from stmc.motion.body import JOINTS, BodyPart
from stmc.motion.geometry import matrix_to_quaternion
from stmc.motion.motion import Motion
from stmc.motion.retargeting import Rig


def stage_poses(moved: CharacterMotion, motion: Motion) -> bytes:
    """Return a `.glb` without a mesh whose animation moves the character as `moved` and has the joints of `motion`.

    Its nodes are: "n12" for each driven node, where 12 is the node's index in the character's file, with `extras` that
    name its body part and, if it is a joint of ours, the joint; one named as each joint of ours, where that joint is in
    the motion (metres, y up); and "stage", whose rotation and scale bring the character's world to that of the motion,
    its legs as long as ours. Raises `CharacterError` for a character without a mesh.
    """
    body, rig = moved.character.body, moved.motion.rig
    if not isinstance(body, GltfRig):
        raise CharacterError("a BVH file has no mesh, so there is nothing to show")
    rotations, pelvis = body.local_pose(moved.motion, moved.character.standing)
    driven = list(rotations)
    turn = torch.from_numpy(Z_UP_TO_Y_UP @ moved.character.standing.turn)
    nodes: list[dict[str, Any]] = [{"name": f"n{body.nodes[node]}", "extras": _extras(rig, node)} for node in driven]
    nodes += [{"name": joint} for joint in JOINTS]
    scale = 1 / moved.motion.scale
    nodes.append({"name": "stage", "rotation": _quaternion(turn), "scale": [scale] * 3})
    targets = [(number, "rotation") for number in range(len(driven))]
    targets.append((driven.index(rig.joints["pelvis"]), "translation"))
    targets += [(len(driven) + number, "translation") for number in range(len(JOINTS))]
    places = motion.joints.double().cpu().numpy() @ Z_UP_TO_Y_UP.T
    tracks = [*rotations.values(), pelvis, *places.swapaxes(0, 1)]
    made = animation_of(np.arange(motion.frames) / motion.fps, targets, tracks, motion.fps)
    document = {"asset": {"version": "2.0", "generator": "stmc"}, "scene": 0}
    document |= {"scenes": [{"nodes": list(range(len(nodes)))}], "nodes": nodes}
    return with_animation(Gltf(document, None), *made).to_glb()


def _extras(rig: Rig, node: int) -> dict[str, str]:
    """Return the body part of a driven node, and its joint if it is one of ours."""
    if node in rig.spine and node not in rig.joints.values():
        return {"part": BodyPart.SPINE}
    joint = next((joint for joint, other in rig.joints.items() if other == node), None)
    if joint is None:
        return {"part": BodyPart.HEAD}  # the necks, which alone are left
    if joint.endswith("_collar"):
        return {"part": BodyPart.SPINE, "joint": joint}  # it carries half of the chest, though arms own its turns
    return {"part": next(part for part in BodyPart if joint in part.joints), "joint": joint}


def _quaternion(turn: Float[torch.Tensor, "3 3"]) -> list[float]:
    """Return a rotation matrix as a quaternion x y z w."""
    return matrix_to_quaternion(turn).numpy()[[1, 2, 3, 0]].tolist()
