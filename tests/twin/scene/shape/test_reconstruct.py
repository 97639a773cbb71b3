"""Views in, closed shape out: size, place, openings, and what is said when it cannot be done."""

from dataclasses import replace
from functools import cache

import cast_views
import numpy as np
import pytest

from bridge.task.meshes.solids import is_closed
from twin.scene.shape import reconstruct as made
from twin.scene.shape.carve import MaskedView, ShapeError
from twin.scene.shape.mesh import volume_m3
from twin.scene.shape.reconstruct import ObjectShape, reconstruct

NOISE = 0.004
"""1 mm at 0.5 m, growing with the square of the distance [1/m]."""


def quick(views: list[MaskedView], *, align_rounds: int = 0) -> ObjectShape:
    """In voxels of 2.5 mm."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(made, "MIN_VOXEL_M", 0.0025)
        return reconstruct(views, 0.0, align_rounds=align_rounds)


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
    return quick(cube_views())


@pytest.fixture(scope="module")
def box() -> ObjectShape:
    return reconstruct(box_views(), 0.0)


def check(shape: ObjectShape, reference: cast_views.Mesh, volume: float) -> None:
    assert shape.is_watertight
    assert is_closed(shape.faces)
    assert volume_m3(shape.vertices_m, shape.faces) == pytest.approx(shape.volume_m3)
    assert shape.volume_m3 == pytest.approx(volume, rel=0.08)
    mean, _ = cast_views.mean_error_m((shape.vertices_m, shape.faces), reference)
    assert mean < 0.002
    # Mesh and distances tell the same story.
    assert np.abs(shape.sdf.distance(shape.vertices_m)).max() < 0.1 * shape.sdf.voxel_m


def test_a_cube_is_closed_and_has_its_size(cube: ObjectShape) -> None:
    check(cube, cast_views.cube_mesh(), 0.04**3)
    assert cube.volume_m3 == pytest.approx(0.04**3, rel=0.06)


def test_the_unseen_underside_is_closed_by_the_plane(cube: ObjectShape) -> None:
    assert cube.vertices_m[:, 2].min() == pytest.approx(0.0, abs=1e-3)


def test_an_open_box_stays_open(box: ObjectShape) -> None:
    model = cast_views.TASK.objects["box"]
    inner = float(np.prod(model.inner_m))
    solid = float(np.prod(model.size_m)) - inner
    check(box, cast_views.open_box_mesh(), solid)
    middle = np.array([0.0, 0.0, model.wall_m + model.inner_m[2] / 2])
    assert box.sdf.distance(middle) > 0.4 * min(model.inner_m)


def test_views_that_are_shifted_against_each_other_are_laid_together() -> None:
    rng = np.random.default_rng(3)
    shifted = []
    for view in cube_views():
        T = view.T_base_camera.copy()
        T[:3, 3] += rng.normal(scale=0.003, size=3)
        shifted.append(replace(view, T_base_camera=T))
    plain = quick(shifted)
    aligned = quick(shifted, align_rounds=6)
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
    mended = reconstruct(outward, 0.0, align_rounds=6)
    assert thin.volume_m3 < 0.85 * solid
    assert mended.volume_m3 == pytest.approx(solid, rel=0.08)


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
        quick([replace(view, **change) for view in views])


def test_views_from_one_side_only_are_refused() -> None:
    views = cube_views(2)
    with pytest.raises(ShapeError, match="within 0 degrees"):
        quick([views[0]] * 5)


def test_poses_that_contradict_each_other_are_refused() -> None:
    views = cube_views(4)
    apart = [
        replace(view, T_base_camera=view.T_base_camera + np.pad([[k * 1.0]], ((0, 3), (3, 0))))
        for k, view in enumerate(views)
    ]
    with pytest.raises(ShapeError, match="Check the camera poses"):
        quick(apart)
