import numpy as np
import pytest
from scipy import ndimage

from twin.scene.semantics.shape_descriptors import find_height_map_cavity, height_map, measure_shape

CELL_M = 0.003


def from_above(height: np.ndarray, half_m: float = 0.06) -> np.ndarray:
    """Points on a height function sampled on a square, with walls where it jumps."""
    count = height.shape[0]
    x, y = np.meshgrid(*[np.linspace(-half_m, half_m, count)] * 2, indexing="ij")
    points = [np.column_stack([x.ravel(), y.ravel(), height.ravel()])]
    for level in np.arange(0.002, height.max(), 0.003):
        inside = height > level
        edge = inside & ~ndimage.binary_erosion(inside, border_value=1)
        points.append(np.column_stack([x[edge], y[edge], np.full(edge.sum(), level)]))
    p = np.concatenate(points)
    return p[p[:, 2] > 0]


def grid(count: int = 81, half_m: float = 0.06) -> tuple[np.ndarray, np.ndarray]:
    x, y = np.meshgrid(*[np.linspace(-half_m, half_m, count)] * 2, indexing="ij")
    return x, y


def test_an_open_box_has_its_cavity() -> None:
    x, y = grid()
    reach = np.maximum(np.abs(x), np.abs(y))
    height = np.where(reach > 0.054, 0.05, 0.006)
    measured = measure_shape(from_above(height), CELL_M)
    assert measured.word == "open container"
    assert measured.cavity is not None
    assert measured.cavity.rim_m == pytest.approx(0.05, abs=0.002)
    assert measured.cavity.floor_m == pytest.approx(0.006, abs=0.002)


def test_a_gap_of_one_cell_does_not_drain_the_cavity_and_a_missing_wall_does() -> None:
    x, y = grid()
    reach = np.maximum(np.abs(x), np.abs(y))
    height = np.where(reach > 0.052, 0.05, 0.006)
    height[:6, 40:42] = 0.006
    assert measure_shape(from_above(height), CELL_M).word == "open container"
    height[-8:] = 0.006
    assert measure_shape(from_above(height), CELL_M).cavity is None


def test_a_seat_is_level_at_knee_height_and_has_a_back() -> None:
    _, y = grid(half_m=0.25)
    shapes = [from_above(np.where(y > 0.2, z, 0.45), 0.25) for z in (0.85, 0.45, 1.6)]
    assert [measure_shape(p, 0.01).word == "seat" for p in shapes] == [True, False, False]


@pytest.mark.parametrize(
    ("word", "size_m"),
    [("cube", (0.04, 0.04, 0.04)), ("box", (0.10, 0.04, 0.05)), ("flat box", (0.1, 0.08, 0.015))],
)
def test_boxes_are_told_by_their_proportions(word: str, size_m: tuple[float, float, float]) -> None:
    x, y = grid(161)
    height = np.where((np.abs(x) < size_m[0] / 2) & (np.abs(y) < size_m[1] / 2), size_m[2], 0.0)
    measured = measure_shape(from_above(height), CELL_M)
    assert measured.word == word
    np.testing.assert_allclose(measured.size_m, size_m, atol=0.004)


def test_the_box_turns_with_the_thing() -> None:
    rng = np.random.default_rng(0)
    p = rng.uniform([-0.05, -0.02, 0.0], [0.05, 0.02, 0.03], (4000, 3))
    yaw = 0.5
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    turned = np.column_stack([p[:, :2] @ turn.T + [0.3, -0.1], p[:, 2]])
    measured = measure_shape(turned, CELL_M)
    assert measured.yaw_rad == pytest.approx(yaw, abs=0.05)
    np.testing.assert_allclose(measured.centre_m[:2], [0.3, -0.1], atol=0.003)
    np.testing.assert_allclose(measured.size_m, [0.1, 0.04, 0.03], atol=0.003)


def test_a_ball_is_a_ball_and_a_cylinder_is_not() -> None:
    rng = np.random.default_rng(1)
    p = rng.normal(size=(4000, 3))
    p = 0.03 * p / np.linalg.norm(p, axis=1, keepdims=True) + [0, 0, 0.03]
    assert measure_shape(p[p[:, 2] > 0.012], CELL_M).word == "ball"
    x, y = grid(161)
    can = np.where(np.hypot(x, y) < 0.033, 0.09, 0.0)
    assert measure_shape(from_above(can), CELL_M).word == "cylinder"


def test_the_height_map_keeps_the_highest_and_fills_what_is_enclosed() -> None:
    rng = np.random.default_rng(2)
    p = np.column_stack([rng.uniform(0, 0.05, (3000, 2)), rng.uniform(0, 0.02, 3000)])
    p = p[np.linalg.norm(p[:, :2] - 0.025, axis=1) > 0.008]
    heights = height_map(np.vstack([p, [0.01, 0.01, 0.09]]), 0.004)
    assert heights.top_m.max() == pytest.approx(0.09)
    middle = heights.cells(np.array([[0.025, 0.025, 0.0]]))
    assert heights.footprint[middle].all()
    assert find_height_map_cavity(height_map(p, 0.004)) is None
