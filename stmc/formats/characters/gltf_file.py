"""Reading and writing glTF 2.0 files (`.glb`, `.vrm`, `.gltf`) as a JSON document and a binary chunk, within bounds.

Knows containers, nodes and skins, but no persons. Meshes, materials and textures pass through unread.
"""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from stmc.formats.glb_container import BIN, JSON, pack_glb
from stmc.io.untrusted import UnreadableError, load_json, quote, read_bytes

MOST_BYTES = 2**28
"""Maximum size of a file: 256 MiB."""
MOST_JSON = 2**24
"""Maximum size of the JSON: 16 MiB. A character of 200 joints has 100 kB."""
MOST_NODES = 20_000
MOST_JOINTS = 1_000
"""Maximum number of joints of all skins. A character with fingers, face and clothes has about 200."""
MOST_VERTICES = 2_000_000
"""Maximum number of vertices of all meshes. A film character has about 200,000."""
MOST_METRES = 1e6
"""Maximum absolute value of a number in a transform."""

COMPRESSIONS = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression")


class CharacterError(ValueError):
    """Error for a file that cannot be animated; the message is a sentence that says what is missing."""


@dataclass(frozen=True, eq=False)
class Gltf:
    """A JSON document and its binary chunk; None for a file without one."""

    document: dict[str, Any]
    binary: bytes | None

    @property
    def nodes(self) -> list[dict[str, Any]]:
        """The nodes of the document."""
        return self.document["nodes"]

    def to_glb(self) -> bytes:
        """Return the bytes of a `.glb` file."""
        return pack_glb(self.document, self.binary)


def read_gltf(path: Path) -> Gltf:
    """Read a `.glb`, `.vrm` or `.gltf` file; a first buffer that is in the JSON becomes the binary chunk.

    Raises `CharacterError` unless the file is complete and self-contained glTF 2.0, its meshes are uncompressed and
    within the bounds above, and its nodes form trees.
    """
    try:
        gltf = _split(read_bytes(path, MOST_BYTES))
    except UnreadableError as error:
        raise CharacterError(str(error)) from None
    _check_document(gltf)
    return _with_binary(gltf)


def _split(content: bytes) -> Gltf:
    if content[:4] != b"glTF":
        return Gltf(_document(content), None)
    if len(content) < 20:
        raise CharacterError("the file ends within its header")
    version, length = struct.unpack_from("<II", content, 4)
    if version != 2:
        raise CharacterError(f"a glTF of version {version}; only version 2 is read")
    if length != len(content):
        raise CharacterError(f"the file has {len(content)} bytes, but its header says {length}: it is cut or damaged")
    size, kind = struct.unpack_from("<II", content, 12)
    if kind != JSON or 20 + size > length:
        raise CharacterError("its first chunk is not a whole JSON document: the file is damaged")
    document, place = _document(content[20 : 20 + size]), 20 + size
    if place == length:
        return Gltf(document, None)
    if place + 8 > length:
        raise CharacterError("the file ends within the header of its second chunk")
    size, kind = struct.unpack_from("<II", content, place)
    if kind != BIN or place + 8 + size != length:
        raise CharacterError("its second chunk is not a whole binary one, or not the last: the file is damaged")
    return Gltf(document, content[place + 8 :])


def _document(content: bytes) -> dict[str, Any]:
    if len(content) > MOST_JSON:
        raise CharacterError(f"its JSON has {len(content):,} bytes, more than {MOST_JSON:,}, the limit")
    try:
        document = load_json(content.decode("utf-8"))
        json.dumps(document, allow_nan=False)
    except UnicodeDecodeError:
        raise CharacterError("neither a glTF file nor JSON: its text is not UTF-8") from None
    except UnreadableError as error:
        raise CharacterError(str(error)) from None
    except (ValueError, RecursionError):
        raise CharacterError("its JSON has a number that is not finite") from None
    if not isinstance(document, dict):
        raise CharacterError("its JSON is not an object, so it is not a glTF file")
    return document


def objects(document: Mapping[str, Any], name: str) -> list[dict[str, Any]]:
    """Return a list of objects of the document, empty if it is absent. Raises `CharacterError` for other values."""
    values = document.get(name, [])
    if not isinstance(values, list) or not all(isinstance(value, dict) for value in values):
        raise CharacterError(f"{name} is not a list of objects")
    return values


def index(value: Any, count: int, name: str) -> int:
    """Return `value` if it is an index below `count`. Raises `CharacterError` with `name` otherwise."""
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < count:
        raise CharacterError(f"{name} is {quote(value)}, which is not one of {count}")
    return value


