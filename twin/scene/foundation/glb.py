"""Read the triangles of a binary glTF 2.0 file: positions, faces, vertex colours; nothing else.

Every offset comes from the file and is checked; nothing outside the file is opened.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Int

from twin.errors import UnreadableFileError

MAX_BYTES = 1 << 30
MAX_JSON_BYTES = 64_000_000
MAX_VERTICES = 20_000_000
_MAGIC, _JSON, _BIN = 0x46546C67, 0x4E4F534A, 0x004E4942
_TRIANGLES = 4
_TYPES: dict[int, np.dtype[Any]] = {
    5120: np.dtype("i1"),
    5121: np.dtype("u1"),
    5122: np.dtype("<i2"),
    5123: np.dtype("<u2"),
    5125: np.dtype("<u4"),
    5126: np.dtype("<f4"),
}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


class UnreadableGlbError(UnreadableFileError):
    """The file is no binary glTF that we read."""

    hint = (
        "Expected a whole binary glTF 2.0 (.glb) with triangles, without compression and without "
        "files beside it."
    )


@dataclass(frozen=True, kw_only=True)
class TriangleMesh:
    """Triangles in the axes and units of their file."""

    vertices: Float[np.ndarray, "num_vertices 3"]
    faces: Int[np.ndarray, "num_faces 3"]
    colors: Float32[np.ndarray, "num_vertices 3"] | None
    """0..1 as stored, None where some part has none."""


class _Glb:
    """A parsed file: its JSON and its binary chunk."""

    def __init__(self, path: Path, data: bytes) -> None:
        """Take the chunks apart."""
        self.path = path
        words = np.frombuffer(data[:12], dtype="<u4")
        if len(words) < 3 or words[0] != _MAGIC or words[1] != 2 or words[2] != len(data):
            raise self.error("no glTF 2.0 header, or cut short")
        self.content: dict[str, Any] = {}
        self.binary = b""
        place = 12
        while place + 8 <= len(data):
            length, kind = (int(v) for v in np.frombuffer(data[place : place + 8], dtype="<u4"))
            body = data[place + 8 : place + 8 + length]
            if len(body) != length:
                raise self.error("a chunk is cut short")
            if kind == _JSON and not self.content:
                self.content = self._parse(body)
            elif kind == _BIN and not self.binary:
                self.binary = body
            place += 8 + length
        strange = [
            name
            for name in self.content.get("extensionsRequired", [])
            if not str(name).startswith("KHR_materials")
        ]
        if strange:
            raise self.error(f"it needs {strange[0]}")

    def error(self, found: str) -> UnreadableGlbError:
        """An error about this file."""
        return UnreadableGlbError(path=self.path, found=found)

    def _parse(self, body: bytes) -> dict[str, Any]:
        if len(body) > MAX_JSON_BYTES:
            raise self.error("its JSON is too large")
        try:
            content = json.loads(body)
        except (ValueError, RecursionError) as error:
            raise self.error("its JSON is broken") from error
        if not isinstance(content, dict):
            raise self.error("its JSON is not an object")
        return content

    def item(self, kind: str, index: Any) -> dict[str, Any]:
        """One entry of a list of the JSON."""
        rows = self.content.get(kind, [])
        if not isinstance(index, int) or not isinstance(rows, list) or not 0 <= index < len(rows):
            raise self.error(f"there is no entry {index!r} in {kind}")
        row = rows[index]
        if not isinstance(row, dict):
            raise self.error(f"entry {index} of {kind} is not an object")
        return row

    def accessor(self, index: Any) -> np.ndarray:
        """The rows of an accessor, (count, width) as stored or scaled to 0..1."""
        about = self.item("accessors", index)
        dtype = _TYPES.get(about.get("componentType", 0))
        width = _WIDTHS.get(about.get("type", ""), 0)
        count = about.get("count", 0)
        if dtype is None or not width or not isinstance(count, int) or "sparse" in about:
            raise self.error(f"accessor {index} is of a kind we do not read")
        if not 0 <= count <= MAX_VERTICES:
            raise self.error(f"accessor {index} claims {count} rows")
        view = self.item("bufferViews", about.get("bufferView"))
        if view.get("buffer", 0) != 0 or "uri" in self.item("buffers", 0):
            raise self.error("its data lies in another file")
        start = view.get("byteOffset", 0)
        offset = about.get("byteOffset", 0)
        if count == 0:
            return np.zeros((0, width), dtype)
        row_bytes = width * dtype.itemsize
        stride = view.get("byteStride", row_bytes)
        end = view.get("byteLength", 0)
        numbers = (start, offset, stride, end)
        if not all(isinstance(v, int) and 0 <= v <= MAX_BYTES for v in numbers):
            raise self.error(f"accessor {index} has impossible offsets")
        needed = offset + stride * (count - 1) + row_bytes
        if stride < row_bytes or needed > end or start + end > len(self.binary):
            raise self.error(f"accessor {index} reaches past the end of the data")
        table = np.ndarray(
            (count, width), dtype, self.binary, start + offset, (stride, dtype.itemsize)
        )
        if about.get("normalized"):
            return np.asarray(table.astype(np.float32) / float(np.iinfo(dtype).max))
        return table


def read_glb(path: Path) -> TriangleMesh:
    """Read all triangles of the file's scene, each node's transform applied.

    Source: the glTF 2.0 specification (Khronos), sections 3.5, 3.6 and 4.4.

    Raises:
        UnreadableGlbError: When it is no such file, broken, or without triangles.
    """
    size = path.stat().st_size if path.is_file() else -1
    if not 0 < size <= MAX_BYTES:
        raise UnreadableGlbError(path=path, found="missing, empty or too large")
    try:
        pieces = _pieces(_Glb(path, path.read_bytes()))
    except (TypeError, AttributeError, ValueError, OverflowError) as error:
        found = f"its structure is broken ({type(error).__name__})"
        raise UnreadableGlbError(path=path, found=found) from error
    if not pieces:
        raise UnreadableGlbError(path=path, found="it holds no triangles")
    vertices = np.concatenate([piece.vertices for piece in pieces])
    starts = np.cumsum([0, *(len(piece.vertices) for piece in pieces[:-1])])
    faces = np.concatenate([p.faces + start for p, start in zip(pieces, starts, strict=True)])
    colors = [piece.colors for piece in pieces if piece.colors is not None]
    if not np.isfinite(vertices).all():
        raise UnreadableGlbError(path=path, found="it holds positions that are not finite")
    return TriangleMesh(
        vertices=vertices,
        faces=faces,
        colors=np.concatenate(colors) if len(colors) == len(pieces) else None,
    )


def _pieces(glb: _Glb) -> list[TriangleMesh]:
    """Primitives of all nodes of the scene; a node has one parent at most (section 3.5.2)."""
    pieces: list[TriangleMesh] = []
    scene = glb.item("scenes", glb.content.get("scene", 0))
    waiting = [(root, np.eye(4)) for root in scene.get("nodes", [])]
    seen: set[int] = set()
    while waiting:
        index, T_scene_parent = waiting.pop(0)
        node = glb.item("nodes", index)
        if index in seen:
            raise glb.error(f"node {index} occurs twice")
        seen.add(index)
        T_scene_node = T_scene_parent @ _local(glb, node)
        if "mesh" in node:
            for primitive in glb.item("meshes", node["mesh"]).get("primitives", []):
                piece = _primitive(glb, primitive)
                moved = piece.vertices @ T_scene_node[:3, :3].T + T_scene_node[:3, 3]
                pieces.append(TriangleMesh(vertices=moved, faces=piece.faces, colors=piece.colors))
        waiting += [(child, T_scene_node) for child in node.get("children", [])]
    return pieces


def _local(glb: _Glb, node: dict[str, Any]) -> np.ndarray:
    """A node's matrix: stored by columns, or as translation, rotation (xyzw) and scale."""
    try:
        if "matrix" in node:
            return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
        x, y, z, w = (float(v) for v in node.get("rotation", (0, 0, 0, 1)))
        T = np.eye(4)
        T[:3, :3] = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        ) @ np.diag(np.array(node.get("scale", (1, 1, 1)), dtype=np.float64))
        T[:3, 3] = np.array(node.get("translation", (0, 0, 0)), dtype=np.float64)
    except (ValueError, TypeError) as error:
        raise glb.error("a node has a broken transform") from error
    return T


