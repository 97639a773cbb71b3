"""Views in, closed shape out: size, place, openings, and what is said when it cannot be done."""

from dataclasses import replace
from functools import cache

import cast_views
import numpy as np
import pytest

from bridge.geometry import se3
from twin.scene.shape.carve import MaskedView, ShapeError
from twin.scene.shape.mesh import is_watertight, volume_m3
from twin.scene.shape.reconstruct import ObjectShape, ShapeConfig, moved_views, reconstruct
from twin.scene.shape.registration import laid_together
from twin.scene.shape.sdf import SdfGrid

NOISE = 0.004
"""1 mm at 0.5 m, growing with the square of the distance [1/m]."""
QUICK = ShapeConfig(min_voxel_m=0.0025)


def views_of(mesh: cast_views.Mesh, *, num: int = 20, noise: float = NOISE) -> list[MaskedView]:
    poses = cast_views.around([0.0, 0.0, 0.02], num)
    return cast_views.cast([mesh, cast_views.table()], poses, noise=noise)


@cache
def cube_views(num: int = 20) -> list[MaskedView]:
    return views_of(cast_views.cube_mesh(), num=num)


@cache
def box_views() -> list[MaskedView]:
    return views_of(cast_views.open_box_mesh())


@pytest.fixture(scope="module")
def cube() -> ObjectShape:
    return reconstruct(cube_views(), 0.0, QUICK)


@pytest.fixture(scope="module")
def box() -> ObjectShape:
    return reconstruct(box_views(), 0.0)


def check(shape: ObjectShape, reference: cast_views.Mesh, volume: float) -> None:
    assert shape.is_watertight
    assert is_watertight(shape.faces)
    assert volume_m3(shape.vertices_m, shape.faces) == pytest.approx(shape.volume_m3)
    assert shape.volume_m3 == pytest.approx(volume, rel=0.08)
    mean, _ = cast_views.mean_error_m((shape.vertices_m, shape.faces), reference)
    assert mean < 0.002
    # Mesh and distances tell the same story.
    assert np.abs(shape.sdf.distance(shape.vertices_m)).max() < 0.1 * shape.sdf.voxel_m


def test_a_cube_is_closed_and_has_its_size(cube: ObjectShape) -> None:
    check(cube, cast_views.cube_mesh(), 0.04**3)
    assert cube.volume_m3 == pytest.approx(0.04**3, rel=0.06)


def test_the_unseen_underside_is_closed_by_the_plane_and_marked(cube: ObjectShape) -> None:
    assert cube.vertices_m[:, 2].min() == pytest.approx(0.0, abs=1e-3)
    centres = cube.vertices_m[cube.faces].mean(axis=1)
    bottom = (centres[:, 2] < 5e-4) & (np.abs(centres[:, :2]).max(axis=1) < 0.014)
    top = centres[:, 2] > 0.038
    assert cube.completed[bottom].mean() > 0.95
    assert cube.completed[top].mean() < 0.02
    assert 1 / 10 < cube.completed_fraction < 1 / 4


def test_an_open_box_stays_open(box: ObjectShape) -> None:
    model = cast_views.TASK.objects["box"]
    inner = float(np.prod(model.inner_m))
    solid = float(np.prod(model.size_m)) - inner
    check(box, cast_views.open_box_mesh(), solid)
    middle = np.array([0.0, 0.0, model.wall_m + model.inner_m[2] / 2])
    assert box.sdf.distance(middle) > 0.4 * min(model.inner_m)


def test_a_figure_with_a_neck_keeps_it() -> None:
    mesh = cast_views.figure_mesh()
    shape = reconstruct(views_of(mesh), 0.0, QUICK)
    check(shape, mesh, volume_m3(*mesh))


def test_without_noise_a_sphere_in_the_air_is_closed_by_itself() -> None:
    ball = cast_views.solid_mesh(
        lambda p: np.linalg.norm(p, axis=1) - 0.03, (-0.04,) * 3, (0.04,) * 3, 0.002
    )
    poses = cast_views.around([0, 0, 0], 16)
    below = [cast_views.look_at(T[:3, 3] * [1, 1, -1], np.zeros(3)) for T in poses]
    views = cast_views.cast([ball, cast_views.table(-0.5, 2.0)], [*poses, *below])
    shape = reconstruct(views, None, QUICK)
    assert shape.is_watertight
    assert shape.volume_m3 == pytest.approx(4 / 3 * np.pi * 0.03**3, rel=0.05)
    assert shape.completed_fraction < 0.02


def test_moving_cameras_and_object_together_moves_the_result(cube: ObjectShape) -> None:
    T = se3.transform_from(np.array([0.92, 0.0, 0.0, 0.39]), np.array([0.4, -0.2, 0.1]))
    views = moved_views(cube_views(), T)
    moved = reconstruct(views, 0.1, QUICK)
    assert moved.volume_m3 == pytest.approx(cube.volume_m3, rel=0.05)
    back = se3.apply(se3.invert(T), moved.vertices_m)
    there = np.abs(cube.sdf.distance(back))
    assert there.mean() < 0.001
    # In a frame that turns with the views, nothing changes but rounding.
    again = reconstruct(moved_views(views, se3.invert(T)), 0.0, QUICK)
    assert again.volume_m3 == pytest.approx(cube.volume_m3, rel=1e-3)


