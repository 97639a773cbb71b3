"""Lines on which two pads can press an object: antipodal pairs of its surface.

A pad that presses along a line holds while the line stays within the friction cone of both surfaces
(Nguyen 1988). Rays through the mesh find the pairs: from a point of the surface into the material,
to where it is left again. Surfaces that were scanned are rough at the size of their voxels, which a
pad bridges, so their normals are averaged over about a pad's contact.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import open3d
from scipy import sparse

from bridge.geometry.mesh import sample_triangles
from twin.plan.problem import Flags, Ids, Numbers, Points, Shape, Vector
from twin.scene.shape.mesh import face_normals

_INSIDE_M = 1e-5
"""A ray starts so far behind the surface, so that it does not meet the point it starts from."""
_CONTACT_M = 0.004
"""Radius over which normals of a scanned surface are averaged."""
_MOST_ROUNDS = 40
_LEAST_M = 0.004
"""Thinner things are not taken between two pads: the mesh is not that exact."""


_tensor: Any = open3d.core.Tensor  # its stubs leave out that an array alone is enough


class SampledSurface:
    """One object's surface, asked by rays; made once per shape, and only what is asked of it."""

    def __init__(self, shape: Shape) -> None:
        """Keep the shape."""
        self.shape = shape

    @cached_property
    def _rays(self) -> Any:
        make: Any = open3d.t.geometry.RaycastingScene  # its stubs leave out the defaults
        rays, shape = make(nthreads=1), self.shape
        rays.add_triangles(
            _tensor(shape.vertices_m.astype("f4")), _tensor(shape.triangles.astype("u4"))
        )
        return rays

    @cached_property
    def _facets(self) -> tuple[Points, Numbers]:
        return face_normals(self.shape.vertices_m, self.shape.triangles)

    @cached_property
    def normals(self) -> Points:
        """Normals of the triangles as a pad feels them."""
        normals, areas = self._facets
        if self.shape.error_m <= 0:
            return normals
        vertices, triangles = self.shape.vertices_m, self.shape.triangles
        num, faces = len(vertices), np.arange(len(triangles))
        ones = np.ones(3 * len(triangles))
        of_face = sparse.csr_matrix(
            (ones, (triangles.ravel(), np.repeat(faces, 3))), shape=(num, len(triangles))
        )
        edges = np.linalg.norm(vertices[triangles[:, 0]] - vertices[triangles[:, 1]], axis=1)
        step_m = max(float(np.median(edges)), _LEAST_M / _MOST_ROUNDS)
        rounds = int(np.clip(round((_CONTACT_M / step_m) ** 2), 1, _MOST_ROUNDS))
        found = normals * areas[:, None]
        for _ in range(rounds):
            at_vertices = of_face @ found
            found = (of_face.T @ at_vertices) / 3
            found *= (areas / np.maximum(np.linalg.norm(found, axis=1), 1e-12))[:, None]
        return np.asarray(found / np.maximum(np.linalg.norm(found, axis=1), 1e-12)[:, None])

    def points(self, count: int, seed: int) -> tuple[Points, Ids]:
        """Points spread evenly over the surface, and their triangles."""
        shape, rng = self.shape, np.random.default_rng(seed)
        chosen, u, v = sample_triangles(self._facets[1], count, rng, in_order=True)
        a, b, c = (shape.vertices_m[shape.triangles[chosen, k]] for k in range(3))
        return a * (1 - u - v) + b * u + c * v, chosen

    def leave(self, points_m: Points, directions: Points) -> tuple[Numbers, Points]:
        """Where rays meet the surface next: how far (infinite: nowhere), and the normal there."""
        rays = np.concatenate([points_m, directions], axis=1).astype("f4")
        found = self._rays.cast_rays(_tensor(rays), nthreads=1)
        away = found["t_hit"].numpy().astype(np.float64)
        ids = found["primitive_ids"].numpy().astype(np.int64)
        hit = np.isfinite(away)
        return away, np.where(hit[:, None], self.normals[np.where(hit, ids, 0)], 0.0)


