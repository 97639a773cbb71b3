"""Groups are parted from the bottom up until they are small enough; nothing is counted twice."""

import numpy as np

from twin.scene.semantics.cluster import neighbour_pairs
from twin.scene.semantics.segment import branches

VOXEL_M = 0.01


def block(corner_m: tuple[float, float, float], size_m: tuple[float, float, float]) -> np.ndarray:
    """Voxels of a full block."""
    axes = [np.arange(round(size / VOXEL_M)) for size in size_m]
    cells = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.asarray(corner_m) + (cells + 0.5) * VOXEL_M


def parted(p_m: np.ndarray, max_size_m: float = 0.45) -> list[set[int]]:
    found = branches(
        p_m,
        p_m[:, 2],
        neighbour_pairs(p_m, 1.8 * VOXEL_M),
        voxel_m=VOXEL_M,
        max_size_m=max_size_m,
        min_voxels=8,
    )
    return [set(ids.tolist()) for ids in found]


def test_mugs_on_one_paper_are_two_things_each_with_the_paper_below_it() -> None:
    paper = block((0.0, 0.0, 0.0), (0.6, 0.2, 0.01))
    mugs = [block((x, 0.05, 0.01), (0.08, 0.08, 0.09)) for x in (0.1, 0.4)]
    groups = parted(np.concatenate([paper, *mugs]))
    assert len(groups) == 2
    first = len(paper)
    for number, mug in enumerate(mugs):
        own = set(range(first, first + len(mug)))
        assert own <= groups[number]
        below = groups[number] - own
        assert below <= set(range(len(paper)))
        assert 64 <= len(below) <= 120  # what it stands on, and one voxel around
        first += len(mug)


def test_what_is_small_enough_is_left_whole_however_it_rises() -> None:
    foot, tower = block((0.0, 0.0, 0.0), (0.3, 0.3, 0.01)), block((0.1, 0.1, 0.01), (0.1, 0.1, 0.1))
    groups = parted(np.concatenate([foot, tower]))
    assert groups == [set(range(len(foot) + len(tower)))]


def test_a_wall_that_no_level_parts_is_left_out() -> None:
    wall = block((0.0, 0.0, 0.0), (0.7, 0.02, 0.3))
    assert parted(wall) == []


def test_groups_do_not_share_voxels_and_turn_with_the_scene() -> None:
    rng = np.random.default_rng(0)
    cells = np.unique(rng.integers(0, [90, 90, 9], (9000, 3)), axis=0)
    p_m = (cells + 0.5) * VOXEL_M
    groups = parted(p_m)
    assert sum(map(len, groups)) == len(set().union(*groups))
    turned = parted(p_m[:, [1, 0, 2]])
    assert sorted(map(sorted, turned)) == sorted(map(sorted, groups))
