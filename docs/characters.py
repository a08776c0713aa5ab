"""Draw characters beside the mannequin: `python docs/characters.py CMU PICTURE.png CHARACTER.glb...`.

CMU is a folder with the recordings that the numbers of characters.md come from. The picture has a column for each
moment, and a row for the mannequin and for each character, in the colours of body parts.
"""

import sys
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Self

import numpy as np
import torch
from jaxtyping import Float, Int
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image

import stmc
from stmc.data.sources.cmu import catalogue
from stmc.formats.characters.gltf_file import Gltf, objects, parents_of
from stmc.formats.characters.gltf_rig import GltfRig, transform
from stmc.motion.body import BodyPart
from stmc.motion.geometry import quaternion_to_matrix
from stmc.motion.skins import PARTS
from stmc.viewing.colours import as_rgb
from stmc.viewing.figure import Figure
from stmc.viewing.strip import Stage

FPS = 20
MOMENTS = (
    ("02_01", 0.8, "walk"), ("02_01", 2.45, "walk"), ("14_31", 6.4, "sit down"), ("14_24", 13.6, "wave"),
    ("14_30", 19.4, "hand on chin"), ("135_04", 6.4, "kick"), ("135_04", 6.75, "kick"),
)  # fmt: skip
"""Recordings, seconds and names."""
COLOURS = dict(zip(BodyPart, ("#e69f00", "#56b4e9", "#0072b2", "#cc79a7", "#b9bec7"), strict=True))
NUMBERS = {5121: "<u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
"""Types of numbers by their codes in glTF."""


@dataclass(frozen=True)
class Surface:
    """The skinned surface of a character in each frame, in the world of our motions."""

    faces: Int[np.ndarray, "faces 3"]
    vertices: Float[np.ndarray, "vertices 3"]
    """In the first frame."""
    parts: Int[np.ndarray, " faces"]
    frames: Float[np.ndarray, "frames vertices 3"]


class CharacterStage(Stage):
    """A stage on which a character moves in place of the mannequin."""

    def vertices(self, frame: int) -> Float[np.ndarray, "vertices 3"]:
        """Return the vertices of the character at one frame."""
        return self.skin.frames[frame]

    def fit(self) -> Self:
        """Return the stage with room for the character, whose trunk and head may be larger than the mannequin's."""
        seen = (self.vertices(0) - self.ground[0]) @ self.camera.T
        wide, low, high = self.frame
        wide = max(wide, float(np.abs(seen[:, 0]).max()) + 0.06)
        return replace(self, frame=(wide, low, max(high, float(seen[:, 1].max()) + 0.08)))


def read_accessor(gltf: Gltf, number: int) -> np.ndarray:
    """Return the rows of an accessor; integers that stand for fractions are converted."""
    accessor = gltf.document["accessors"][number]
    view = gltf.document["bufferViews"][accessor["bufferView"]]
    kind = np.dtype(NUMBERS[accessor["componentType"]])
    width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}[accessor["type"]]
    start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    stride = view.get("byteStride", kind.itemsize * width)
    rows = np.ndarray((accessor["count"], width), kind, gltf.binary, start, (stride, kind.itemsize))
    return rows / np.iinfo(kind).max if accessor.get("normalized") else rows


def node_matrices(moved: stmc.CharacterMotion) -> Float[np.ndarray, "frames nodes 4 4"]:
    """Return the world matrices of all nodes of the character's file in each frame."""
    body = moved.character.body
    assert isinstance(body, GltfRig)
    rotations, pelvis = body.local_pose(moved.motion, moved.character.standing)
    driven = {body.nodes[node]: values for node, values in rotations.items()}
    above = parents_of(objects(body.gltf.document, "nodes"))
    world = np.tile(np.eye(4), (len(pelvis), len(above), 1, 1))

    def depth(node: int) -> int:
        return 0 if above[node] < 0 else 1 + depth(above[node])

    for node in sorted(range(len(above)), key=depth):
        translation, turn, scale = transform(body.gltf.nodes[node], "node")
        turns = np.broadcast_to(turn, (len(pelvis), 3, 3))
        if node in driven:
            turns = quaternion_to_matrix(torch.from_numpy(driven[node][:, [3, 0, 1, 2]])).numpy()
        world[:, node, :3, :3] = turns * scale
        pelvic = node == body.nodes[moved.motion.rig.joints["pelvis"]]
        world[:, node, :3, 3] = pelvis if pelvic else translation
        if above[node] >= 0:
            world[:, node] = world[:, above[node]] @ world[:, node]
    return world