@dataclass(frozen=True, kw_only=True)
class Pairs:
    """Lines between two points of a surface, object frame."""

    first_m: Points
    axes: Points
    """Unit vectors from the first to the second point."""
    widths_m: Numbers
    cosines: Numbers
    """Of the larger angle between the line and the two normals."""
    lowest_m: Numbers
    downward: Numbers
    """How far the normal that looks down more does so: the sine under the horizontal."""

    @property
    def middles_m(self) -> Points:
        """Half way between the two points."""
        return np.asarray(self.first_m + self.axes * self.widths_m[:, None] / 2)

    def chosen(self, which: Flags | Ids) -> "Pairs":
        """Some of them."""
        return Pairs(**{name: value[which] for name, value in vars(self).items()})


def antipodal_pairs(
    surface: SampledSurface,
    *,
    count: int,
    cone_rad: float,
    hint_m: tuple[float, float, float] | None,
    seed: int,
) -> Pairs:
    """Cast rays into an object from all over its surface, within the cone where they start.

    From each point three: along the normal, along the normal laid level, and one drawn from the
    cone; and a line along the object's y axis through the hint. Which pairs hold, and which are too
    wide, is for the caller to say.
    """
    points, triangles = surface.points(count, seed)
    normals = surface.normals[triangles]
    rng = np.random.default_rng([seed, 1])
    level = normals * [1.0, 1.0, 0.0]
    length = np.linalg.norm(level, axis=1)
    steep = length < np.cos(cone_rad)
    level = np.where(steep[:, None], normals, level / np.maximum(length, 1e-9)[:, None])
    across = np.cross(normals, rng.normal(size=normals.shape))
    across /= np.maximum(np.linalg.norm(across, axis=1), 1e-9)[:, None]
    tilt = cone_rad * np.sqrt(rng.uniform(size=(len(normals), 1)))
    drawn = np.cos(tilt) * normals + np.sin(tilt) * across
    starts = np.concatenate([points, points[~steep], points])
    outward = np.concatenate([normals, level[~steep], drawn])
    starting = np.concatenate([normals, normals[~steep], normals])
    if hint_m is not None:
        p, n, facing = _hinted(surface, np.array(hint_m))
        starts, outward = np.concatenate([p, starts]), np.concatenate([n, outward])
        starting = np.concatenate([facing, starting])
    return pairs_along(surface, starts, starting, -outward)


def _hinted(surface: SampledSurface, hint_m: Vector) -> tuple[Points, Points, Points]:
    """Where a line along y through a point enters the object."""
    outside = hint_m + np.array([0.0, 1.0, 0.0])
    away, normal = surface.leave(outside[None], np.array([[0.0, -1.0, 0.0]]))
    hit = np.isfinite(away)
    entry = (outside - np.array([0.0, 1.0, 0.0]) * np.where(hit, away, 0.0)[:, None])[hit]
    return entry, np.tile([0.0, 1.0, 0.0], (len(entry), 1)), normal[hit]


def pairs_along(
    surface: SampledSurface, points_m: Points, normals: Points, directions: Points
) -> Pairs:
    """Follow rays from points of the surface through the material to its other side."""
    away, others = surface.leave(points_m + directions * _INSIDE_M, directions)
    there = np.isfinite(away) & (away > _LEAST_M)
    points_m, normals, directions = points_m[there], normals[there], directions[there]
    others, widths = others[there], away[there] + _INSIDE_M
    ends = points_m + directions * widths[:, None]
    cosines = np.minimum(
        -np.einsum("ni,ni->n", normals, directions), np.einsum("ni,ni->n", others, directions)
    )
    return Pairs(
        first_m=points_m,
        axes=directions,
        widths_m=widths,
        cosines=cosines,
        lowest_m=np.minimum(points_m[:, 2], ends[:, 2]),
        downward=np.maximum(-normals[:, 2], -others[:, 2]),
    )


def thinned(pairs: Pairs, *, cell_m: float, cell_rad: float) -> Ids:
    """Number the pairs that differ: the best of each cell of middles and directions."""
    largest = pairs.axes[np.arange(len(pairs.axes)), np.abs(pairs.axes).argmax(axis=1)]
    axes = pairs.axes * np.where(largest < 0, -1.0, 1.0)[:, None]
    cells = np.concatenate(
        [np.rint(pairs.middles_m / cell_m), np.rint(axes / cell_rad)], axis=1
    ).astype(np.int64)
    order = np.argsort(-pairs.cosines, kind="stable")
    _, first = np.unique(cells[order], axis=0, return_index=True)
    return np.sort(order[first])
