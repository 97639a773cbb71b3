"""What the cameras can see: triangles, smooth normals and colours of every body.

The laboratory's wood, patches, floor and walls are made from a seed. A texture is a picture laid
over a rectangle of a plane; features are several millimetres wide so that a camera half a metre
away sees them without aliasing.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from pathlib import Path

import numpy as np
import open3d
from jaxtyping import Float, Int, UInt32
from scipy.ndimage import gaussian_filter, zoom

from bridge.geometry import se3
from bridge.geometry.mesh import box_corners
from bridge.robots.default import FINGER_LINKS
from bridge.sources.standin.cell_file import Clutter
from bridge.sources.standin.clutter import CLUTTER
from bridge.sources.standin.deviations import Deviations, parts_of
from bridge.sources.standin.world import TABLE_CENTRE_M, TABLE_SIZE_M, LinkShape, true_links
from bridge.task.meshes.catalogue import ToyMesh, object_mesh, scaled_mesh
from bridge.task.meshes.toys import Paint
from bridge.task.task_file import Task

TABLE_RESOLUTION_M = 0.001
ROOM_RESOLUTION_M = 0.01


@dataclass(frozen=True, kw_only=True)
class Texture:
    """Colours (0..1, sRGB) over a rectangle that starts at ``origin_m``."""

    image: Float[np.ndarray, "rows columns 3"]
    origin_m: tuple[float, float]
    resolution_m: float

    def sample(
        self, points_m: Float[np.ndarray, "num_points 2"]
    ) -> Float[np.ndarray, "num_points 3"]:
        """Take the nearest cell; cells are finer than a camera's pixel. Outside: the edge."""
        rows, columns = self.image.shape[:2]
        origin = np.array(self.origin_m, dtype=np.float32)
        grid = ((points_m.astype(np.float32) - origin) / np.float32(self.resolution_m)).astype(
            np.int32
        )
        np.clip(grid, 0, np.array([columns - 1, rows - 1], dtype=np.int32), out=grid)
        index = grid[:, 1] * np.int32(columns) + grid[:, 0]
        return np.asarray(self.image.reshape(-1, 3).take(index, axis=0))


@lru_cache(maxsize=1)
def table_texture(size_m: tuple[float, float], centre_m: tuple[float, float], seed: int) -> Texture:
    """Wooden boards along y with grain, and patches of coloured tape and checkers."""
    rng = np.random.default_rng([7, seed])
    columns, rows = (round(extent / TABLE_RESOLUTION_M) for extent in size_m)
    wood = np.array([0.78, 0.63, 0.46])
    image = np.empty((rows, columns, 3))
    board = max(round(0.13 / TABLE_RESOLUTION_M), 1)
    for start in range(0, columns, board):
        width = min(board, columns - start)
        tint = wood * rng.uniform(0.86, 1.08) + rng.normal(0, 0.012, 3)
        grain = gaussian_filter(rng.normal(0, 1, (rows, width)), (44.0, 3.2))
        image[:, start : start + width] = tint + 1.8 * grain[..., None] * np.array([1.0, 0.9, 0.7])
        image[:, start : start + 2] *= 0.55
    origin = (centre_m[0] - size_m[0] / 2, centre_m[1] - size_m[1] / 2)
    _add_patches(image, origin, rng)
    image = gaussian_filter(np.clip(image, 0, 1), (0.9, 0.9, 0)).astype(np.float32)
    return Texture(image=image, origin_m=origin, resolution_m=TABLE_RESOLUTION_M)


PATCH_COLORS = (
    (0.93, 0.78, 0.16),
    (0.16, 0.50, 0.33),
    (0.92, 0.91, 0.88),
    (0.15, 0.17, 0.22),
    (0.45, 0.30, 0.58),
    (0.90, 0.52, 0.20),
)