def _primitive(glb: _Glb, primitive: Any) -> TriangleMesh:
    if not isinstance(primitive, dict) or primitive.get("mode", _TRIANGLES) != _TRIANGLES:
        raise glb.error("it holds lines, points or strips")
    attributes = primitive.get("attributes", {})
    vertices = glb.accessor(attributes.get("POSITION"))
    if vertices.shape[1] != 3 or vertices.dtype.kind != "f":
        raise glb.error("positions are not three floats")
    if "indices" in primitive:
        indices = glb.accessor(primitive["indices"])[:, 0]
    else:
        indices = np.arange(len(vertices))
    if indices.dtype.kind not in "ui" or len(indices) % 3 or len(indices) == 0:
        raise glb.error("faces are not whole triangles")
    if int(indices.max()) >= len(vertices):
        raise glb.error("a face names a vertex that is not there")
    colors = None
    if "COLOR_0" in attributes:
        table = glb.accessor(attributes["COLOR_0"])
        if len(table) != len(vertices) or table.shape[1] < 3:
            raise glb.error("colours do not fit the vertices")
        scale = 1.0 if table.dtype.kind == "f" else 1.0 / float(np.iinfo(table.dtype).max)
        colors = np.clip(table[:, :3].astype(np.float32) * np.float32(scale), 0.0, 1.0)
    return TriangleMesh(
        vertices=vertices.astype(np.float64),
        faces=indices.astype(np.int64).reshape(-1, 3),
        colors=colors,
    )
