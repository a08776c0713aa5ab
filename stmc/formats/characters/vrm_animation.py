"""Write motions of a character as VRM Animation 1.0 (`.vrma`): a T-pose and rotations, without a mesh."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float

from stmc.formats.axes import Z_UP_TO_Y_UP, continued
from stmc.formats.characters.gltf_file import CharacterError, Gltf, animation_of, with_animation
from stmc.formats.characters.joint_names import VRM_BONES
from stmc.motion.geometry import matrix_to_quaternion
from stmc.motion.retargeting import Rig, RigMotion


def vrma_bytes(motion: RigMotion) -> bytes:
    """Return the bytes of a `.vrma` file: y up, facing z, in the character's unit."""
    bones = _bones(motion.rig)
    rest = motion.rig.posed(motion.spread[None], motion.rig.at("pelvis")[None])[0].numpy() @ Z_UP_TO_Y_UP.T
    turns = Z_UP_TO_Y_UP @ (motion.turns @ motion.spread.mT).numpy() @ Z_UP_TO_Y_UP.T
    places = list(bones.values())
    parents = [_parent(motion.rig, place, places) for place in places]
    local = [
        turns[:, place] if parent is None else np.swapaxes(turns[:, parent], 1, 2) @ turns[:, place]
        for place, parent in zip(places, parents, strict=True)
    ]
    quaternions = continued(matrix_to_quaternion(torch.from_numpy(np.stack(local, axis=1))))[..., [1, 2, 3, 0]]
    pelvis = motion.places[:, bones["hips"]].numpy() @ Z_UP_TO_Y_UP.T
    targets = [(0, "translation"), *((number, "rotation") for number in range(len(places)))]
    times = np.arange(len(pelvis)) / motion.fps
    made = animation_of(times, targets, [pelvis, *quaternions.swapaxes(0, 1)], motion.fps)
    return with_animation(Gltf(_document(bones, places, parents, rest), None), *made).to_glb()


def _document(
    bones: dict[str, int], places: list[int], parents: list[int | None], rest: Float[np.ndarray, "driven 3"]
) -> dict:
    nodes = []
    for bone, place, parent in zip(bones, places, parents, strict=True):
        below = [number for number, other in enumerate(parents) if other == place]
        offset = rest[place] - (0.0 if parent is None else rest[parent])
        nodes.append({"name": bone, "translation": offset.tolist()} | ({"children": below} if below else {}))
    humanoid = {"humanBones": {bone: {"node": number} for number, bone in enumerate(bones)}}
    return {
        "asset": {"version": "2.0", "generator": "stmc"},
        "extensionsUsed": ["VRMC_vrm_animation"],
        "extensions": {"VRMC_vrm_animation": {"specVersion": "1.0", "humanoid": humanoid}},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": nodes,
    }


def _bones(rig: Rig) -> dict[str, int]:
    """Map each VRM bone of the rig to its index among the driven nodes, the hips first."""
    if not rig.spine:
        raise CharacterError("it has no joint between pelvis and chest, but VRM Animation requires a spine")
    spine = {1: ("spine",), 2: ("spine", "chest")}.get(len(rig.spine), ("spine", "chest", "upperChest"))
    chosen = np.linspace(0, len(rig.spine) - 1, len(spine)).round().astype(int)
    bones = {bone: rig.place(joint) for bone, joint in VRM_BONES.items() if joint in rig.joints}
    bones |= {bone: rig.driven.index(rig.spine[number]) for bone, number in zip(spine, chosen, strict=True)}
    bones |= {"neck": rig.driven.index(rig.necks[0])} if rig.necks else {}
    return dict(sorted(bones.items(), key=lambda each: each[1]))


def _parent(rig: Rig, place: int, places: list[int]) -> int | None:
    """Return the index of the nearest bone above one."""
    node = rig.parents[rig.driven[place]]
    while node >= 0:
        above = rig.carriers[node]
        if above < 0:
            return None
        if above in places:
            return above
        node = rig.parents[rig.driven[above]]
    return None
