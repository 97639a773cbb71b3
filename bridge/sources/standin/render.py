"""Colour and depth of the laboratory by ray casting on the CPU: no GL, no display."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import open3d
from jaxtyping import Bool, Float, Int

from bridge.geometry.camera import Camera
from bridge.sources.standin.surfaces import Surface

AMBIENT = 0.50
SKY = 0.10
"""Light from everywhere, and how much more of it comes from above."""
LIGHTS = (
    ((0.25, -0.35, 0.90), 0.36),
    ((-0.55, 0.60, 0.58), 0.18),
)
"""Directions towards two large ceiling lamps, and their strengths."""
SUBPIXELS = ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25))
"""Extra rays through pixels on an outline, so that edges are smooth as a lens makes them."""
NOTHING = np.array([0.06, 0.06, 0.06], dtype=np.float32)


@dataclass(frozen=True, kw_only=True)
class Picture:
    """What an ideal camera sees."""

    image: Float[np.ndarray, "height width 3"]
    """sRGB, 0..1."""
    depth_m: Float[np.ndarray, "height width"]
    """Along the optical axis; infinite where nothing is hit."""
    cosine: Float[np.ndarray, "height width"]
    """Cosine between the ray and the surface normal; 0 where nothing is hit."""


@dataclass(frozen=True, kw_only=True)
class _Posed:
    """The scene of one instant."""

    scene: Any
    corner_normals: Float[np.ndarray, "num_triangles 3 3"]
    eye_m: Float[np.ndarray, "3"]


@dataclass(frozen=True, kw_only=True)
class _Seen:
    """What a list of rays met."""

    colors: Float[np.ndarray, "num_rays 3"]
    depth_m: Float[np.ndarray, " num_rays"]
    cosine: Float[np.ndarray, " num_rays"]
    surface_ids: Int[np.ndarray, " num_rays"]


class Renderer:
    """Casts one ray through each pixel centre, and four more where outlines cross a pixel.

    The scene is built anew for each picture (bodies move): with six thousand triangles this costs
    less than casting the rays once per body and merging.
    """

    def __init__(self, surfaces: Sequence[Surface]) -> None:
        """Concatenate the surfaces once; only poses change afterwards."""
        self._surfaces = list(surfaces)
        counts = [len(item.triangles) for item in surfaces]
        self._first = np.concatenate([[0], np.cumsum(counts)[:-1]])
        self._colors = np.array([item.color for item in surfaces], dtype=np.float32)

    def render(
        self,
        camera: Camera,
        T_base_camera: Float[np.ndarray, "4 4"],
        Ts_base_body: Mapping[str, Float[np.ndarray, "4 4"]],
    ) -> Picture:
        """Take a picture of the bodies where they are."""
        posed = self._pose(T_base_camera, Ts_base_body)
        # z = 1 in the camera's frame, so that the distance along a ray is the depth.
        local = camera.rays().reshape(-1, 3)
        seen = self._look(posed, (local @ T_base_camera[:3, :3].T).astype(np.float32))
        shape = (camera.height, camera.width)
        colors = seen.colors
        edge = np.flatnonzero(_outline(seen.surface_ids.reshape(shape)))
        if len(edge):
            shifts = np.array([[du / camera.fx, dv / camera.fy, 0.0] for du, dv in SUBPIXELS])
            moved = (local[edge][None] + shifts[:, None]) @ T_base_camera[:3, :3].T
            extra = self._look(posed, moved.reshape(-1, 3).astype(np.float32)).colors
            colors[edge] = extra.reshape(len(SUBPIXELS), -1, 3).mean(axis=0)
        return Picture(
            image=colors.reshape(*shape, 3),
            depth_m=seen.depth_m.reshape(shape),
            cosine=seen.cosine.reshape(shape),
        )

    def _pose(
        self,
        T_base_camera: Float[np.ndarray, "4 4"],
        Ts_base_body: Mapping[str, Float[np.ndarray, "4 4"]],
    ) -> _Posed:
        scene = open3d.t.geometry.RaycastingScene(nthreads=1)
        normals = []
        for item in self._surfaces:
            T = (np.eye(4) if item.body == "" else Ts_base_body[item.body]).astype(np.float32)
            vertices = np.ascontiguousarray(item.vertices_m @ T[:3, :3].T + T[:3, 3])
            scene.add_triangles(_tensor(vertices), _tensor(item.triangles))
            normals.append(item.corner_normals @ T[:3, :3].T)
        return _Posed(
            scene=scene,
            corner_normals=np.concatenate(normals),
            eye_m=T_base_camera[:3, 3].astype(np.float32),
        )

    def _look(self, posed: _Posed, rays: Float[np.ndarray, "num_rays 3"]) -> _Seen:
        origins = np.broadcast_to(posed.eye_m, rays.shape)
        both = np.concatenate([origins, rays], axis=1)
        hits = posed.scene.cast_rays(_tensor(both), nthreads=1)
        depth = hits["t_hit"].numpy()
        hit = np.isfinite(depth)
        surface_ids = np.where(hit, hits["geometry_ids"].numpy(), 0).astype(np.intp)
        triangles = self._first[surface_ids] + np.where(hit, hits["primitive_ids"].numpy(), 0)
        uvs = hits["primitive_uvs"].numpy()
        normals = _interpolate(posed.corner_normals[triangles], uvs)
        facing = -np.einsum("ij,ij->i", normals, rays)
        normals[facing < 0] *= -1.0
        cosine = np.abs(facing) / np.sqrt(np.einsum("ij,ij->i", rays, rays))
        points = posed.eye_m + rays * np.where(hit, depth, 0.0)[:, None]
        colors = self._albedo(surface_ids, points) * _shade(normals)[:, None]
        np.clip(colors, 0.0, 1.0, out=colors)
        colors[~hit] = NOTHING
        return _Seen(
            colors=colors,
            depth_m=depth,
            cosine=np.where(hit, cosine, 0.0).astype(np.float32),
            surface_ids=np.where(hit, surface_ids, -1),
        )

    def _albedo(
        self, surface_ids: Int[np.ndarray, " num_rays"], points: Float[np.ndarray, "num_rays 3"]
    ) -> Float[np.ndarray, "num_rays 3"]:
        """Plain colours, and textures where a surface of the (unmoving) room has one."""
        colors = self._colors[surface_ids]
        for index, item in enumerate(self._surfaces):
            if item.texture is None:
                continue
            mine = np.flatnonzero(surface_ids == index)
            if len(mine):
                u, v = item.texture_axes
                where = points[mine][:, [u, v]] - np.array(item.texture_shift_m, dtype=np.float32)
                colors[mine] = item.texture.sample(where)
        return np.asarray(colors)


def _tensor(array: np.ndarray) -> Any:
    make: Any = open3d.core.Tensor  # its stubs leave out that an array alone is enough
    return make(array)


def _outline(
    surface_ids: Int[np.ndarray, "height width"],
) -> Bool[np.ndarray, "height width"]:
    """Mark pixels beside which another surface begins."""
    mask = np.zeros(surface_ids.shape, dtype=bool)
    across = surface_ids[:, 1:] != surface_ids[:, :-1]
    down = surface_ids[1:] != surface_ids[:-1]
    mask[:, 1:] |= across
    mask[:, :-1] |= across
    mask[1:] |= down
    mask[:-1] |= down
    return mask


def _interpolate(
    corners: Float[np.ndarray, "num_rays 3 3"], uvs: Float[np.ndarray, "num_rays 2"]
) -> Float[np.ndarray, "num_rays 3"]:
    u, v = uvs[:, :1], uvs[:, 1:]
    normals = corners[:, 0] * (1 - u - v) + corners[:, 1] * u + corners[:, 2] * v
    length = np.sqrt(np.einsum("ij,ij->i", normals, normals))[:, None]
    return np.asarray(normals / np.maximum(length, 1e-9), dtype=np.float32)


def _shade(normals: Float[np.ndarray, "num_rays 3"]) -> Float[np.ndarray, " num_rays"]:
    """Lambert's law for two lamps and light from everywhere, more of it from above."""
    light = AMBIENT + SKY * normals[:, 2]
    for direction, strength in LIGHTS:
        towards = np.array(direction, dtype=np.float32) / np.float32(np.linalg.norm(direction))
        light = light + strength * np.maximum(normals @ towards, 0.0)
    return np.asarray(light, dtype=np.float32)
