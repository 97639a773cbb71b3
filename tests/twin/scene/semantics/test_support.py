import numpy as np
import pytest

from bridge.geometry import se3
from twin.scene.semantics import support
from twin.scene.semantics.points import SurfacePoints

UP = np.array([0.0, 0.0, 1.0])


def seen(p: np.ndarray, normals: np.ndarray) -> SurfacePoints:
    return SurfacePoints(p_m=p, normals=normals, colors=np.zeros_like(p))


def sheet(
    rng: np.random.Generator, z_m: float, half_m: float, count: int, slope: float = 0.0
) -> np.ndarray:
    xy = rng.uniform(-half_m, half_m, (count, 2))
    return np.column_stack([xy, z_m + slope * xy[:, 0] + rng.normal(0, 0.001, count)])


def test_a_tilted_table_is_found_among_clutter() -> None:
    rng = np.random.default_rng(0)
    clutter = rng.uniform([-0.4, -0.4, 0.0], [0.4, 0.4, 0.4], (4000, 3))
    p = np.concatenate([sheet(rng, 0.1, 0.4, 4000, slope=0.05), clutter])
    normals = np.concatenate([np.tile(UP, (4000, 1)), rng.normal(size=(4000, 3))])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    plane = support.find_support(seen(p, normals))
    expected = np.array([-0.05, 0.0, 1.0]) / np.hypot(0.05, 1.0)
    assert np.degrees(np.arccos(plane.normal @ expected)) < 0.5
    assert plane.offset_m == pytest.approx(0.1 * expected[2], abs=0.002)


def test_the_table_wins_over_a_floor_on_which_nothing_stands() -> None:
    rng = np.random.default_rng(1)
    things = rng.uniform([-0.2, -0.2, 0.0], [0.2, 0.2, 0.12], (3000, 3))
    p = np.concatenate([sheet(rng, 0.0, 0.4, 4000), sheet(rng, -0.7, 0.9, 5000), things])
    normals = np.concatenate([np.tile(UP, (9000, 1)), np.tile([1.0, 0.0, 0.0], (3000, 1))])
    plane = support.find_support(seen(p, normals))
    assert abs(plane.offset_m) < 0.003


def test_a_wall_is_no_support() -> None:
    rng = np.random.default_rng(2)
    p = sheet(rng, 0.0, 0.5, 3000)[:, [2, 1, 0]]
    with pytest.raises(support.NoSupportError, match="no level plane among 3000 points"):
        support.find_support(seen(p, np.tile([1.0, 0.0, 0.0], (3000, 1))))


def test_the_footprint_covers_holes_and_ends_at_the_edge() -> None:
    rng = np.random.default_rng(3)
    p = sheet(rng, 0.0, 0.3, 20000)
    p = p[np.linalg.norm(p[:, :2], axis=1) > 0.05]
    plane = support.find_support(seen(p, np.tile(UP, (len(p), 1))))
    probes = np.array([[0.0, 0.0, 0.1], [0.25, 0.25, 0.0], [0.4, 0.0, 0.1], [5.0, 0.0, 0.0]])
    assert plane.under(probes).tolist() == [True, True, False, False]


def test_the_plane_goes_on_behind_what_hides_it_up_to_its_edge() -> None:
    p = sheet(np.random.default_rng(3), 0.0, 0.4, 20000)
    p = p[(np.abs(p[:, 0]) > 0.08) | (p[:, 1] < 0.1)]
    plane = support.find_support(seen(p, np.tile(UP, (len(p), 1))))
    probes = np.array([[0.0, 0.3, 0.1], [0.0, 0.5, 0.1], [0.5, 0.0, 0.1]])
    assert not plane.under(probes).any()
    assert plane.behind_things(0.12).under(probes).tolist() == [True, False, False]


def test_a_rough_table_does_not_stand_on_its_own_underside() -> None:
    rng = np.random.default_rng(5)
    below = sheet(rng, 0.0, 0.4, 9000)
    below[:, 2] -= np.abs(rng.normal(0.0, 0.012, 9000))  # what a fit pushes into the wood
    p = np.concatenate([sheet(rng, 0.0, 0.4, 9000), below])
    plane = support.find_support(seen(p, np.tile(UP, (len(p), 1))))
    assert abs(plane.offset_m) < 0.003


