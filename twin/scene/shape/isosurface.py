"""Marching cubes whose surface is closed by construction (after Lorensen and Cline 1987).

The table is derived, not typed. On each face of a cube, every run of inside corners is cut off
by one segment; two diagonal inside corners are always kept apart. Both cubes beside a face see the
same corners and so draw the same segments: nothing can gape. A loop of segments is cut into
triangles by diagonals that do not lie in a face of the cube, so that no diagonal can coincide with
one of the neighbour's: every edge belongs to exactly two triangles.
"""

from functools import cache

import numpy as np
from jaxtyping import Float, Float32, Int

from twin.scene.shape.mesh import Faces, Vertices

_CLEARANCE = 0.01
"""Vertices keep this share of a voxel from grid points: no triangle without area."""


def isosurface(
    values: Float32[np.ndarray, "num_x num_y num_z"],
    origin_m: Float[np.ndarray, "3"],
    voxel_m: float,
) -> tuple[Vertices, Faces]:
    """Triangles of the surface where values cross zero, facing the positive side [m].

    The surface is closed: what lies beyond the grid counts as outside.
    """
    padded = np.pad(values, 1, constant_values=max(voxel_m, float(np.abs(values).max())))
    inside = padded < 0
    vertex_ids, places = _vertices(padded, inside)
    faces = _faces(inside, vertex_ids)
    return origin_m + voxel_m * (places - 1.0), faces


def _vertices(
    values: np.ndarray, inside: np.ndarray
) -> tuple[Int[np.ndarray, "3 num_x num_y num_z"], Float[np.ndarray, "num_vertices 3"]]:
    """One vertex on each crossed grid edge, numbered by axis and the edge's lower end."""
    ids = np.full((3, *values.shape), -1, dtype=np.int32)
    places = []
    count = 0
    for axis in range(3):
        low = tuple(slice(None, -1) if a == axis else slice(None) for a in range(3))
        high = tuple(slice(1, None) if a == axis else slice(None) for a in range(3))
        index = np.argwhere(inside[low] != inside[high])
        before = values[low][tuple(index.T)].astype(np.float64)
        after = values[high][tuple(index.T)].astype(np.float64)
        place = index.astype(np.float64)
        place[:, axis] += np.clip(before / (before - after), _CLEARANCE, 1 - _CLEARANCE)
        ids[axis][tuple(index.T)] = np.arange(count, count + len(index))
        places.append(place)
        count += len(index)
    return ids, np.concatenate(places)


def _faces(inside: np.ndarray, vertex_ids: np.ndarray) -> Int[np.ndarray, "num_faces 3"]:
    corners = [
        inside[tuple(slice(1, None) if bit >> a & 1 else slice(None, -1) for a in range(3))]
        for bit in range(8)
    ]
    case = np.zeros(corners[0].shape, dtype=np.uint8)
    for bit, corner in enumerate(corners):
        case |= corner.astype(np.uint8) << bit
    cells = np.argwhere((case > 0) & (case < 255))
    triangles, counts = _table()
    cases = case[tuple(cells.T)]
    wanted = np.arange(triangles.shape[1]) < counts[cases][:, None]
    edges = triangles[cases][wanted]
    cell = np.repeat(cells, counts[cases], axis=0)[:, None, :]
    axis = edges // 4
    place = cell + _LOWER[edges]
    return np.asarray(vertex_ids[axis, place[..., 0], place[..., 1], place[..., 2]])


# Corner number = x + 2 y + 4 z. Edge number = 4 axis + which of the four edges along that axis.
_EDGES = tuple(
    (corner, corner | 1 << axis)
    for axis in range(3)
    for corner in range(8)
    if not corner >> axis & 1
)
_LOWER = np.array([[low >> a & 1 for a in range(3)] for low, _ in _EDGES])
_EDGE_ID = {frozenset(ends): number for number, ends in enumerate(_EDGES)}


def _cube_faces() -> list[tuple[int, int, int, int]]:
    """Corners of the six faces, counter-clockwise seen from outside."""
    faces = []
    for axis in range(3):
        b, c = 1 << (axis + 1) % 3, 1 << (axis + 2) % 3
        a = 1 << axis
        faces += [(0, c, b | c, b), (a, a | b, a | b | c, a | c)]
    return faces


_FACES_OF_EDGE = tuple(
    frozenset(k for k, face in enumerate(_cube_faces()) if set(ends) <= set(face))
    for ends in _EDGES
)


def _loops(case: int) -> list[list[int]]:
    """Closed chains of crossed edges around the inside corners of one case."""
    following: dict[int, int] = {}
    for face in _cube_faces():
        flags = [bool(case >> corner & 1) for corner in face]
        for start in range(4):
            if flags[start - 1] or not flags[start]:
                continue
            stop = start
            while flags[(stop + 1) % 4]:
                stop += 1
            entry = _EDGE_ID[frozenset((face[start - 1], face[start]))]
            leave = _EDGE_ID[frozenset((face[stop % 4], face[(stop + 1) % 4]))]
            following[entry] = leave
    loops = []
    while following:
        first, edge = following.popitem()
        loop = [first]
        while edge != first:
            loop.append(edge)
            edge = following.pop(edge)
        loops.append(loop)
    return loops


def _cut(loop: list[int]) -> list[tuple[int, int, int]] | None:
    """Triangles of a polygon without a diagonal in a face of the cube, None if impossible."""
    if len(loop) == 2:
        return []
    for apex in range(1, len(loop) - 1):
        sides = [(loop[0], loop[apex])] if apex > 1 else []
        sides += [(loop[apex], loop[-1])] if apex < len(loop) - 2 else []
        if any(_FACES_OF_EDGE[a] & _FACES_OF_EDGE[b] for a, b in sides):
            continue
        before, after = _cut(loop[: apex + 1]), _cut(loop[apex:])
        if before is not None and after is not None:
            return [(loop[0], loop[apex], loop[-1]), *before, *after]
    return None


@cache
def _table() -> tuple[Int[np.ndarray, "256 num_most 3"], Int[np.ndarray, " 256"]]:
    """Triangles of every case as edge numbers, padded, and how many there are."""
    cases: list[list[tuple[int, int, int]]] = []
    for case in range(256):
        triangles: list[tuple[int, int, int]] = []
        for loop in _loops(case):
            cut = _cut(loop)
            if cut is None:
                message = f"marching cubes: case {case} cannot be cut without touching a face"
                raise RuntimeError(message)
            triangles += cut
        cases.append(triangles)
    counts = np.array([len(triangles) for triangles in cases])
    table = np.zeros((256, int(counts.max()), 3), dtype=np.int64)
    for case, triangles in enumerate(cases):
        if triangles:
            table[case, : len(triangles)] = triangles
    return table, counts
