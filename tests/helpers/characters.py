"""Characters made by code: other names, proportions, rest poses, rolls and spines, as small `.glb` and `.bvh`."""

import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

JSON, BIN = 0x4E4F534A, 0x004E4942


@dataclass
class Bones:
    """Joints in the order parents first: where each is at rest (y up, facing z), and how its frame is turned."""

    names: list[str] = field(default_factory=list)
    parents: list[int] = field(default_factory=list)
    places: list[np.ndarray] = field(default_factory=list)

    def add(self, name: str, parent: str | None, place) -> None:
        self.names.append(name)
        self.parents.append(-1 if parent is None else self.names.index(parent))
        self.places.append(np.asarray(place, dtype=float))


def lanky(spines: int = 7, droop: float = 50.0) -> Bones:
    """Rigify's names, an A-pose, a long curved spine, long legs, twist bones in line, fingers, toes."""
    bones = Bones()
    bones.add("root", None, (0, 0, 0))
    bones.add("DEF-hips", "root", (0, 1.1, 0))
    before = "DEF-hips"
    for number in range(spines):
        height = (number + 1) / spines
        bones.add(f"DEF-spine.{number:03d}", before, (0, 1.1 + 0.5 * height, -0.05 * np.sin(np.pi * height)))
        before = f"DEF-spine.{number:03d}"
    chest = before
    bones.add("DEF-neck", chest, (0, 1.7, 0.0))
    bones.add("DEF-head", "DEF-neck", (0, 1.78, 0.02))
    for side, sign in (("L", 1), ("R", -1)):
        down = np.radians(droop)
        along = np.array([sign * np.cos(down), -np.sin(down), 0.05])
        shoulder = np.array([sign * 0.2, 1.58, -0.02])
        bones.add(f"DEF-shoulder.{side}", chest, (sign * 0.03, 1.6, 0.03))
        bones.add(f"DEF-upper_arm.{side}", f"DEF-shoulder.{side}", shoulder)
        bones.add(f"DEF-upper_arm.{side}.001", f"DEF-upper_arm.{side}", shoulder + 0.15 * along)
        bones.add(f"DEF-forearm.{side}", f"DEF-upper_arm.{side}.001", shoulder + 0.3 * along)
        fore = along + np.array([0, 0, 0.15])
        bones.add(f"DEF-hand.{side}", f"DEF-forearm.{side}", shoulder + 0.3 * along + 0.28 * fore)
        bones.add(f"DEF-f_index.{side}", f"DEF-hand.{side}", shoulder + 0.3 * along + 0.38 * fore)
        bones.add(f"DEF-thigh.{side}", "DEF-hips", (sign * 0.11, 1.05, 0))
        bones.add(f"DEF-shin.{side}", f"DEF-thigh.{side}", (sign * 0.13, 0.58, 0.03))
        bones.add(f"DEF-foot.{side}", f"DEF-shin.{side}", (sign * 0.15, 0.1, -0.02))
        bones.add(f"DEF-toe.{side}", f"DEF-foot.{side}", (sign * 0.17, 0.03, 0.14))
    return bones


def stocky() -> Bones:
    """Mixamo's names, a T-pose, short legs, a short spine, no collar bones, no toes, no fingers."""
    bones = Bones()
    bones.add("mixamorig:Hips", None, (0, 0.6, 0))
    bones.add("mixamorig:Spine", "mixamorig:Hips", (0, 0.75, 0))
    bones.add("mixamorig:Head", "mixamorig:Spine", (0, 1.1, 0))
    for side, sign in (("Left", 1), ("Right", -1)):
        bones.add(f"mixamorig:{side}Arm", "mixamorig:Spine", (sign * 0.22, 1.0, 0))
        bones.add(f"mixamorig:{side}ForeArm", f"mixamorig:{side}Arm", (sign * 0.4, 1.0, 0))
        bones.add(f"mixamorig:{side}Hand", f"mixamorig:{side}ForeArm", (sign * 0.62, 1.0, 0))
        bones.add(f"mixamorig:{side}UpLeg", "mixamorig:Hips", (sign * 0.12, 0.55, 0))
        bones.add(f"mixamorig:{side}Leg", f"mixamorig:{side}UpLeg", (sign * 0.12, 0.33, 0.01))
        bones.add(f"mixamorig:{side}Foot", f"mixamorig:{side}Leg", (sign * 0.12, 0.08, 0))
    return bones


