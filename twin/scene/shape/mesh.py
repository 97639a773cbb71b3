"""Triangle meshes: are they closed, how much do they hold, how are they written and read."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, Int

from bridge.errors import PathNotFoundError
from bridge.geometry import se3
from twin.errors import UnreadableFileError
from twin.robot.surface import ray_scene, tensor

Vertices = Float[np.ndarray, "num_vertices 3"]
Faces = Int[np.ndarray, "num_faces 3"]
Mesh = tuple[np.ndarray, np.ndarray]
"""Vertices [m] and triangles."""


MAX_BYTES = 500_000_000
"""Larger files are refused."""
_FACE = np.dtype([("count", "u1"), ("ids", "<i4", 3)])


class UnreadableMeshError(UnreadableFileError):
    """The file is no triangle mesh of the kind we write."""

    hint = (
        "Expected a binary little-endian PLY with float x, y, z and triangles. "
        "Make it again: robot-gst rebuild RUN --force."
    )


def volume_m3(vertices_m: Vertices, faces: Faces) -> float:
    """Volume of a closed mesh by the divergence theorem; negative when faces look inwards."""
    a, b, c = (vertices_m[faces[:, k]] for k in range(3))
    return float(np.einsum("ni,ni->n", a, np.cross(b, c)).sum() / 6)


def face_normals(
    vertices_m: Vertices, faces: Faces
) -> tuple[Float[np.ndarray, "num_faces 3"], Float[np.ndarray, " num_faces"]]:
    """Unit normals (zero for a face without area) and areas [m^2]."""
    a, b, c = (vertices_m[faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1)
    return normals / np.maximum(length, 1e-300)[:, None], length / 2


def mesh_ply(vertices_m: Vertices, faces: Faces) -> bytes:
    """Return a binary PLY file [m]."""
    rows = np.zeros(len(faces), dtype=_FACE)
    rows["count"], rows["ids"] = 3, faces
    header = "\n".join([*_header(len(vertices_m), len(faces)), "end_header", ""])
    return header.encode() + vertices_m.astype("<f4").tobytes() + rows.tobytes()


def _header(num_vertices: int, num_faces: int) -> list[str]:
    return [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {num_vertices}",
        *(f"property float {axis}" for axis in "xyz"),
        f"element face {num_faces}",
        "property list uchar int vertex_indices",
    ]


def read_mesh(path: Path) -> tuple[Vertices, Faces]:
    """Read a mesh that ``mesh_ply`` wrote: vertices [m] and faces."""
    if not path.is_file():
        hint = "robot-gst rebuild RUN makes it."
        raise PathNotFoundError(path=path, what="mesh", hint=hint)
    if path.stat().st_size > MAX_BYTES:
        raise UnreadableMeshError(path=path, found=f"more than {MAX_BYTES} bytes")
    head, mark, body = path.read_bytes().partition(b"end_header\n")
    lines = head.decode("ascii", "replace").splitlines()
    counts = [line.split()[-1] for line in lines if line.startswith("element ")]
    if not mark or len(counts) != 2 or not all(count.isdigit() for count in counts):
        raise UnreadableMeshError(path=path, found="no usable PLY header")
    num_vertices, num_faces = (int(count) for count in counts)
    if lines != _header(num_vertices, num_faces):
        raise UnreadableMeshError(path=path, found="another header than ours")
    if len(body) != 12 * num_vertices + _FACE.itemsize * num_faces:
        found = f"{len(body)} bytes for {num_vertices} vertices and {num_faces} faces"
        raise UnreadableMeshError(path=path, found=found)
    vertices = np.frombuffer(body, dtype="<f4", count=3 * num_vertices).reshape(-1, 3)
    rows = np.frombuffer(body, dtype=_FACE, offset=12 * num_vertices)
    faces = rows["ids"].astype(np.int64)
    if not np.isfinite(vertices).all() or np.any(rows["count"] != 3):
        raise UnreadableMeshError(path=path, found="vertices that are not finite, or no triangles")
    if num_faces and (faces.min() < 0 or faces.max() >= num_vertices):
        raise UnreadableMeshError(path=path, found="faces of vertices that do not exist")
    return vertices.astype(np.float64), faces


def first_hit(
    rays: Float[np.ndarray, "height width 3"],
    T_base_camera: Float[np.ndarray, "4 4"],
    meshes: Mapping[str, Mesh],
    Ts_base_object: Mapping[str, Float[np.ndarray, "4 4"]],
) -> tuple[Float32[np.ndarray, "height width"], Float32[np.ndarray, "height width 3"]]:
    """Where rays of a camera meet the first mesh: depth, infinite beside them, and normal."""
    scene = ray_scene(
        (se3.apply(se3.invert(T_base_camera) @ Ts_base_object[name], vertices_m), triangles)
        for name, (vertices_m, triangles) in meshes.items()
        if name in Ts_base_object and len(triangles)
    )
    from_camera = np.concatenate([np.zeros_like(rays), rays], axis=-1).astype(np.float32)
    found = scene.cast_rays(tensor(from_camera))
    return found["t_hit"].numpy(), found["primitive_normals"].numpy()
