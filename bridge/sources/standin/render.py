"""Colour and depth of the laboratory by ray casting on the CPU: no GL, no display."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import open3d
from jaxtyping import Bool, Float, Int, UInt8, UInt16, UInt32

from bridge.geometry.camera import Camera
from bridge.sources.standin.cell_file import HiddenParameters, SensorModel
from bridge.sources.standin.surfaces import Surface, smooth_normals

AMBIENT = 0.50
SKY = 0.10
"""Light from everywhere, and how much more of it comes from above."""
LIGHTS = (((0.25, -0.35, 0.90), 0.36), ((-0.55, 0.60, 0.58), 0.18))
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
class Layer:
    """What a list of rays met."""

    colors: Float[np.ndarray, "num_rays 3"]
    depth_m: Float[np.ndarray, " num_rays"]
    cosine: Float[np.ndarray, " num_rays"]
    surface_ids: Int[np.ndarray, " num_rays"]


@dataclass(frozen=True, kw_only=True)
class _Posed:
    """Some of the surfaces at one instant."""

    scene: Any
    indices: Int[np.ndarray, " num_surfaces"]
    first: Int[np.ndarray, " num_surfaces"]
    corner_normals: Float[np.ndarray, "num_triangles 3 3"]
    eye_m: Float[np.ndarray, "3"]


class Renderer:
    """Casts one ray through each pixel centre, and four more where outlines cross a pixel.

    The scene is built anew for each picture (bodies move): with six thousand triangles this costs
    less than casting the rays once per body and merging. A camera that stands still may keep the
    laboratory as a backdrop; then only the rays that meet a moving body are shaded.
    """

    def __init__(self, surfaces: Sequence[Surface]) -> None:
        """Keep the surfaces; only poses change afterwards."""
        self._surfaces = list(surfaces)
        self._colors = np.array([item.color for item in surfaces], dtype=np.float32)
        self._unmoving = [k for k, item in enumerate(surfaces) if item.body == ""]
        self._moving = [k for k, item in enumerate(surfaces) if item.body != ""]

    def backdrop(self, camera: Camera, T_base_camera: Float[np.ndarray, "4 4"]) -> Layer:
        """See the laboratory without the bodies in it, for ``render`` from the same place."""
        posed = self._pose(T_base_camera, {}, self._unmoving, {})
        seen = self._look(posed, _rays(camera, T_base_camera))
        return replace(seen, colors=self._smooth_edges(posed, seen, camera, T_base_camera))

    def render(
        self,
        camera: Camera,
        T_base_camera: Float[np.ndarray, "4 4"],
        Ts_base_body: Mapping[str, Float[np.ndarray, "4 4"]],
        backdrop: Layer | None = None,
        skins_m: Mapping[str, Float[np.ndarray, "num_vertices 3"]] | None = None,
    ) -> Picture:
        """Take a picture of the bodies where they are, the soft ones by their skins."""
        which = self._moving if backdrop is not None else [*self._unmoving, *self._moving]
        posed = self._pose(T_base_camera, Ts_base_body, which, skins_m or {})
        seen = self._look(posed, _rays(camera, T_base_camera))
        if backdrop is not None:
            seen = _nearer(seen, backdrop)
        colors = self._smooth_edges(posed, seen, camera, T_base_camera, backdrop)
        shape = (camera.height, camera.width)
        return Picture(
            image=colors.reshape(*shape, 3),
            depth_m=seen.depth_m.reshape(shape),
            cosine=seen.cosine.reshape(shape),
        )

    def _smooth_edges(
        self,
        posed: _Posed,
        seen: Layer,
        camera: Camera,
        T_base_camera: Float[np.ndarray, "4 4"],
        backdrop: Layer | None = None,
    ) -> Float[np.ndarray, "num_rays 3"]:
        colors = seen.colors.copy()
        edge = np.flatnonzero(_outline(seen.surface_ids.reshape(camera.height, camera.width)))
        if len(edge):
            shifts = np.array([[du / camera.fx, dv / camera.fy, 0.0] for du, dv in SUBPIXELS])
            rays = _rays(camera, T_base_camera)[edge]
            moved = rays[None] + (shifts @ T_base_camera[:3, :3].T)[:, None]
            extra = self._look(posed, moved.reshape(-1, 3).astype(np.float32))
            if backdrop is not None:
                # The backdrop has no subpixels; its colour at the pixel's centre stands for them.
                index = np.tile(edge, len(SUBPIXELS))
                behind = {name: values[index] for name, values in vars(backdrop).items()}
                extra = _nearer(extra, Layer(**behind))
            colors[edge] = extra.colors.reshape(len(SUBPIXELS), -1, 3).mean(axis=0)
        return colors

    def _pose(
        self,
        T_base_camera: Float[np.ndarray, "4 4"],
        Ts_base_body: Mapping[str, Float[np.ndarray, "4 4"]],
        which: list[int],
        skins_m: Mapping[str, Float[np.ndarray, "num_vertices 3"]],
    ) -> _Posed:
        scene = open3d.t.geometry.RaycastingScene(nthreads=1)
        normals, counts = [], [0]
        for index in which:
            item = self._surfaces[index]
            if item.soft and item.body in skins_m:
                vertices = skins_m[item.body].astype(np.float32)
                normals.append(smooth_normals(vertices, item.triangles))
            else:
                T = np.eye(4) if item.body == "" else Ts_base_body[item.body]
                T = T.astype(np.float32)
                vertices = np.ascontiguousarray(item.vertices_m @ T[:3, :3].T + T[:3, 3])
                normals.append(item.corner_normals @ T[:3, :3].T)
            scene.add_triangles(_tensor(vertices), _tensor(item.triangles))
            counts.append(len(item.triangles))
        return _Posed(
            scene=scene,
            indices=np.array(which),
            first=np.cumsum(counts)[:-1],
            corner_normals=np.concatenate(normals),
            eye_m=T_base_camera[:3, 3].astype(np.float32),
        )

    def _look(self, posed: _Posed, rays: Float[np.ndarray, "num_rays 3"]) -> Layer:
        count = len(rays)
        origins = np.broadcast_to(posed.eye_m, rays.shape)
        hits = posed.scene.cast_rays(_tensor(np.concatenate([origins, rays], axis=1)), nthreads=1)
        depth = hits["t_hit"].numpy()
        hit = np.flatnonzero(np.isfinite(depth))
        local_ids = hits["geometry_ids"].numpy()[hit].astype(np.intp)
        own_ids = hits["primitive_ids"].numpy()[hit]
        uvs = hits["primitive_uvs"].numpy()[hit]
        normals = _interpolate(posed.corner_normals[posed.first[local_ids] + own_ids], uvs)
        near = rays[hit]
        facing = -np.einsum("ij,ij->i", normals, near)
        normals[facing < 0] *= -1.0
        points = posed.eye_m + near * depth[hit][:, None]
        surface_ids = posed.indices[local_ids]
        albedo = self._albedo(surface_ids, points)
        self._paint(albedo, surface_ids, own_ids, uvs)
        shaded = albedo * _shade(normals)[:, None]
        layer = Layer(
            colors=np.tile(NOTHING, (count, 1)),
            depth_m=depth,
            cosine=np.zeros(count, dtype=np.float32),
            surface_ids=np.full(count, -1),
        )
        layer.colors[hit] = np.clip(shaded, 0.0, 1.0)
        layer.cosine[hit] = np.abs(facing) / np.sqrt(np.einsum("ij,ij->i", near, near))
        layer.surface_ids[hit] = surface_ids
        return layer

    def _albedo(
        self, surface_ids: Int[np.ndarray, " num_rays"], points: Float[np.ndarray, "num_rays 3"]
    ) -> Float[np.ndarray, "num_rays 3"]:
        """Plain colours, and textures where a surface of the unmoving laboratory has one."""
        colors = self._colors[surface_ids]
        for index, item in enumerate(self._surfaces):
            if item.texture is None:
                continue
            mine = np.flatnonzero(surface_ids == index)
            if len(mine):
                colors[mine] = item.texture.sample(points[mine][:, list(item.texture_axes)])
        return np.asarray(colors)

    def _paint(
        self,
        albedo: Float[np.ndarray, "num_hits 3"],
        surface_ids: Int[np.ndarray, " num_hits"],
        triangle_ids: UInt32[np.ndarray, " num_hits"],
        uvs: Float[np.ndarray, "num_hits 2"],
    ) -> None:
        """Colour painted surfaces by where on the undeformed surface each ray arrived."""
        for index, item in enumerate(self._surfaces):
            if item.paint is None or item.paint_vertices_m is None:
                continue
            mine = np.flatnonzero(surface_ids == index)
            if len(mine) == 0:
                continue
            corners = item.paint_vertices_m[item.triangles[triangle_ids[mine]]]
            u, v = uvs[mine, :1], uvs[mine, 1:]
            places = corners[:, 0] * (1 - u - v) + corners[:, 1] * u + corners[:, 2] * v
            albedo[mine] = item.paint(places.astype(np.float64))


def _rays(
    camera: Camera, T_base_camera: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "num_rays 3"]:
    """Directions with z = 1 in the camera's frame, so that the distance along one is the depth."""
    return np.asarray(_local_rays(camera) @ T_base_camera[:3, :3].T.astype(np.float32))