def bowl(xy: np.ndarray, deep_m: float) -> np.ndarray:
    return deep_m * ((xy[:, 0] / 0.5) ** 2 + (xy[:, 1] / 0.5) ** 2)


def test_a_table_that_was_measured_as_a_bowl_is_followed_and_what_stands_on_it_is_not() -> None:
    rng = np.random.default_rng(6)
    p = sheet(rng, 0.0, 0.5, 20000)
    book = np.all(np.abs(p[:, :2] - 0.25) < 0.1, axis=1)
    p[:, 2] += bowl(p[:, :2], 0.012) + 0.015 * book
    normals = np.tile(UP, (len(p), 1))
    flat = support.find_support(seen(p, normals))
    plane = support.as_measured(flat, seen(p, normals))
    height = plane.height_m(p)
    assert np.abs(height[~book]).max() < 0.006
    np.testing.assert_allclose(np.median(height[book]), 0.015, atol=0.002)
    assert np.abs(flat.height_m(p)[~book]).max() > 0.012
    assert plane.under(p).mean() > 0.99
    assert flat.under(p).mean() < 0.95


def test_a_flat_table_keeps_its_plane_to_the_bit() -> None:
    rng = np.random.default_rng(7)
    p = sheet(rng, 0.0, 0.5, 9000)
    normals = np.tile(UP, (len(p), 1))
    plane = support.find_support(seen(p, normals))
    assert support.as_measured(plane, seen(p, normals)) is plane


def turned(angle_rad: float) -> np.ndarray:
    """A frame whose z lies along the view of a camera, as that of a foreign scan."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    forward = np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]])
    return se3.from_rotation([[1, 0, 0], [0, c, -s], [0, s, c]] @ forward, np.zeros(3))


def room(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """A table, twice as much wall, and cameras that look down at it."""
    wall = np.column_stack([rng.normal(0.5, 0.001, 6000), rng.uniform(-1, 1, (6000, 2))])
    p = np.concatenate([sheet(rng, 0.0, 0.4, 3000), wall])
    normals = np.concatenate([np.tile(UP, (3000, 1)), np.tile([-1.0, 0.0, 0.0], (6000, 1))])
    down = np.array([[0, -0.5, 0.866], [-1, 0, 0], [0, -0.866, -0.5]])
    return p, normals, [se3.from_rotation(down, np.array([-0.6, 0.0, 0.5]))]


@pytest.mark.parametrize("angle_rad", [0.0, 0.3, -0.4])
def test_up_is_found_in_a_frame_that_is_not_level(angle_rad: float) -> None:
    p, normals, Ts = room(np.random.default_rng(6))
    R = turned(angle_rad)[:3, :3]
    moved = [turned(angle_rad) @ T for T in Ts]
    T_level = support.level_frame(seen(p @ R.T, normals @ R.T), moved)
    np.testing.assert_allclose(T_level[:3, :3] @ R @ UP, UP, atol=0.01)
    np.testing.assert_allclose(T_level[:3, :3] @ T_level[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(T_level[:3, :3]) == pytest.approx(1.0)


def test_a_level_frame_stays_as_it_is() -> None:
    p, normals, Ts = room(np.random.default_rng(7))
    assert np.array_equal(support.level_frame(seen(p, normals), Ts), np.eye(4))
    assert np.array_equal(support.level_frame(seen(p, normals), []), np.eye(4))


def test_the_top_of_a_thing_and_a_ceiling_are_no_support() -> None:
    rng = np.random.default_rng(8)
    small = sheet(rng, 0.0, 0.1, 3000)
    with pytest.raises(support.NoSupportError):
        support.find_support(seen(small, np.tile(UP, (3000, 1))))
    with pytest.raises(support.NoSupportError):
        support.find_support(seen(sheet(rng, 1.0, 0.5, 3000), np.tile(-UP, (3000, 1))))


def test_roughness_is_the_noise_of_the_plane() -> None:
    rng = np.random.default_rng(9)
    p = sheet(rng, 0.0, 0.4, 9000)
    p[:, 2] += rng.normal(0, 0.004, len(p))
    normals = np.tile(UP, (len(p), 1))
    plane = support.find_support(seen(p, normals))
    assert support.roughness_m(seen(p, normals), plane) == pytest.approx(0.0041, rel=0.1)