def document(bones: Bones, seed: int | None = 0, scale: float = 1.0, yaw: float = 0.0) -> tuple[dict, bytes]:
    """The bones as a glTF document and its binary chunk: a skinned triangle for each joint, below an armature that is
    scaled and turned. `seed`: joints' frames are rolled and turned at random; None: they lie along the world's axes."""
    count = len(bones.names)
    turns = Rotation.identity(count) if seed is None else Rotation.random(count, random_state=seed)
    armature = Rotation.from_euler("y", yaw)
    nodes = []
    for joint, parent in enumerate(bones.parents):
        above = turns[parent] if parent >= 0 else Rotation.identity()
        offset = above.inv().apply(bones.places[joint] - (bones.places[parent] if parent >= 0 else 0)) / scale
        node = {"name": bones.names[joint], "translation": offset.tolist()}
        node["rotation"] = (above.inv() * turns[joint]).as_quat().tolist()
        children = [other for other in range(count) if bones.parents[other] == joint]
        nodes.append(node | ({"children": children} if children else {}))
    roots = [joint for joint, parent in enumerate(bones.parents) if parent < 0]
    top = {"name": "Armature", "children": roots, "rotation": armature.as_quat().tolist(), "scale": [scale] * 3}
    nodes += [top, {"name": "body", "mesh": 0, "skin": 0}]
    world = np.tile(np.eye(4), (count, 1, 1))
    world[:, :3, :3] = (armature * turns).as_matrix() * scale
    world[:, :3, 3] = armature.apply(bones.places)
    corners = world[:, None, :3, 3] + 0.02 * np.eye(3)
    arrays = {
        "POSITION": corners.reshape(-1, 3).astype("<f4"),
        "JOINTS_0": np.repeat(np.arange(count), 3)[:, None].astype("<u2") * np.array([1, 0, 0, 0], "<u2"),
        "WEIGHTS_0": np.tile(np.array([1, 0, 0, 0], "<f4"), (3 * count, 1)),
        "bind": np.linalg.inv(world).swapaxes(1, 2).reshape(count, 16).astype("<f4"),
    }
    views, accessors, binary = [], [], b""
    for name, array in arrays.items():
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": array.nbytes})
        kind = {3: "VEC3", 4: "VEC4", 16: "MAT4"}[array.shape[1]]
        component = 5126 if array.dtype.kind == "f" else 5123
        accessor = {"bufferView": len(accessors), "componentType": component, "count": len(array), "type": kind}
        if name == "POSITION":
            accessor |= {"min": array.min(axis=0).tolist(), "max": array.max(axis=0).tolist()}
        accessors.append(accessor)
        binary += array.tobytes()
    attributes = {name: number for number, name in enumerate(arrays) if name != "bind"}
    made = {
        "asset": {"version": "2.0", "generator": "a stranger"},
        "scene": 0,
        "scenes": [{"nodes": [count, count + 1]}],
        "nodes": nodes,
        "meshes": [{"primitives": [{"attributes": attributes}]}],
        "skins": [{"joints": list(range(count)), "inverseBindMatrices": 3}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(binary)}],
    }
    return made, binary


def packed(document: Mapping | str, binary: bytes | None = b"") -> bytes:
    """A `.glb` of a document, which may be hostile text."""
    text = (document if isinstance(document, str) else json.dumps(document)).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), JSON) + text
    if binary is not None:
        binary += b"\0" * (-len(binary) % 4)
        chunks += struct.pack("<II", len(binary), BIN) + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def unpacked(content: bytes) -> tuple[dict, bytes]:
    """The document and the binary chunk of a `.glb`."""
    size = struct.unpack_from("<I", content, 12)[0]
    return json.loads(content[20 : 20 + size]), content[28 + size :]


def glb(bones: Bones, **settings) -> bytes:
    """A `.glb` of bones; settings as `document`'s."""
    return packed(*document(bones, **settings))


def bvh(bones: Bones, unit: float = 100.0) -> str:
    """A `.bvh` of bones in centimetres, one frame of zero angles."""
    lines = ["HIERARCHY"]

    def joint(index: int, indent: str) -> None:
        parent = bones.parents[index]
        offset = (bones.places[index] - bones.places[parent] if parent >= 0 else np.zeros(3)) * unit
        moves = "CHANNELS 6 Xposition Yposition Zposition" if parent < 0 else "CHANNELS 3"
        name = bones.names[index].replace(" ", "_")
        lines.extend([f"{indent}{'ROOT' if parent < 0 else 'JOINT'} {name}", indent + "{"])
        lines.append(f"{indent} OFFSET {offset[0]:.6f} {offset[1]:.6f} {offset[2]:.6f}")
        lines.append(f"{indent} {moves} Zrotation Xrotation Yrotation")
        children = [other for other, above in enumerate(bones.parents) if above == index]
        for child in children:
            joint(child, indent + " ")
        if not children:
            lines.extend([f"{indent} End Site", f"{indent} {{", f"{indent}  OFFSET 0 5 0", f"{indent} }}"])
        lines.append(indent + "}")

    joint(0, "")
    lines += ["MOTION", "Frames: 1", "Frame Time: 0.0333333", " ".join(["0"] * (3 + 3 * len(bones.names)))]
    return "\n".join(lines) + "\n"


def moved(content: bytes, frame: int) -> dict[str, np.ndarray]:
    """An oracle from glTF's specification: world matrices of all named nodes in a frame of the first animation."""
    made, binary = unpacked(content)
    local = []
    for node in made["nodes"]:
        matrix = np.eye(4)
        if "matrix" in node:
            matrix = np.array(node["matrix"]).reshape(4, 4).T
        parts = {"translation": node.get("translation", [0, 0, 0]), "rotation": node.get("rotation", [0, 0, 0, 1])}
        local.append((matrix, parts, node.get("scale", [1, 1, 1]), "matrix" in node))
    animation = made["animations"][0]
    for channel in animation["channels"]:
        accessor = made["accessors"][animation["samplers"][channel["sampler"]]["output"]]
        view = made["bufferViews"][accessor["bufferView"]]
        width = int(accessor["type"][-1])
        values = np.frombuffer(binary, "<f4", accessor["count"] * width, view["byteOffset"]).reshape(-1, width)
        assert not local[channel["target"]["node"]][3], "a matrix is animated"
        local[channel["target"]["node"]][1][channel["target"]["path"]] = values[frame]
    world: dict[str, np.ndarray] = {}

    def place(number: int, above: np.ndarray) -> None:
        matrix, parts, scale, fixed = local[number]
        if not fixed:
            matrix = np.eye(4)
            matrix[:3, :3] = Rotation.from_quat(parts["rotation"]).as_matrix() * np.array(scale)
            matrix[:3, 3] = parts["translation"]
        world[made["nodes"][number].get("name", str(number))] = above @ matrix
        for child in made["nodes"][number].get("children", []):
            place(child, above @ matrix)

    for root in made["scenes"][made.get("scene", 0)]["nodes"]:
        place(root, np.eye(4))
    return world
