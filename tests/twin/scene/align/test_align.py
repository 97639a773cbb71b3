"""Laws of laying a scene onto the robot's description; truth from the stand-in cell's geometry."""

from dataclasses import replace

import cell_views
import numpy as np
import pytest

from bridge.geometry import se3
from twin.robot.posture import Posture
from twin.robot.surface import PosedSurface, sample_surface
from twin.scene.align import align
from twin.scene.align.align import RobotNotAlignedError, align_robot, depth_errors
from twin.scene.align.refine import FINE, ScenePose, refine
from twin.scene.align.view import RobotView, find_levels

TWO = cell_views.POSTURES[:2]
BIASED = cell_views.CellErrors(depth_scale=1.01)


def surface_points(posture: Posture) -> np.ndarray:
    return sample_surface(cell_views.robot(), posture, 500, seed=3)


@pytest.fixture(scope="module")
def exact() -> list[RobotView]:
    return cell_views.views(TWO, np.eye(4), cell_views.CellErrors(noise=False))


@pytest.fixture(scope="module")
def biased() -> list[RobotView]:
    return cell_views.views(TWO, np.eye(4), BIASED)


def moved(views: list[RobotView], T_source_base: np.ndarray) -> list[RobotView]:
    return [replace(v, T_source_camera=T_source_base @ v.T_source_camera) for v in views]


def nearby(seed: int, metres: float = 0.02, radians: float = 0.03) -> np.ndarray:
    rng = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3] = se3.rotation_from_vector(rng.normal(size=3) * radians / np.sqrt(3))
    T[:3, 3] = rng.normal(size=3) * metres / np.sqrt(3)
    return T


def test_the_posed_surface_is_where_forward_kinematics_says() -> None:
    """Independent: the stand-in cell's ray caster reads the URDF on its own."""
    (view,) = cell_views.views(TWO[:1], np.eye(4), cell_views.CellErrors(noise=False))
    surface = PosedSurface(cell_views.robot(), view.posture)
    expected = surface.depth_along(view.camera.rays(), view.T_source_camera)
    both = np.isfinite(expected) & (view.depth_m > 0)
    assert both.sum() > 1500
    assert np.quantile(np.abs(expected - view.depth_m)[both], 0.9) < 0.001


def test_the_table_is_found_and_is_level(biased: list[RobotView]) -> None:
    T_source_base = cell_views.anywhere(1)
    heights, tilts = [], []
    for T_level_source in find_levels(moved(biased, T_source_base)):
        T_level_base = T_level_source @ T_source_base
        tilts.append(np.degrees(np.arccos(np.clip(T_level_base[2, 2], -1, 1))))
        heights.append(T_level_base[2, 3])
    assert any(t < 1.0 and abs(h) < 0.02 for t, h in zip(tilts, heights, strict=True))


def test_the_depth_scale_is_recovered_where_a_rigid_fit_goes_astray(
    biased: list[RobotView],
) -> None:
    points = surface_points(biased[0].posture)
    surfaces = [PosedSurface(cell_views.robot(), view.posture) for view in biased]
    start = ScenePose(T_base_source=nearby(5))
    rigid, _ = refine(biased, surfaces, start, stages=FINE, num_points=6000, with_scale=False)
    free = align_robot(biased, cell_views.robot(), start=nearby(5))
    assert free.depth_scale == pytest.approx(1 / 1.01, abs=0.002)
    error = cell_views.surface_error_m(free.T_base_source, np.eye(4), points)
    assert error < 0.002
    assert cell_views.surface_error_m(rigid.T_base_source, np.eye(4), points) > 3 * error


def test_the_frame_of_the_scene_does_not_matter(biased: list[RobotView]) -> None:
    """Same images, same start, another root frame: the same robot in the same place."""
    T_source_base = cell_views.anywhere(4)
    first = align_robot(biased, cell_views.robot(), start=nearby(1))
    second = align_robot(
        moved(biased, T_source_base),
        cell_views.robot(),
        start=nearby(1) @ se3.invert(T_source_base),
    )
    points = surface_points(biased[0].posture)
    a = se3.apply(first.T_base_source, points)
    b = se3.apply(second.T_base_source @ T_source_base, points)
    assert np.linalg.norm(a - b, axis=1).max() < 2e-4


@pytest.mark.slow
@pytest.mark.parametrize("seed", [7])
def test_the_robot_is_found_anywhere_with_a_biased_depth(
    biased: list[RobotView], seed: int
) -> None:
    T_source_base = cell_views.anywhere(seed)
    found = align_robot(moved(biased, T_source_base), cell_views.robot())
    points = surface_points(biased[0].posture)
    assert cell_views.surface_error_m(found.T_base_source, T_source_base, points) < 0.002
    assert found.margin is not None
    assert found.margin > 1.3
    assert found.residual_m < 0.003


def test_a_scene_without_the_robot_is_refused(biased: list[RobotView]) -> None:
    surface = PosedSurface(cell_views.robot(), biased[0].posture)
    view = biased[0]
    hit = np.isfinite(surface.depth_along(view.camera.rays(), view.T_source_camera))
    table_only = np.where(hit, 0.0, view.depth_m)
    with pytest.raises(RobotNotAlignedError, match="posture"):
        align_robot([replace(view, depth_m=table_only)], cell_views.robot(), start=np.eye(4))


@pytest.mark.slow
def test_two_places_that_fit_alike_are_refused(
    biased: list[RobotView], monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a margin no scene can give, the sentence asks for another posture."""
    monkeypatch.setattr(align, "MIN_MARGIN", 1e6)
    with pytest.raises(RobotNotAlignedError, match=r"another place fits.*another posture"):
        align_robot(biased, cell_views.robot())


def test_a_place_that_shows_little_does_not_win(exact: list[RobotView]) -> None:
    surfaces = [PosedSurface(cell_views.robot(), view.posture) for view in exact]
    right = depth_errors(exact, surfaces, ScenePose(T_base_source=np.eye(4)))
    away = np.eye(4)
    away[:3, 3] = (0.0, 0.0, 30.0)
    wrong = depth_errors(exact, surfaces, ScenePose(T_base_source=away))
    least = len(right.errors_m) // 2
    assert right.fitness > 0.95
    assert wrong.fitness == 0.0
    assert right.cost_m(least) < 0.2 * wrong.cost_m(least)


def test_a_depth_that_no_camera_is_so_wrong_about_is_refused(exact: list[RobotView]) -> None:
    """With ten percent too much depth something else is wrong; no place may hide it."""
    wrong = [replace(view, depth_m=1.1 * view.depth_m) for view in exact]
    with pytest.raises(RobotNotAlignedError, match="cannot be aligned"):
        align_robot(wrong, cell_views.robot(), start=np.eye(4))
