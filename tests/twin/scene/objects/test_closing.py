"""A closed object: nothing shows through it however it is turned, and each side has its colour."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import open3d as o3d
import pytest
from scipy.spatial import ConvexHull

from bridge.geometry import se3
from bridge.geometry.camera import Camera
from bridge.task.task_file import load_task
from twin.scene.frames.rgbd import Target, TrainingView
from twin.scene.gaussians import GaussianCloud, moved_cloud
from twin.scene.objects.closing import closed_object, weighted_median
from twin.scene.raster.rasteriser import RasterConfig, Rasteriser
from twin.scene.shape.known import shape_mesh

CAMERA = Camera(width=200, height=160, fx=260.0, fy=260.0, cx=100.0, cy=80.0)
HALF_M = 0.02
T_BASE_CUBE = se3.transform_from(np.array([0.97, 0.0, 0.0, 0.24]), np.array([0.5, -0.1, HALF_M]))
TABLE = (140, 107, 77)
SIDES = {(0, 1): (180, 40, 40), (0, -1): (40, 160, 60), (1, 1): (40, 60, 170),
         (1, -1): (170, 160, 40), (2, 1): (150, 60, 150)}  # fmt: skip
"""Colour of the face along an axis, up or down; nobody sees the underside."""


def cube() -> tuple[np.ndarray, np.ndarray]:
    return shape_mesh(load_task("cube_into_box").objects["cube"])


def caster(T_base_object: np.ndarray, *, with_table: bool = True) -> o3d.t.geometry.RaycastingScene:
    scene = o3d.t.geometry.RaycastingScene()
    meshes = [(se3.apply(T_base_object, cube()[0]), cube()[1])]
    if with_table:
        corners = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
        meshes.append((corners, np.array([[0, 1, 2], [0, 2, 3]])))
    for vertices, faces in meshes:
        scene.add_triangles(
            o3d.core.Tensor(vertices.astype(np.float32)), o3d.core.Tensor(faces.astype(np.uint32))
        )
    return scene


def cast(scene: o3d.t.geometry.RaycastingScene, T_base_camera: np.ndarray) -> dict[str, np.ndarray]:
    directions = CAMERA.rays() @ T_base_camera[:3, :3].T
    origins = np.broadcast_to(T_base_camera[:3, 3], directions.shape)
    rays = np.concatenate([origins, directions], axis=-1).astype(np.float32)
    return {name: found.numpy() for name, found in scene.cast_rays(o3d.core.Tensor(rays)).items()}


def side_colors(normals: np.ndarray) -> np.ndarray:
    """By normals in the cube's frame."""
    axis = np.abs(normals).argmax(axis=-1)
    sign = np.sign(np.take_along_axis(normals, axis[..., None], axis=-1))[..., 0]
    image = np.zeros(normals.shape)
    for (along, up), color in SIDES.items():
        image[(axis == along) & (sign == up)] = color
    return image


def view(T_base_camera: np.ndarray) -> TrainingView:
    hit = cast(caster(T_BASE_CUBE), T_base_camera)
    is_cube = hit["geometry_ids"] == 0
    colors = side_colors(hit["primitive_normals"] @ T_BASE_CUBE[:3, :3])
    image = np.where(is_cube[..., None], colors, TABLE).astype(np.uint8)
    depth = np.where(np.isfinite(hit["t_hit"]), hit["t_hit"], 0.0).astype(np.float32)
    target = Target(
        camera=CAMERA,
        planes_u8=np.ascontiguousarray(np.moveaxis(image, -1, 0)),
        depth_m=depth,
        static_mask=np.ones(depth.shape, dtype=bool),
    )
    return TrainingView(
        camera_id="wrist", stamp_ns=0, T_base_color=T_base_camera, half=target, full=target
    )


def around(elevation_rad: float, count: int, distance_m: float = 0.35) -> list[np.ndarray]:
    turns = np.arange(count) * 2 * np.pi / count
    level, up = np.cos(elevation_rad), np.sin(elevation_rad)
    directions = [np.array([level * np.cos(a), level * np.sin(a), up]) for a in turns]
    middle = T_BASE_CUBE[:3, 3]
    return [
        se3.look_at(middle + distance_m * d, middle, np.array([0.0, 0.0, 1.0])) for d in directions
    ]


@pytest.fixture(scope="module")
def views() -> list[TrainingView]:
    """All around and above; each camera stands 2 mm from where it says, another way each."""
    rng = np.random.default_rng(0)
    seen = [view(T) for T in (*around(0.5, 9), *around(1.0, 5))]
    shifts = rng.normal(size=(len(seen), 3))
    shifts *= 0.002 / np.linalg.norm(shifts, axis=1, keepdims=True)
    return [
        replace(
            v, T_base_color=se3.transform_from(np.array([1.0, 0, 0, 0]), shift) @ v.T_base_color
        )
        for v, shift in zip(seen, shifts, strict=True)
    ]