def _add_patches(
    image: Float[np.ndarray, "rows columns 3"],
    origin_m: tuple[float, float],
    rng: np.random.Generator,
) -> None:
    """Tape rectangles, and 3 x 3 checkers like printed markers, on a loose grid."""
    rows, columns = image.shape[:2]
    cell = 0.15
    for x in np.arange(origin_m[0] + 0.05, origin_m[0] + columns * TABLE_RESOLUTION_M, cell):
        for y in np.arange(origin_m[1] + 0.05, origin_m[1] + rows * TABLE_RESOLUTION_M, cell):
            p = np.array([x, y]) + rng.uniform(0.0, 0.07, 2)
            size = rng.uniform(0.025, 0.06, 2)
            checker = rng.random() < 0.45
            if checker:
                size[:] = 0.042
            first, second = rng.choice(len(PATCH_COLORS), 2, replace=False)
            i, j = ((p - origin_m) / TABLE_RESOLUTION_M).astype(int)
            w, h = np.ceil(size / TABLE_RESOLUTION_M).astype(int)
            block = image[j : j + h, i : i + w]
            block[:] = PATCH_COLORS[first]
            if checker:
                squares = rng.random((3, 3)) < 0.5
                scale = -(-max(h, w) // 3)
                mask = np.kron(squares, np.ones((scale, scale), dtype=bool))
                block[mask[: block.shape[0], : block.shape[1]]] = PATCH_COLORS[second]


def lab_texture(
    size_m: tuple[float, float],
    origin_m: tuple[float, float],
    base: tuple[float, float, float],
    seed: int,
) -> Texture:
    """Floor or wall: large soft blotches and tile lines, low contrast."""
    rng = np.random.default_rng([8, seed])
    columns, rows = (round(extent / ROOM_RESOLUTION_M) for extent in size_m)
    coarse = rng.normal(0, 1, (rows // 12 + 2, columns // 12 + 2))
    blotch = zoom(coarse, 12, order=1)[:rows, :columns]
    image = np.array(base) * (1 + 0.09 * blotch[..., None])
    tile = round(0.5 / ROOM_RESOLUTION_M)
    image[::tile] *= 0.7
    image[:, ::tile] *= 0.7
    image = gaussian_filter(np.clip(image, 0, 1), (0.8, 0.8, 0)).astype(np.float32)
    return Texture(image=image, origin_m=origin_m, resolution_m=ROOM_RESOLUTION_M)


CREASE_COSINE = 0.8
"""Faces that meet at a sharper angle keep an edge."""
FLOOR_Z_M = -0.72
ROOM_MIN_M = (-1.3, -1.7)
ROOM_MAX_M = (2.0, 1.7)
ROOM_HEIGHT_M = 2.2


@dataclass(frozen=True, kw_only=True)
class Surface:
    """One coloured body; vertices are in the frame ``body``, which moves (``""``: the lab)."""

    body: str
    vertices_m: Float[np.ndarray, "num_vertices 3"]
    triangles: UInt32[np.ndarray, "num_triangles 3"]
    corner_normals: Float[np.ndarray, "num_triangles 3 3"]
    color: tuple[float, float, float]
    texture: Texture | None = None
    texture_axes: tuple[int, int] = (0, 1)
    """Which coordinates of the body lie along the texture's columns and rows."""
    paint: Paint | None = None
    """Colour by place in ``paint_vertices_m``; finer than the triangles."""
    paint_vertices_m: Float[np.ndarray, "num_vertices 3"] | None = None
    """The vertices at rest, in the frame the paint is given in."""
    soft: bool = False
    """Its vertices move on their own: a picture takes them from elsewhere."""


def box_surface(
    body: str,
    centre_m: Float[np.ndarray, "3"],
    size_m: Float[np.ndarray, "3"],
    color: tuple[float, float, float],
) -> Surface:
    """A box with hard edges, of a body that moves or ("") of the laboratory."""
    faces = np.array(
        [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    )
    triangles = np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]])
    return make_surface(body, box_corners(size_m) + centre_m, triangles, color)


def make_surface(
    body: str,
    vertices_m: Float[np.ndarray, "num_vertices 3"],
    triangles: Int[np.ndarray, "num_triangles 3"],
    color: tuple[float, float, float],
) -> Surface:
    """Attach normals that are smooth within a crease and broken across it."""
    a, b, c = (vertices_m[triangles[:, k]] for k in range(3))
    weighted = np.cross(b - a, c - a)
    length = np.linalg.norm(weighted, axis=1, keepdims=True)
    flat = weighted / np.maximum(length, 1e-12)
    corner = np.zeros((len(triangles), 3, 3))
    around: list[list[int]] = [[] for _ in range(len(vertices_m))]
    for index, triangle in enumerate(triangles):
        for vertex in triangle:
            around[vertex].append(index)
    for index, triangle in enumerate(triangles):
        for k, vertex in enumerate(triangle):
            near = np.array(around[vertex])
            smooth = near[flat[near] @ flat[index] > CREASE_COSINE]
            total = weighted[smooth].sum(axis=0) if len(smooth) else flat[index]
            corner[index, k] = total / max(float(np.linalg.norm(total)), 1e-12)
    return Surface(
        body=body,
        vertices_m=vertices_m.astype(np.float32),
        triangles=triangles.astype(np.uint32),
        corner_normals=corner.astype(np.float32),
        color=color,
    )


def robot_surfaces(deviations: Deviations | None = None) -> list[Surface]:
    """The arm in light grey with blue caps at its joints' housings; its gripper is dark."""
    surfaces = []
    for link in true_links(deviations):
        for shape in link.shapes:
            color = _LINK_COLORS.get(link.name, (0.72, 0.73, 0.75))
            if link.name in FINGER_LINKS:
                color = (0.20, 0.20, 0.22)
            surfaces.append(_shape_surface(link.name, shape, color))
    return surfaces


_LINK_COLORS = {
    "base_link": (0.45, 0.46, 0.48),
    "shoulder_link": (0.50, 0.62, 0.72),
    "wrist_1_link": (0.50, 0.62, 0.72),
    "wrist_3_link": (0.60, 0.61, 0.63),
    "gripper_base": (0.32, 0.33, 0.36),
}


@cache
def _shape_surface(body: str, shape: LinkShape, color: tuple[float, float, float]) -> Surface:
    if shape.box_m is not None:
        return box_surface(body, shape.T_link_shape[:3, 3], np.array(shape.box_m), color)
    mesh = open3d.io.read_triangle_mesh(Path(str(shape.mesh)))
    mesh.merge_close_vertices(1e-6)
    vertices = se3.apply(shape.T_link_shape, np.asarray(mesh.vertices))
    return make_surface(body, vertices, np.asarray(mesh.triangles).astype(np.int64), color)


def object_surfaces(task: Task, deviations: Deviations | None = None) -> list[Surface]:
    """The task's objects in their declared colours."""
    surfaces = []
    own = {} if deviations is None else deviations.objects
    for object_id, model in task.objects.items():
        if model.mesh is not None:
            surfaces.append(_mesh_surface(object_id, object_mesh(model), model.soft is not None))
            continue
        red, green, blue = (channel / 255 for channel in model.color_srgb)
        for part in parts_of(model, own.get(object_id)):
            surfaces.append(box_surface(object_id, part.centre_m, part.size_m, (red, green, blue)))
    return surfaces


def _mesh_surface(body: str, mesh: ToyMesh, soft: bool = False) -> Surface:
    """A closed mesh with smooth normals, painted."""
    vertices = mesh.vertices_m.astype(np.float32)
    return Surface(
        body=body,
        vertices_m=vertices,
        triangles=mesh.triangles.astype(np.uint32),
        corner_normals=smooth_normals(vertices, mesh.triangles),
        color=(0.5, 0.5, 0.5),
        paint=mesh.paint,
        paint_vertices_m=vertices,
        soft=soft,
    )


def smooth_normals(
    vertices_m: Float[np.ndarray, "num_vertices 3"], triangles: np.ndarray
) -> Float[np.ndarray, "num_triangles 3 3"]:
    """Normals at the corners of triangles, weighted by area, without creases."""
    a, b, c = (vertices_m[triangles[:, k]] for k in range(3))
    weighted = np.cross(b - a, c - a)
    ids, count = triangles.ravel(), len(vertices_m)
    sums = [np.bincount(ids, np.repeat(along, 3), minlength=count) for along in weighted.T]
    total = np.stack(sums, axis=1)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.asarray((total / np.maximum(length, 1e-12))[triangles], dtype=np.float32)


def clutter_surfaces(clutter: Sequence[Clutter]) -> list[Surface]:
    """What stands about on the table, as part of the laboratory."""
    surfaces = []
    for item in clutter:
        if item.shape == "box":
            red, green, blue = (channel / 255 for channel in item.color_srgb)
            surface = box_surface("", np.zeros(3), np.array(item.size_m), (red, green, blue))
        else:
            surface = _mesh_surface("", scaled_mesh(CLUTTER[item.shape], item.size_m))
        surfaces.append(_placed(surface, item.T_base_clutter))
    return surfaces


def _placed(surface: Surface, T_base_body: Float[np.ndarray, "4 4"]) -> Surface:
    """Bring a surface of the laboratory from its own frame to where it stands."""
    vertices = se3.apply(T_base_body, surface.vertices_m.astype(np.float64))
    normals = surface.corner_normals @ T_base_body[:3, :3].T
    return replace(
        surface, vertices_m=vertices.astype(np.float32), corner_normals=normals.astype(np.float32)
    )


def lab_surfaces(seed: int, deviations: Deviations | None = None) -> list[Surface]:
    """Table top with its texture, floor and four walls."""
    x, y, z = TABLE_SIZE_M
    texture = table_texture((x, y), TABLE_CENTRE_M, seed)
    top = box_surface(
        "", np.array([*TABLE_CENTRE_M, -z / 2]), np.array(TABLE_SIZE_M), (0.7, 0.56, 0.4)
    )
    table = replace(top, texture=texture)
    if deviations is not None:
        table = _placed(table, deviations.T_base_table)
    return [table, *_walls(seed)]


def _walls(seed: int) -> list[Surface]:
    (x0, y0), (x1, y1) = ROOM_MIN_M, ROOM_MAX_M
    z0, height = FLOOR_Z_M, ROOM_HEIGHT_M
    mid = (z0 + height) / 2
    walls = (
        (np.array([(x0 + x1) / 2, (y0 + y1) / 2, z0 - 0.01]), (x1 - x0, y1 - y0, 0.02), (0, 1)),
        (np.array([x0, (y0 + y1) / 2, mid]), (0.02, y1 - y0, height - z0), (1, 2)),
        (np.array([x1, (y0 + y1) / 2, mid]), (0.02, y1 - y0, height - z0), (1, 2)),
        (np.array([(x0 + x1) / 2, y0, mid]), (x1 - x0, 0.02, height - z0), (0, 2)),
        (np.array([(x0 + x1) / 2, y1, mid]), (x1 - x0, 0.02, height - z0), (0, 2)),
    )
    colors = ((0.50, 0.52, 0.53), *((0.78, 0.79, 0.76),) * 4)
    surfaces = []
    for index, ((centre, size, axes), color) in enumerate(zip(walls, colors, strict=True)):
        extents = np.array(size)
        corner = centre - extents / 2
        of_wall, origin = (size[axes[0]], size[axes[1]]), (corner[axes[0]], corner[axes[1]])
        texture = lab_texture(of_wall, origin, color, seed + index)
        surface = box_surface("", centre, extents, color)
        surfaces.append(replace(surface, texture=texture, texture_axes=axes))
    return surfaces
