"""The container of a `.glb` file (glTF 2.0, 4.4): a header, a chunk of JSON and a chunk of bytes.

Independent of what the document describes.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from typing import Any

JSON, BIN = 0x4E4F534A, 0x004E4942
"""Types of the two chunks."""


def pack_glb(document: Mapping[str, Any], binary: bytes | None) -> bytes:
    """Return the bytes of a `.glb` file.

    Raises `ValueError` for a number in the document that is not finite, which JSON cannot represent.
    """
    text = json.dumps(document, ensure_ascii=False, separators=(",", ":"), allow_nan=False).encode()
    content = _chunk(JSON, text, b" ")
    if binary is not None:
        content += _chunk(BIN, binary, b"\0")
    return struct.pack("<4sII", b"glTF", 2, 12 + len(content)) + content


def _chunk(kind: int, data: bytes, filler: bytes) -> bytes:
    data += filler * (-len(data) % 4)
    return struct.pack("<II", len(data), kind) + data
