"""Triangle meshes: are they closed, how much do they hold, and how are they written."""

import numpy as np
from jaxtyping import Float, Int

Vertices = Float[np.ndarray, "num_vertices 3"]
Faces = Int[np.ndarray, "num_faces 3"]


def is_watertight(faces: Faces) -> bool:
    """Say whether a mesh is closed: every edge once in each direction, no face degenerate.

    That is: each edge belongs to exactly two faces, and they are oriented alike.
    """
    if len(faces) == 0:
        return False
    start = faces.astype(np.int64).ravel()
    end = np.roll(faces, -1, axis=1).astype(np.int64).ravel()
    if np.any(start == end):
        return False
    base = int(faces.max()) + 1
    there, back = np.sort(start * base + end), np.sort(end * base + start)
    return bool(np.all(np.diff(there) > 0) and np.array_equal(there, back))


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
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(vertices_m)}",
        *(f"property float {axis}" for axis in "xyz"),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header",
        "",
    ]
    rows = np.zeros(len(faces), dtype=[("count", "u1"), ("ids", "<i4", 3)])
    rows["count"], rows["ids"] = 3, faces
    return "\n".join(header).encode() + vertices_m.astype("<f4").tobytes() + rows.tobytes()


def mesh_obj(vertices_m: Vertices, faces: Faces) -> bytes:
    """Return a Wavefront OBJ file [m], the form PyBullet and coal both read."""
    lines = [f"v {x:.7g} {y:.7g} {z:.7g}" for x, y, z in vertices_m.tolist()]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces.tolist()]
    return ("\n".join(lines) + "\n").encode()