@cache
def _local_rays(camera: Camera) -> Float[np.ndarray, "num_rays 3"]:
    return camera.rays().reshape(-1, 3).astype(np.float32)


def _nearer(front: Layer, back: Layer) -> Layer:
    """Put one layer over another, pixel by pixel the nearer one."""
    take = front.depth_m < back.depth_m
    return Layer(
        colors=np.where(take[:, None], front.colors, back.colors),
        depth_m=np.where(take, front.depth_m, back.depth_m),
        cosine=np.where(take, front.cosine, back.cosine),
        surface_ids=np.where(take, front.surface_ids, back.surface_ids),
    )


def _tensor(array: np.ndarray) -> Any:
    make: Any = open3d.core.Tensor  # its stubs leave out that an array alone is enough
    return make(array)


def _outline(surface_ids: Int[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"]:
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


GAP_AT_EDGE_FRACTION = 0.6
"""Share of pixels without depth beside a jump in depth, where a stereo pair finds no match."""
EDGE_JUMP = 0.05
"""A jump, as a fraction of the distance."""


def measure_depth(
    picture: Picture, model: SensorModel, hidden: HiddenParameters, rng: np.random.Generator
) -> UInt16[np.ndarray, "height width"]:
    """Depth in whole millimetres with bias, noise and holes; 0 is "no measurement"."""
    true_m = np.where(np.isfinite(picture.depth_m), picture.depth_m, 0.0)
    noise = rng.standard_normal(true_m.shape, dtype=np.float32)
    sigma_m = model.depth_noise_per_m * true_m**2
    seen_m = true_m * hidden.depth_scale + hidden.depth_offset_m + sigma_m * noise
    valid = (true_m > model.depth_min_m) & (true_m < model.depth_max_m)
    valid &= picture.cosine > model.grazing_cosine
    edge = _beside_jump(true_m)
    valid[edge] &= rng.random(int(edge.sum())) > GAP_AT_EDGE_FRACTION
    return np.where(valid, np.rint(seen_m * 1e3), 0).astype(np.uint16)


def _beside_jump(depth_m: Float[np.ndarray, "height width"]) -> np.ndarray:
    mask = np.zeros(depth_m.shape, dtype=bool)
    across = np.abs(np.diff(depth_m, axis=1)) > EDGE_JUMP * depth_m[:, 1:]
    down = np.abs(np.diff(depth_m, axis=0)) > EDGE_JUMP * depth_m[1:]
    # The far side of an edge is the one hidden from the second imager.
    mask[:, 1:] |= across & (depth_m[:, 1:] > depth_m[:, :-1])
    mask[:, :-1] |= across & (depth_m[:, :-1] > depth_m[:, 1:])
    mask[1:] |= down & (depth_m[1:] > depth_m[:-1])
    mask[:-1] |= down & (depth_m[:-1] > depth_m[1:])
    return mask


def measure_color(
    picture: Picture, model: SensorModel, hidden: HiddenParameters, rng: np.random.Generator
) -> UInt8[np.ndarray, "height width 3"]:
    """Colour with the exposure's gain and noise."""
    noise = rng.standard_normal(picture.image.shape, dtype=np.float32)
    levels = picture.image * np.float32(255.0 * hidden.image_gain)
    return np.clip(levels + np.float32(model.image_noise) * noise + 0.5, 0, 255).astype(np.uint8)