def numbers(value: Any, count: int, name: str) -> list[float]:
    """Return `count` numbers up to `MOST_METRES`. Raises `CharacterError` with `name` for other values."""
    if not isinstance(value, list) or len(value) != count:
        raise CharacterError(f"{name} is {quote(value)}, not {count} numbers")
    for each in value:
        if isinstance(each, bool) or not isinstance(each, (int, float)) or not abs(each) <= MOST_METRES:
            raise CharacterError(f"{name} has {quote(each)}, which is not a number up to {MOST_METRES:g}")
    return [float(each) for each in value]


def _check_document(gltf: Gltf) -> None:
    document = gltf.document
    asset = document.get("asset")
    if not isinstance(asset, dict) or not str(asset.get("version", "")).startswith("2."):
        raise CharacterError("its asset does not have glTF version 2")
    for name in ("extensionsUsed", "extensionsRequired"):
        if not isinstance(document.get(name, []), list):
            raise CharacterError(f"{name} is not a list")
    packed = [name for name in COMPRESSIONS if name in document.get("extensionsRequired", [])]
    packed += [name for name in COMPRESSIONS if name in document.get("extensionsUsed", []) and name not in packed]
    if packed:
        raise CharacterError(f"its meshes are compressed ({packed[0]}): export it without compression")
    _check_buffers(gltf)
    _check_vertices(document)
    for name in ("accessors", "bufferViews", "animations", "scenes"):
        objects(document, name)
    nodes = objects(document, "nodes")
    if len(nodes) > MOST_NODES:
        raise CharacterError(f"it has {len(nodes):,} nodes, more than {MOST_NODES:,}, the limit")


def _check_buffers(gltf: Gltf) -> None:
    """Raise `CharacterError` unless the file is self-contained."""
    for name in ("buffers", "images"):
        for number, each in enumerate(objects(gltf.document, name)):
            uri = each.get("uri")
            if uri is not None and not (isinstance(uri, str) and uri.startswith("data:")):
                where = f"{name}[{number}] is in another file, {quote(uri)}"
                raise CharacterError(f"{where}: export the character as one file, glTF Binary (.glb)")
    for number, each in enumerate(objects(gltf.document, "buffers")):
        size = each.get("byteLength")
        if isinstance(size, bool) or not isinstance(size, int) or not 0 < size <= MOST_BYTES:
            raise CharacterError(f"buffers[{number}] has a byteLength of {quote(size)}")
        if "uri" not in each:
            held = None if gltf.binary is None or number else len(gltf.binary)
            if held is None or not size <= held <= size + 3:
                raise CharacterError(f"buffers[{number}] should have {size} bytes, but the file holds {held or 0}")


def _with_binary(gltf: Gltf) -> Gltf:
    """Return the file with its first buffer as the binary chunk, because a `.glb` should have no data in its JSON."""
    buffers = objects(gltf.document, "buffers")
    if not buffers or "uri" not in buffers[0]:
        return gltf
    first, size = buffers[0], buffers[0]["byteLength"]
    kind, _, text = first["uri"].partition(",")
    try:
        content = base64.b64decode(text + "=" * (-len(text) % 4), validate=True)
    except ValueError:
        content = b""
    if not kind.endswith(";base64") or len(content) < size:
        raise CharacterError(f"buffers[0] should be {size} bytes in base64: the file is cut or damaged")
    first = {name: value for name, value in first.items() if name != "uri"}
    return Gltf({**gltf.document, "buffers": [first, *buffers[1:]]}, content[:size])


def _check_vertices(document: Mapping[str, Any]) -> None:
    accessors, seen, total = objects(document, "accessors"), set(), 0
    for mesh in objects(document, "meshes"):
        for piece in objects(mesh, "primitives"):
            attributes = piece.get("attributes")
            if not isinstance(attributes, dict) or "POSITION" not in attributes:
                raise CharacterError("a mesh has no positions")
            seen.add(index(attributes["POSITION"], len(accessors), "the positions of a mesh"))
    for accessor in seen:
        count = accessors[accessor].get("count")
        if isinstance(count, bool) or not isinstance(count, int) or count < 1:
            raise CharacterError(f"accessors[{accessor}] counts {quote(count)} vertices")
        total += count
    if total > MOST_VERTICES:
        raise CharacterError(f"it has {quote(total)} vertices, more than {MOST_VERTICES:,}, the limit")


