"""What touches a wall is found without a table; on a plane, what stands, and what touches."""

from dataclasses import replace

import numpy as np
import pytest

from twin.scene.semantics.patches import cut_into_patches
from twin.scene.semantics.points import SurfacePoints
from twin.scene.semantics.segment import segment

WOOD, RED, BLUE = (0.55, 0.42, 0.30), (0.8, 0.1, 0.1), (0.1, 0.25, 0.75)
SPACING_M, VOXEL_M = 0.004, 0.008


def face(
    corner: list[float], along: list[float], across: list[float], color: tuple[float, float, float]
) -> SurfacePoints:
    """A rectangle sampled on a grid; it faces ``along x across``."""
    a, b = np.array(along), np.array(across)
    steps = [np.arange(0, np.linalg.norm(v), SPACING_M) / np.linalg.norm(v) for v in (a, b)]
    s, t = (grid.reshape(-1, 1) for grid in np.meshgrid(*steps))
    normal = np.cross(a, b) / np.linalg.norm(np.cross(a, b))
    p = np.array(corner) + s * a + t * b
    return SurfacePoints(
        p_m=p, normals=np.tile(normal, (len(p), 1)), colors=np.tile(color, (len(p), 1))
    )


def together(*parts: SurfacePoints) -> SurfacePoints:
    """All of them, with half a millimetre of noise."""
    rng = np.random.default_rng(0)
    p = np.concatenate([part.p_m for part in parts])
    return SurfacePoints(
        p_m=p + rng.normal(0, 0.0005, p.shape),
        normals=np.concatenate([part.normals for part in parts]),
        colors=np.concatenate([part.colors for part in parts]),
    )


WALL = face([0, -0.3, 0], [0, 0.6, 0], [0, 0, 0.5], WOOD)
"""At x = 0, seen from +x."""
PARCEL = [
    face([0.1, -0.2, 0.1], [0, 0.12, 0], [0, 0, 0.14], RED),
    face([0, -0.2, 0.24], [0.1, 0, 0], [0, 0.12, 0], RED),
    face([0, -0.08, 0.1], [0, 0, 0.14], [0.1, 0, 0], RED),
    face([0, -0.2, 0.1], [0.1, 0, 0], [0, 0, 0.14], RED),
]
"""A box whose back is against the wall."""
BEHIND = WALL.take(
    ~((np.abs(WALL.p_m[:, 1] + 0.14) < 0.06) & (np.abs(WALL.p_m[:, 2] - 0.17) < 0.07))
)
"""What it leaves of the wall."""
POSTER = face([0.0015, 0.05, 0.15], [0, 0.2, 0], [0, 0, 0.15], BLUE)


def share(labels: np.ndarray, mine: np.ndarray) -> float:
    best = [((labels == k) & mine).sum() / ((labels == k) | mine).sum() for k in np.unique(labels)]
    return float(max(best[1:], default=0.0))


def test_a_box_against_a_wall_is_a_thing_and_a_poster_on_it_is_none() -> None:
    points = together(BEHIND, *PARCEL, POSTER)
    is_parcel = np.zeros(len(points), dtype=bool)
    is_parcel[len(BEHIND) : len(points) - len(POSTER)] = True
    labels = cut_into_patches(points, VOXEL_M)
    assert labels.max() == 1
    assert share(labels, is_parcel) > 0.85
    found = segment(points)
    assert found.plane is None
    assert [thing.label.split()[0] for thing in found.things] == ["red"]


def test_the_image_of_a_box_in_a_shining_floor_is_no_part_of_it() -> None:
    image = face([0.1, -0.2, 0.1], [-0.08, 0, -0.08], [0, 0.12, 0], RED)
    is_parcel = np.repeat([False, True, False], [len(BEHIND), sum(map(len, PARCEL)), len(image)])
    points = together(BEHIND, *PARCEL, image)
    assert share(cut_into_patches(points, VOXEL_M), is_parcel) < 0.8
    assert share(segment(points).labels, is_parcel) > 0.9