@pytest.fixture(scope="module")
def closed(views: Sequence[TrainingView]) -> GaussianCloud:
    cloud = closed_object(cube(), views, T_BASE_CUBE)
    assert cloud is not None
    return cloud


TURNS = [(1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.7, 0.7, 0.0, 0.1), (0.5, -0.5, 0.6, 0.2)]


@pytest.mark.parametrize("turn", TURNS)
def test_nothing_shows_through_it_however_it_is_turned(
    closed: GaussianCloud, turn: tuple[float, ...]
) -> None:
    q = np.array(turn) / np.linalg.norm(turn)
    T_camera_cube = se3.transform_from(q, np.array([0.0, 0.0, 0.3]))
    hit = cast(caster(T_camera_cube, with_table=False), np.eye(4))
    inside = np.isfinite(hit["t_hit"])
    moved = moved_cloud(closed, T_camera_cube)
    drawn = Rasteriser(RasterConfig(threads=1)).view(moved, CAMERA, np.eye(4))
    assert inside.sum() > 900
    assert (drawn.alpha[inside] < 0.5).mean() <= 0.01
    assert (drawn.alpha[~inside] > 0.5).mean() <= 0.01


@pytest.mark.parametrize("turn", TURNS)
def test_its_outline_is_as_large_as_that_of_its_corners(
    closed: GaussianCloud, turn: tuple[float, ...]
) -> None:
    q = np.array(turn) / np.linalg.norm(turn)
    T_camera_cube = se3.transform_from(q, np.array([0.01, -0.02, 0.3]))
    corners, _ = CAMERA.project(se3.apply(T_camera_cube, cube()[0]))
    drawn = Rasteriser(RasterConfig(threads=1)).view(
        moved_cloud(closed, T_camera_cube), CAMERA, np.eye(4)
    )
    area_px = ConvexHull(corners).volume  # in two dimensions this is the area
    assert drawn.alpha.sum() == pytest.approx(area_px, rel=0.025)


def test_each_side_has_its_colour_and_nothing_of_the_table(closed: GaussianCloud) -> None:
    p = closed.means_m.astype(np.float64)
    for (axis, up), color in SIDES.items():
        others = np.delete(np.abs(p), axis, axis=1)
        side = (p[:, axis] * up > HALF_M - 1e-4) & (others < HALF_M - 0.003).all(axis=1)
        assert side.sum() > 30
        error = np.abs(255 * closed.colors[side] - color)
        assert np.median(error) <= 2.0
        assert error.max() <= 30.0
    whole = 255 * closed.colors
    known = np.array(list(SIDES.values()))
    lean = (known.min(axis=0) - whole).max()
    assert lean < 8.0  # no channel leaves what the sides have


def test_the_underside_takes_nothing_of_the_table_where_cameras_stand_too_high() -> None:
    """All by 3 mm: below a side they see table."""
    raised = se3.transform_from(np.array([1.0, 0, 0, 0]), np.array([0.0, 0.0, 0.003]))
    seen = [view(T) for T in (*around(0.5, 9), *around(1.0, 5))]
    off = [replace(each, T_base_color=raised @ each.T_base_color) for each in seen]
    cloud = closed_object(cube(), off, T_BASE_CUBE)
    assert cloud is not None
    below = 255 * cloud.colors[cloud.means_m[:, 2] < -HALF_M + 1e-4]
    upright = np.array([color for (axis, _), color in SIDES.items() if axis != 2])
    away = np.abs(below[:, None] - upright).max(axis=-1).min(axis=1)
    assert np.median(away) < 15.0  # some side's, or between two


def test_the_underside_is_marked_and_has_the_colours_of_the_sides(closed: GaussianCloud) -> None:
    below = closed.means_m[:, 2] < -HALF_M + 1e-4
    assert closed.completed[below].mean() > 0.95
    above = closed.means_m[:, 2] > -HALF_M + 0.002
    assert not closed.completed[above].any()
    upright = np.array([color for (axis, _), color in SIDES.items() if axis != 2])
    colors = 255 * closed.colors[below]
    assert (colors > upright.min(axis=0) - 6).all()
    assert (colors < upright.max(axis=0) + 6).all()
    near_green = below & (closed.means_m[:, 0] < -HALF_M + 0.003)
    near_green &= np.abs(closed.means_m[:, 1]) < HALF_M / 2
    error = np.abs(255 * closed.colors[near_green].mean(axis=0) - SIDES[0, -1])
    assert error.max() <= 6.0


def test_the_weighted_median_is_the_median_of_repeated_values() -> None:
    rng = np.random.default_rng(1)
    values, weights = rng.normal(size=(7, 20, 3)), rng.integers(0, 4, size=(7, 20))
    found = weighted_median(values, weights.astype(np.float64))
    for point in range(20):
        repeated = np.repeat(values[:, point], weights[:, point], axis=0)
        for channel in range(3):
            ranked = np.sort(repeated[:, channel])
            expected = ranked[(len(ranked) - 1) // 2] if len(ranked) else 0.0
            assert found[point, channel] == expected
