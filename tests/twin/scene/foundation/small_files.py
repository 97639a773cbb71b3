"""Write the smallest files of the formats under test, from their specifications."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np


def write_safetensors(path: Path, tensors: dict[str, np.ndarray]) -> None:
    """8 bytes of length, a JSON header, the numbers."""
    header, body = {}, b""
    for name, values in tensors.items():
        data = values.astype("<f4").tobytes()
        ends = [len(body), len(body) + len(data)]
        header[name] = {"dtype": "F32", "shape": list(values.shape), "data_offsets": ends}
        body += data
    text = json.dumps(header).encode()
    path.write_bytes(struct.pack("<Q", len(text)) + text + body)


def glb_bytes(content: dict[str, Any], binary: bytes) -> bytes:
    """A container of one JSON and one binary chunk, both padded to four bytes."""
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
    chunks += struct.pack("<II", len(binary), 0x004E4942) + binary
    return struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks


def mesh_content(
    vertices: np.ndarray,
    faces: np.ndarray,
    colors_u8: np.ndarray | None = None,
    node: dict[str, Any] | None = None,
) -> tuple[dict[str, Any], bytes]:
    """JSON and data of one mesh in one node."""
    parts = [vertices.astype("<f4").tobytes(), faces.astype("<u4").tobytes()]
    accessors = [
        {"bufferView": 0, "componentType": 5126, "count": len(vertices), "type": "VEC3"},
        {"bufferView": 1, "componentType": 5125, "count": faces.size, "type": "SCALAR"},
    ]
    attributes = {"POSITION": 0}
    if colors_u8 is not None:
        parts.append(colors_u8.astype("u1").tobytes())
        attributes["COLOR_0"] = 2
        kind = {"componentType": 5121, "type": f"VEC{colors_u8.shape[1]}", "normalized": True}
        accessors.append({"bufferView": 2, "count": len(vertices), **kind})
    views, start = [], 0
    for part in parts:
        views.append({"buffer": 0, "byteOffset": start, "byteLength": len(part)})
        start += len(part)
    content = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, **(node or {})}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 1}]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": start}],
    }
    return content, b"".join(parts)