def test_a_box_of_the_colour_of_the_wall_is_part_of_it() -> None:
    painted = [replace(part, colors=np.tile(WOOD, (len(part), 1))) for part in PARCEL]
    assert not cut_into_patches(together(WALL, *painted), VOXEL_M).any()


@pytest.mark.parametrize("num", [0, 1, 30])
def test_next_to_nothing_holds_no_thing(num: int) -> None:
    labels = cut_into_patches(WALL.take(np.arange(num)), VOXEL_M)
    assert labels.shape == (num,)
    assert not labels.any()


def test_points_too_sparse_for_a_surface_hold_no_thing() -> None:
    assert not cut_into_patches(together(WALL, *PARCEL), 0.1).any()


def standing(x_m: float, side_m: float, color: tuple[float, float, float]) -> list[SurfacePoints]:
    """Four sides and the top of a cube on z = 0, its middle at x."""
    low, high, a = x_m - side_m / 2, x_m + side_m / 2, side_m
    return [
        face([high, -a / 2, 0], [0, a, 0], [0, 0, a], color),
        face([low, -a / 2, 0], [0, 0, a], [0, a, 0], color),
        face([low, -a / 2, 0], [a, 0, 0], [0, 0, a], color),
        face([low, a / 2, 0], [0, 0, a], [a, 0, 0], color),
        face([low, -a / 2, a], [a, 0, 0], [0, a, 0], color),
    ]


def on_plane(*parts: SurfacePoints, lift_m: float = 0.0, furniture: float = 1.0) -> list[int]:
    """How many points each thing has."""
    points = together(*parts)
    labels = cut_into_patches(points, VOXEL_M, points.p_m[:, 2] + lift_m, furniture)
    return np.bincount(labels)[1:].tolist()


def test_cubes_that_touch_are_two_by_their_colours_or_by_a_step() -> None:
    large, small = standing(0.0, 0.12, RED), standing(0.11, 0.1, BLUE)
    assert len(on_plane(*large, *small)) == 2
    assert len(on_plane(*large, *standing(0.09, 0.06, RED))) == 2
    assert len(on_plane(*large, *standing(0.12, 0.12, BLUE))) == 2  # no step: colour alone
    assert len(on_plane(*large, *standing(0.12, 0.12, RED))) == 1


def test_what_is_small_beside_a_thing_of_its_colour_is_a_part_unless_it_towers_over_it() -> None:
    papers = face([-0.15, -0.15, 0.012], [0.3, 0, 0], [0, 0.3, 0], RED)
    assert len(on_plane(papers, *standing(0.18, 0.05, RED))) == 2
    assert len(on_plane(papers, *standing(0.162, 0.02, RED))) == 1


def test_a_label_belongs_to_what_it_is_on() -> None:
    label = face([0.0605, -0.02, 0.04], [0, 0.04, 0], [0, 0, 0.04], BLUE)
    assert len(on_plane(*standing(0.0, 0.12, RED), label)) == 1


def test_what_hangs_is_no_thing_unless_it_hangs_low_over_a_floor() -> None:
    cube = standing(0.0, 0.12, RED)
    assert on_plane(*cube, lift_m=0.3) == []
    assert len(on_plane(*cube, lift_m=0.3, furniture=3.0)) == 1


def test_furniture_is_no_thing_on_a_table_and_one_on_a_floor() -> None:
    table = standing(0.0, 0.5, WOOD)
    assert on_plane(*table) == []
    assert len(on_plane(*table, furniture=3.0)) == 1


def test_a_handle_that_starts_above_the_plane_belongs_to_its_mug() -> None:
    cube, ear = standing(0.0, 0.12, RED), standing(0.085, 0.05, RED)
    ear = [replace(part, p_m=part.p_m + np.array([0, 0, 0.05])) for part in ear]
    assert len(on_plane(*cube, *ear)) == 1