def parents_of(nodes: Sequence[Mapping[str, Any]]) -> list[int]:
    """Return the parent of each node, -1 for roots. Raises `CharacterError` for two parents, and for a cycle."""
    parents = [-1] * len(nodes)
    for number, node in enumerate(nodes):
        children = node.get("children", [])
        if not isinstance(children, list):
            raise CharacterError(f"the children of nodes[{number}] are not a list")
        for child in children:
            child = index(child, len(nodes), f"a child of nodes[{number}]")
            if parents[child] >= 0 or child == number:
                raise CharacterError(f"nodes[{child}] has two parents or is its own: nodes must be trees")
            parents[child] = number
    rooted = [parent < 0 for parent in parents]
    for number in range(len(nodes)):
        line: list[int] = []
        while not rooted[number] and len(line) <= len(nodes):
            line.append(number)
            number = parents[number]
        if not rooted[number]:
            raise CharacterError("its nodes form a cycle")
        for each in line:
            rooted[each] = True
    return parents


def skin_joints(gltf: Gltf) -> list[list[int]]:
    """Return the joints of each skin. Raises `CharacterError` without a skin, and for a skin without joints."""
    skins, count = objects(gltf.document, "skins"), len(objects(gltf.document, "nodes"))
    if not skins:
        raise CharacterError("it has no skin: a mesh without bones cannot be animated; rig it first")
    found = []
    for number, skin in enumerate(skins):
        joints = skin.get("joints")
        if not isinstance(joints, list) or not joints:
            raise CharacterError(f"skins[{number}] has no joints, so that it has no bones")
        found.append([index(joint, count, f"a joint of skins[{number}]") for joint in joints])
        if len(set(found[-1])) != len(joints):
            raise CharacterError(f"skins[{number}] has a joint twice")
    total = len(set().union(*found))
    if total > MOST_JOINTS:
        raise CharacterError(f"its skins have {total:,} joints, more than {MOST_JOINTS:,}, the limit")
    return found


def with_animation(
    gltf: Gltf, chunks: Iterable[bytes], accessors: Sequence[Mapping[str, Any]], animation: Mapping[str, Any]
) -> Gltf:
    """Return the file with an additional animation, which comes first, because players show the first.

    The existing content keeps its bytes and its indices. The data of the animation follow it in the binary chunk.

    Args:
        gltf: The file.
        chunks: Binary data of the accessors; lengths are multiples of 4.
        accessors: One accessor per chunk, without a buffer view.
        animation: The animation; its accessors count from 0.
    """
    document = dict(gltf.document)
    views, buffers = list(objects(document, "bufferViews")), [dict(each) for each in objects(document, "buffers")]
    known = list(objects(document, "accessors"))
    first, content = len(known), b"".join(chunks)
    kept = (gltf.binary or b"")[: buffers[0]["byteLength"] if buffers else 0]
    kept += b"\0" * (-len(kept) % 4)
    start, binary = len(kept), kept + content
    buffers[:1] = [{**(buffers[0] if buffers else {}), "byteLength": len(binary)}]
    for accessor, length in zip(accessors, map(len, chunks), strict=True):
        known.append({"bufferView": len(views), **accessor})
        views.append({"buffer": 0, "byteOffset": start, "byteLength": length})
        start += length
    samplers = [
        {**each, "input": each["input"] + first, "output": each["output"] + first} for each in animation["samplers"]
    ]
    animations = [{**animation, "samplers": samplers}, *objects(document, "animations")]
    document |= {"accessors": known, "bufferViews": views, "buffers": buffers, "animations": animations}
    return Gltf(document, binary)


def animation_of(
    times: Float[np.ndarray, " frames"],
    targets: Sequence[tuple[int, str]],
    values: Sequence[Float[np.ndarray, "frames _"]],
    fps: float | int,
) -> tuple[list[bytes], list[dict[str, Any]], dict[str, Any]]:
    """Return the chunks, accessors and animation of some tracks, in the form of `with_animation`.

    Args:
        times: Time of each frame in seconds.
        targets: Node and property of each track.
        values: Values of each track.
        fps: Frame rate, which is stored as an extra.
    """
    times = times.astype("<f4")
    chunks = [times.tobytes()]
    accessors = [{"componentType": 5126, "count": len(times), "type": "SCALAR"}]
    accessors[0] |= {"min": [float(times[0])], "max": [float(times[-1])]}
    for each in values:
        chunks.append(np.ascontiguousarray(each.astype("<f4")).tobytes())
        accessors.append({"componentType": 5126, "count": len(each), "type": f"VEC{each.shape[1]}"})
    samplers = [{"input": 0, "output": track + 1, "interpolation": "LINEAR"} for track in range(len(values))]
    channels = [
        {"sampler": track, "target": {"node": node, "path": path}} for track, (node, path) in enumerate(targets)
    ]
    return chunks, accessors, {"name": "motion", "samplers": samplers, "channels": channels, "extras": {"fps": fps}}