def test_views_that_are_shifted_against_each_other_are_laid_together() -> None:
    rng = np.random.default_rng(3)
    shifted = []
    for view in cube_views():
        T = view.T_base_camera.copy()
        T[:3, 3] += rng.normal(scale=0.003, size=3)
        shifted.append(replace(view, T_base_camera=T))
    plain = reconstruct(shifted, 0.0, QUICK)
    aligned = reconstruct(shifted, 0.0, replace(QUICK, align_rounds=6))
    assert plain.view_shift_m == 0.0
    assert aligned.view_shift_m > 0.001
    error = [abs(s.volume_m3 / 0.04**3 - 1) for s in (plain, aligned)]
    assert error[1] < max(error[0], 0.05)


@pytest.mark.slow
def test_views_that_all_stand_too_far_out_do_not_thin_a_wall() -> None:
    """Neighbours hardly disagree then, and opposite views see no common face."""
    model = cast_views.TASK.objects["box"]
    solid = float(np.prod(model.size_m)) - float(np.prod(model.inner_m))
    outward = []
    for view in box_views():
        T = view.T_base_camera.copy()
        away = T[:2, 3] / np.linalg.norm(T[:2, 3])
        T[:2, 3] -= 0.0015 * away  # towards the middle: outer faces move in, inner faces out
        outward.append(replace(view, T_base_camera=T))
    thin = reconstruct(outward, 0.0)
    mended = reconstruct(outward, 0.0, ShapeConfig(align_rounds=6))
    assert thin.volume_m3 < 0.85 * solid
    assert mended.volume_m3 == pytest.approx(solid, rel=0.08)
    assert 0.0007 < mended.view_shift_m < 0.002  # an offset of the depth explains part of it


def test_views_that_agree_are_left_where_they_are() -> None:
    views = cube_views()
    moved, shift = laid_together(views, 0.0, 6)
    assert shift < 0.0015  # the noise is 1 mm, and a cube of 4 cm has few points
    turns = [
        m.T_base_camera @ se3.invert(v.T_base_camera) for m, v in zip(moved, views, strict=True)
    ]
    assert max(float(se3.rotation_angle_rad(T[:3, :3])) for T in turns) < 0.006
    same, none = laid_together(views, 0.0, 0)
    assert none == 0.0
    assert same == views


def test_a_flying_pixel_and_a_hole_in_the_depth_change_nothing(cube: ObjectShape) -> None:
    views = cube_views()
    rng = np.random.default_rng(0)
    broken = []
    for view in views:
        depth = view.depth_m.copy()
        depth[rng.random(depth.shape) < 0.05] = np.nan
        row, column = np.nonzero(view.mask)
        depth[row[0], column[0]] = 0.9
        depth[row[-1], column[-1]] = -np.inf
        broken.append(replace(view, depth_m=depth))
    shape = reconstruct(broken, 0.0, QUICK)
    assert shape.volume_m3 == pytest.approx(cube.volume_m3, rel=0.06)


def test_an_opening_nobody_looked_into_stays_solid() -> None:
    poses = [
        cast_views.look_at(
            np.array([0.6 * np.cos(a), 0.6 * np.sin(a), 0.03]), np.array([0, 0, 0.03])
        )
        for a in np.linspace(0, 2 * np.pi, 12, endpoint=False)
    ]
    views = cast_views.cast([cast_views.open_box_mesh(), cast_views.table()], poses)
    shape = reconstruct(views, 0.0)
    model = cast_views.TASK.objects["box"]
    middle = np.array([0.0, 0.0, model.size_m[2] / 2])
    assert shape.sdf.distance(middle) < 0


@pytest.mark.parametrize(
    ("num", "change", "says"),
    [
        (0, {}, "all masks are empty"),
        (6, {"mask": np.zeros((240, 320), dtype=bool)}, "all masks are empty"),
        (6, {"depth_m": np.full((240, 320), np.nan)}, "0 of 6 views"),
        (6, {"depth_m": np.zeros((240, 320))}, "0 of 6 views"),
        (1, {}, "1 of 1 views"),
    ],
)
def test_too_little_is_refused_in_one_sentence(num: int, change: dict, says: str) -> None:
    views = cube_views(max(num, 1))[:num]
    with pytest.raises(ShapeError, match=says):
        reconstruct([replace(view, **change) for view in views], 0.0, QUICK)


def test_views_from_one_side_only_are_refused() -> None:
    views = cube_views(2)
    with pytest.raises(ShapeError, match="within 0 degrees"):
        reconstruct([views[0]] * 5, 0.0, QUICK)


def test_poses_that_contradict_each_other_are_refused() -> None:
    views = cube_views(4)
    apart = [
        replace(view, T_base_camera=view.T_base_camera + np.pad([[k * 1.0]], ((0, 3), (3, 0))))
        for k, view in enumerate(views)
    ]
    with pytest.raises(ShapeError, match="Check the camera poses"):
        reconstruct(apart, 0.0, QUICK)


def test_a_plane_above_the_object_is_refused() -> None:
    with pytest.raises(ShapeError, match="below the plane"):
        reconstruct(cube_views(4), 1.0, QUICK)


def test_sizes_that_differ_and_a_pose_that_is_no_number_are_refused() -> None:
    (view,) = cube_views(1)
    with pytest.raises(ShapeError, match="320 x 240"):
        replace(view, mask=np.zeros((10, 10), dtype=bool))
    with pytest.raises(ShapeError, match="not finite"):
        replace(view, T_base_camera=np.full((4, 4), np.nan))


def test_the_grid_of_distances_holds_the_whole_solid(cube: ObjectShape) -> None:
    values = cube.sdf.values_m
    assert isinstance(cube.sdf, SdfGrid)
    assert cube.sdf.closed
    for axis in range(3):
        assert values.take([0, -1], axis=axis).min() > 0
