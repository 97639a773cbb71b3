"""Bands of imported runs: laws, the course over time, and what lies inside the recorded band."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bridge.geometry.trajectory import PoseTrajectory
from evaluator.compare import compare_run
from evaluator.errors import UndefinedStatisticError
from evaluator.metrics.trajectory import band_distance, mean_curve_m, path_distance_m


def arc(
    offset_m: float = 0.0, turn_rad: float = 0.0, num: int = 41, first: Rotation | None = None
) -> PoseTrajectory:
    """A curved way during which the body turns evenly, beginning in any orientation."""
    t = np.linspace(0.0, 1.0, num)
    p = np.stack([t, 0.2 * np.sin(3 * t), np.full(num, offset_m)], axis=1)
    start = Rotation.identity() if first is None else first
    q = (Rotation.from_rotvec(np.outer(t, [0.0, 0.0, turn_rad])) * start).as_quat(scalar_first=True)
    return PoseTrajectory(np.arange(num, dtype=np.int64) * 10_000_000, p, q)


def test_turning_is_compared_whatever_axes_a_body_was_given() -> None:
    other = arc(turn_rad=0.3, first=Rotation.from_rotvec([1.0, 2.0, 0.5]))
    distance = band_distance([arc(turn_rad=0.1), arc(turn_rad=-0.1)], [other])
    assert distance.turned_over_pairs_rad == pytest.approx((0.2 + 0.4) / 2 / 2)


def test_along_the_path_speed_does_not_count() -> None:
    even = arc(num=401)
    t = np.linspace(0.0, 1.0, 401) ** 2
    p = np.stack([t, 0.2 * np.sin(3 * t), np.full(401, 0.01)], axis=1)
    hurried = PoseTrajectory(even.stamps_ns, p, even.q_wxyz)
    assert band_distance([even], [hurried]).mean_over_pairs_m > 0.1
    assert path_distance_m([even], [hurried]) == pytest.approx(0.01, abs=1e-4)
    still = PoseTrajectory(even.stamps_ns, np.zeros((401, 3)), even.q_wxyz)
    with pytest.raises(UndefinedStatisticError, match="does not move"):
        path_distance_m([even], [still])
    with pytest.raises(UndefinedStatisticError, match="no replayed run"):
        path_distance_m([even], [])


def test_each_recorded_run_has_its_distance() -> None:
    distance = band_distance([arc(0.01), arc(0.03)], [arc(0.0)])
    assert distance.of_recorded_m == pytest.approx((0.01, 0.03))
    assert np.mean(distance.of_recorded_m) == pytest.approx(distance.mean_over_pairs_m)


def test_the_mean_curve_is_half_way() -> None:
    np.testing.assert_allclose(mean_curve_m([arc(0.0), arc(0.02)])[:, 2], 0.01, atol=1e-9)


@pytest.fixture
def bands(maker: Any) -> Any:
    """Eight recorded runs within 7 mm, one simulator inside their band and one outside."""
    for index in range(8):
        offset_m = 0.001 * index - 0.0035
        maker.trial(f"real_{index}", kind="imported", offset_m=offset_m, stand_in=False)
    for engine, offset_m in (("near", 0.002), ("far", 0.05)):
        tags = (f"engine:{engine}",)
        maker.trial(f"sim_{engine}", kind="imported", offset_m=offset_m, tags=tags, stand_in=False)
    return compare_run(maker.run)


def test_a_simulator_is_inside_the_band_or_it_is_not(bands: Any) -> None:
    results = bands.results()
    assert results.get("bands.cube_into_box.near.moving_inside_band").value == 1.0
    assert results.get("bands.cube_into_box.far.moving_inside_band").value == 0.0


def test_where_another_recorded_run_would_lie_has_an_interval(bands: Any) -> None:
    found = bands.results().get("bands.cube_into_box.far.median_over_recorded_m")
    assert found.value == pytest.approx(0.05)
    assert found.n == 8
    assert found.interval is not None
    assert (found.interval.low, found.interval.high) == (
        pytest.approx(0.0465),
        pytest.approx(0.0535),
    )


def test_the_course_over_time_is_kept_for_figures_and_tables(bands: Any) -> None:
    curves = {(curve.engine, curve.part): curve for curve in bands.bands}
    assert set(curves) == {(e, p) for e in ("near", "far") for p in ("whole", "moving")}
    far = curves["far", "moving"]
    assert (far.num_recorded, far.num_simulated) == (8, 1)
    np.testing.assert_allclose(far.distance_m, 0.05, atol=1e-9)
    assert len(far.recorded_spread_m) == 101
    assert far.simulated_spread_m == ()
    table = next(t for t in bands.tables if t.id == "bands_over_time")
    assert len(table.rows) == 2 * 11


def test_a_straight_band_has_no_rigid_motion_to_take_out(bands: Any) -> None:
    found = bands.results().get("bands.cube_into_box.far.moving_without_offset_m")
    assert found.value is None
    assert "lie on a line" in str(found.reason_if_undefined)