def node_parts(moved: stmc.CharacterMotion) -> Int[np.ndarray, " nodes"]:
    """Return the body part that moves each node of the file, as an index into `PARTS`."""
    body, rig = moved.character.body, moved.motion.rig
    assert isinstance(body, GltfRig)
    joints = {node: "head" for node in rig.necks} | {node: "spine1" for node in rig.spine}
    joints |= {node: joint for joint, node in rig.joints.items() if not joint.endswith("collar")}
    joints |= {node: "spine1" for joint, node in rig.joints.items() if joint.endswith("collar")}
    joints = {body.nodes[node]: joint for node, joint in joints.items()}
    above = parents_of(objects(body.gltf.document, "nodes"))
    parts = []
    for node in range(len(above)):
        while node >= 0 and node not in joints:
            node = above[node]
        joint = joints.get(node, "pelvis")
        parts.append(next(number for number, part in enumerate(PARTS) if joint in part.joints))
    return np.array(parts)


def surface(moved: stmc.CharacterMotion, frame: int) -> Surface:
    """Compute the surface of a character in two frames, by linear blend skinning."""
    body = moved.character.body
    assert isinstance(body, GltfRig)
    gltf, world, owners = body.gltf, node_matrices(moved)[frame : frame + 2], node_parts(moved)
    to_ours = moved.character.standing.turn.T / moved.motion.scale
    faces, places, parts, count = [], [], [], 0
    for node in gltf.nodes:
        if "mesh" not in node or "skin" not in node:
            continue
        skin = gltf.document["skins"][node["skin"]]
        inverse = read_accessor(gltf, skin["inverseBindMatrices"]).reshape(-1, 4, 4).swapaxes(1, 2)
        bones = world[:, skin["joints"]] @ inverse
        for primitive in gltf.document["meshes"][node["mesh"]]["primitives"]:
            names = primitive["attributes"]
            rest = read_accessor(gltf, names["POSITION"])
            carriers, weights = (read_accessor(gltf, names[name]) for name in ("JOINTS_0", "WEIGHTS_0"))
            blended = np.einsum("vk,fvkij->fvij", weights, bones[:, carriers])
            places.append((blended @ np.append(rest, np.ones((len(rest), 1)), axis=1)[..., None])[..., :3, 0] @ to_ours)
            corners = read_accessor(gltf, primitive["indices"]) if "indices" in primitive else np.arange(len(rest))
            corners = corners.reshape(-1, 3).astype(int)
            nearest = np.array(skin["joints"])[carriers[np.arange(len(rest)), weights.argmax(axis=1)]]
            faces.append(corners + count)
            parts.append(owners[nearest[corners[:, 0]]])
            count += len(rest)
    frames = np.concatenate(places, axis=1)
    return Surface(np.concatenate(faces), frames[0], np.concatenate(parts), frames)


def read_recordings(folder: Path) -> dict[str, stmc.Motion]:
    """Return the recordings of all moments, with clean feet."""
    names = {name for name, *_ in MOMENTS}
    sources = (each for each in catalogue.read_sources(folder) if isinstance(each, catalogue.Source))
    skeleton = stmc.Skeleton.default()
    return {each.name: stmc.clean_feet(catalogue.read(each, skeleton, FPS)) for each in sources if each.name in names}


def draw(recordings: dict[str, stmc.Motion], characters: list[Path]) -> Figure:
    """Draw each moment on the mannequin and on each character."""
    figure = Figure(figsize=(1.75 * len(MOMENTS), 2.1 * (1 + len(characters))), layout="constrained")
    axes = figure.subplots(1 + len(characters), len(MOMENTS), squeeze=False)
    colours = np.array([as_rgb(COLOURS[part]) for part in PARTS])[None]
    rigs = [stmc.read_character(path) for path in characters]
    for column, (name, seconds, title) in enumerate(MOMENTS):
        frame = round(seconds * FPS)
        motion = recordings[name].trimmed(frame, frame + 2)
        stage = Stage.of(motion, None, colours.repeat(2, axis=0), np.array([0]))
        values = {each.name: getattr(stage, each.name) for each in fields(stage)}
        stages = [stage]
        for rig in rigs:
            first = max(0, frame - FPS)  # contacts need what is around a frame
            last = min(frame + FPS, recordings[name].frames)
            moved = stmc.retarget(recordings[name].trimmed(first, last), rig)
            stages.append(CharacterStage(**(values | {"skin": surface(moved, frame - first)})).fit())
        for row, each in enumerate(stages):
            each.paint(axes[row, column], 0)
            axes[row, column].set_title(title if row == 0 else "", fontsize=9)
    for row, label in enumerate(["mannequin", *(path.stem for path in characters)]):
        axes[row, 0].set_ylabel(label, fontsize=9)
    return figure


def main(folder: str, picture: str, *characters: str) -> None:
    """Write the picture."""
    drawing = draw(read_recordings(Path(folder)), [Path(each) for each in characters])
    canvas = FigureCanvasAgg(drawing)
    drawing.set_dpi(80)
    canvas.draw()
    Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3]).quantize(128).save(picture, optimize=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
