"""The static scene's distances: from training views to the file in the scene folder."""

from dataclasses import replace
from pathlib import Path

import cast_views
import numpy as np
import pytest

from bridge.geometry import se3
from bridge.task.task_file import load_task
from twin.npz import UnreadableArraysError
from twin.scene.frames.rgbd import TrainingView
from twin.scene.shape import from_training
from twin.scene.shape import static as made
from twin.scene.shape.carve import ShapeError
from twin.scene.shape.known import pose_of, surface_distances
from twin.scene.shape.sdf import SdfGrid
from twin.scene.shape.static import Distance, StaticSdf, static_sdf

TASK, POSES = cast_views.TASK, cast_views.POSES


def coarse(views: list[TrainingView], *objects: Distance) -> StaticSdf:
    """In voxels of 12 mm, up to 30 cm above the table."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(made, "VOXEL_M", 0.012)
        patch.setattr(made, "HEIGHT_M", 0.3)
        return static_sdf(views, 0.0, objects)


@pytest.fixture(scope="module")
def static(views: list[TrainingView]) -> StaticSdf:
    def cube(points: np.ndarray) -> np.ndarray:
        return surface_distances(points, TASK.objects["cube"], POSES["cube"])[0]

    return coarse(views, cube)


def test_distances_to_the_table_and_to_what_stands_on_it(static: StaticSdf) -> None:
    above = np.array([[0.4, -0.25, z] for z in (0.05, 0.1)])
    np.testing.assert_allclose(static.observed.distance(above), [0.05, 0.1], atol=0.012)
    assert np.all(static.observed.distance(above - [0, 0, 0.12]) < 0)
    wall = se3.apply(POSES["box"], np.array([[0.078, 0.0, 0.03]]))
    assert static.observed.distance(wall)[0] < 0.006
    inside = se3.apply(POSES["box"], np.array([[0.0, 0.0, 0.045]]))
    assert static.observed.distance(inside)[0] > 0.01
    assert static.conservative.distance(inside)[0] > 0.01


def test_a_movable_object_is_not_part_of_the_static_scene(
    static: StaticSdf, views: list[TrainingView]
) -> None:
    centre = POSES["cube"][:3, 3] + [0, 0, 0.005]
    assert static.conservative.distance(centre) > 0
    with_cube = coarse(views)
    assert with_cube.conservative.distance(centre) < 0


def test_unseen_is_solid_for_the_careful_and_free_for_the_bold(static: StaticSdf) -> None:
    careful, bold = static.conservative.values_m, static.observed.values_m
    assert np.all(careful <= bold + 1e-6)
    unseen = (careful < 0) & (bold > 0)
    assert 0.05 < unseen.mean() < 0.95
    box, (x, y, z) = static.conservative, np.nonzero(unseen)
    places = box.origin_m + box.voxel_m * np.stack([x, y, z], axis=1)
    assert (places[:, 2] > 0).all()  # below the table nothing is free
    beyond = np.array([0.5, 0.0, 3.0])
    assert static.conservative.distance(beyond) < 0.7


def test_the_static_scene_is_read_back_and_described(static: StaticSdf, tmp_path: Path) -> None:
    path = tmp_path / "sdf.npz"
    static.save(path)
    again = StaticSdf.load(path)
    np.testing.assert_array_equal(again.conservative.values_m, static.conservative.values_m)
    np.testing.assert_array_equal(again.observed.values_m, static.observed.values_m)
    assert not SdfGrid.load(path).closed


def test_an_observed_distance_that_is_not_finite_is_refused(
    static: StaticSdf, tmp_path: Path
) -> None:
    """No check of clearance fails on it: whoever read it would take the place for free."""
    values = static.observed.values_m.copy()
    values[1, 1, 1] = np.nan
    damaged = replace(static, observed=replace(static.observed, values_m=values))
    damaged.save(tmp_path / "sdf.npz")
    with pytest.raises(UnreadableArraysError, match="a distance is not finite"):
        StaticSdf.load(tmp_path / "sdf.npz")


def test_a_basket_takes_its_handles_its_rim_and_its_cavity_out_of_the_scene() -> None:
    """What stays in the grid is an obstacle that nobody may touch: a toy goes over the handles."""
    basket = load_task("sloth_into_basket").objects["basket"]
    T = pose_of(np.array([0.48, 0.2, 0.0, 0.3]))
    angle = np.linspace(0.0, np.pi, 9)
    x, _, top = (np.array(basket.inner_m) + basket.wall_m) / [2, 2, 1]
    arch = np.stack([np.full(9, x), 0.03 * np.cos(angle), top + 0.03 * np.sin(angle)], axis=1)
    rim = np.array([[0.0, basket.inner_m[1] / 2 + basket.wall_m / 2, top + 0.003]])
    inside = np.array([[0.0, 0.0, 0.05]])
    beside = np.array([[basket.inner_m[0] / 2 + 0.06, 0.0, 0.05]])
    for points, is_taken in ((arch, True), (rim, True), (inside, True), (beside, False)):
        away = from_training.from_outside_m(se3.apply(T, points), basket, T)
        assert np.all(away < 0.001) if is_taken else np.all(away > 0.03)


def test_a_rim_is_as_high_as_it_is_seen_whatever_is_published(views: list[TrainingView]) -> None:
    box = TASK.objects["box"]
    for share in (0.8, 1.0, 1.25):
        published = replace(box, size_m=(*box.size_m[:2], share * box.size_m[2]))
        height_m = from_training.rim_height_m(views, published, POSES["box"])
        assert height_m == pytest.approx(box.size_m[2], abs=0.003)
    assert from_training.rim_height_m(views[:0], box, POSES["box"]) is None
    seen = from_training.with_heights(TASK, {"box": 0.07})
    assert seen.objects["box"].inner_m[2] == pytest.approx(0.07 - box.wall_m)
    assert seen.objects["cube"] == TASK.objects["cube"]


def test_a_budget_of_voxels_makes_them_larger(
    views: list[TrainingView], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(made, "MAX_GRID", 8000)
    small = static_sdf(views, 0.0, [])
    assert small.conservative.values_m.size <= 9000
    assert small.conservative.voxel_m > 0.008


def test_without_views_there_is_no_static_scene_but_a_reason(tmp_path: Path) -> None:
    with pytest.raises(ShapeError, match="0 points"):
        static_sdf([], 0.0)
    (tmp_path / "sdf.npz").write_bytes(b"old")
    about = from_training.write_static(tmp_path, [], [])
    assert about["file"] is None
    assert "0 points" in about["remark"]
    assert not (tmp_path / "sdf.npz").exists()
