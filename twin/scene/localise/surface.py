"""The surface of a mesh as points, and what cameras see of it."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Bool, Float, Int

from bridge.geometry import se3
from bridge.task.meshes.catalogue import object_mesh
from bridge.task.task_file import ObjectModel
from twin.scene.localise.points import View

FACING = 0.15
"""Cosine below which a camera hardly sees a surface."""


@dataclass(frozen=True, kw_only=True)
class Surface:
    """Points spread evenly over a mesh, in the object frame."""

    p_m: Float[np.ndarray, "num_samples 3"]
    normals: Float[np.ndarray, "num_samples 3"]


def surface_of(
    vertices_m: Float[np.ndarray, "num_vertices 3"],
    triangles: Int[np.ndarray, "num_faces 3"],
    num_samples: int,
) -> Surface:
    """Spread points over a mesh, each triangle by its area; the same each time.

    Args:
        vertices_m: Of the known or a reconstructed mesh, in the object frame.
        triangles: Counter-clockwise seen from outside.
        num_samples: How many.
    """
    a, b, c = (vertices_m[triangles[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    double_area = np.linalg.norm(cross, axis=1)
    edges = np.cumsum(double_area) / double_area.sum()
    chosen = np.searchsorted(edges, (np.arange(num_samples) + 0.5) / num_samples)
    u, v = np.random.default_rng(0).random((2, num_samples, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    p = a[chosen] * (1 - u - v) + b[chosen] * u + c[chosen] * v
    return Surface(p_m=p, normals=cross[chosen] / double_area[chosen, None])


@cache
def known_surface(model: ObjectModel, num_samples: int) -> Surface:
    """Surface of the mesh that the task file names."""
    mesh = object_mesh(model)
    return surface_of(mesh.vertices_m, mesh.triangles, num_samples)


def facing(
    T_object_base: Float[np.ndarray, "4 4"], view: View, surface: Surface
) -> Bool[np.ndarray, " num_samples"]:
    """Tell which samples turn their outside to a view's camera."""
    ray = se3.apply(T_object_base, view.T_base_depth[None, :3, 3])[0] - surface.p_m
    along = np.einsum("ij,ij->i", ray, surface.normals)
    return np.asarray(along > FACING * lengths(ray))


def lengths(rows: Float[np.ndarray, "num_rows 3"]) -> Float[np.ndarray, " num_rows"]:
    """Norms; five times as fast as a sum along so short an axis, and the same bits."""
    square = rows * rows
    return np.asarray(np.sqrt(square[:, 0] + square[:, 1] + square[:, 2]))


def seen_through(
    T: Float[np.ndarray, "4 4"], surface: Surface, views: Sequence[View], margin_m: float
) -> float:
    """Share of the mesh's facing surface behind which cameras measured something.

    Args:
        T: ``T_base_object``.
        surface: The mesh.
        views: With their depth.
        margin_m: How far behind.
    """
    T_object_base = se3.invert(T)
    looked = [_looked_at(T, T_object_base, surface, view) for view in views]
    through = sum(int((measured > z + margin_m).sum()) for measured, z in looked)
    return _share(through, sum(int((measured > 0).sum()) for measured, _ in looked))


def agreeing(
    T: Float[np.ndarray, "4 4"], surface: Surface, views: Sequence[View], margin_m: float
) -> float:
    """Share of the mesh's facing surface that the camera which sees most of it measured there.

    Args:
        T: ``T_base_object``.
        surface: The mesh.
        views: With their depth.
        margin_m: How far off a measurement may be.
    """
    T_object_base = se3.invert(T)
    share = 0.0
    for view in views:
        measured, z = _looked_at(T, T_object_base, surface, view)
        looked = int((measured > 0).sum())
        # Behind the nearer bound, but not behind the farther one.
        near, far = (int((measured > z + bound).sum()) for bound in (-margin_m, margin_m))
        share = max(share, _share(near, looked) - _share(far, looked))
    return share


def _looked_at(
    T: Float[np.ndarray, "4 4"],
    T_object_base: Float[np.ndarray, "4 4"],
    surface: Surface,
    view: View,
) -> tuple[Float[np.ndarray, " num_seen"], Float[np.ndarray, " num_seen"]]:
    """Depth that a camera measured (0: none) and has, where it looks at the facing surface [m]."""
    p = se3.apply(T, surface.p_m[facing(T_object_base, view, surface)])
    p = se3.apply(se3.invert(view.T_base_depth), p)
    p = p[p[:, 2] > 0.05]
    uv, _ = view.depth_camera.project(p)
    size = (view.depth_camera.width, view.depth_camera.height)
    inside = np.all((uv >= 0) & (uv < size), axis=1)
    column, row = uv[inside].astype(np.int64).T
    return view.depth_m[row, column], p[inside, 2]


def _share(part: int, whole: int) -> float:
    return part / whole if whole else 0.0
