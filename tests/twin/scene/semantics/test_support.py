import numpy as np
import pytest

from twin.scene.semantics.shape_descriptors import NoSupportError, SupportConfig, find_support

UP = np.array([0.0, 0.0, 1.0])


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
    plane = find_support(p, normals, SupportConfig())
    expected = np.array([-0.05, 0.0, 1.0]) / np.hypot(0.05, 1.0)
    assert np.degrees(np.arccos(plane.normal @ expected)) < 0.5
    assert plane.offset_m == pytest.approx(0.1 * expected[2], abs=0.002)


def test_the_table_wins_over_a_floor_on_which_nothing_stands() -> None:
    rng = np.random.default_rng(1)
    things = rng.uniform([-0.2, -0.2, 0.0], [0.2, 0.2, 0.12], (3000, 3))
    p = np.concatenate([sheet(rng, 0.0, 0.4, 4000), sheet(rng, -0.7, 0.9, 5000), things])
    normals = np.concatenate([np.tile(UP, (9000, 1)), np.tile([1.0, 0.0, 0.0], (3000, 1))])
    plane = find_support(p, normals, SupportConfig())
    assert abs(plane.offset_m) < 0.003


def test_a_wall_is_no_support() -> None:
    rng = np.random.default_rng(2)
    p = sheet(rng, 0.0, 0.5, 3000)[:, [2, 1, 0]]
    with pytest.raises(NoSupportError, match="no level plane among 3000 points"):
        find_support(p, np.tile([1.0, 0.0, 0.0], (3000, 1)), SupportConfig())


def test_the_footprint_covers_holes_and_ends_at_the_edge() -> None:
    rng = np.random.default_rng(3)
    p = sheet(rng, 0.0, 0.3, 20000)
    p = p[np.linalg.norm(p[:, :2], axis=1) > 0.05]
    plane = find_support(p, np.tile(UP, (len(p), 1)), SupportConfig())
    probes = np.array([[0.0, 0.0, 0.1], [0.25, 0.25, 0.0], [0.4, 0.0, 0.1], [5.0, 0.0, 0.0]])
    assert plane.under(probes).tolist() == [True, True, False, False]


def test_the_answer_moves_with_the_scene() -> None:
    rng = np.random.default_rng(4)
    p = sheet(rng, 0.0, 0.3, 3000)
    normals = np.tile(UP, (3000, 1))
    shift = np.array([1.0, -2.0, 0.35])
    first = find_support(p, normals, SupportConfig())
    second = find_support(p + shift, normals, SupportConfig())
    np.testing.assert_allclose(second.height_m(p + shift), first.height_m(p), atol=1e-6)


def test_a_rough_table_does_not_stand_on_its_own_underside() -> None:
    rng = np.random.default_rng(5)
    below = sheet(rng, 0.0, 0.4, 9000)
    below[:, 2] -= np.abs(rng.normal(0.0, 0.012, 9000))  # what a fit pushes into the wood
    p = np.concatenate([sheet(rng, 0.0, 0.4, 9000), below])
    plane = find_support(p, np.tile(UP, (len(p), 1)), SupportConfig())
    assert abs(plane.offset_m) < 0.003
