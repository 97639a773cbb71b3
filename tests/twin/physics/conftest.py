"""Soft bodies whose behaviour can be worked out by hand; lets tests here import ``cells``."""

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from bridge.robots.default import ROBOT
from bridge.task.meshes.lattice import volumes_m3
from twin.physics.soft import SoftModel
from twin.robot.model import with_absolute_meshes

sys.path.insert(0, str(Path(__file__).parent))

CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
FIVE = np.array([[0, 3, 5, 6], [1, 0, 3, 5], [2, 0, 3, 6], [4, 0, 5, 6], [7, 3, 5, 6]])


def soft_box(
    cells: tuple[int, int, int],
    cell_m: float = 0.014,
    *,
    mass_kg: float = 0.03,
    young_pa: float = 6e4,
    poisson: float = 0.2,
    damping_s: float = 0.01,
) -> SoftModel:
    """A box of cubes around the origin, five tetrahedra each."""
    grid = np.stack(np.meshgrid(*(np.arange(n) for n in cells), indexing="ij"), -1).reshape(-1, 3)
    odd = grid.sum(axis=1) % 2 == 1
    corners = grid[:, None] + CORNERS
    places = np.concatenate(
        [corners[~odd][:, four] for four in FIVE] + [corners[odd][:, 7 - four] for four in FIVE]
    )
    used, index = np.unique(places.reshape(-1, 3), axis=0, return_inverse=True)
    tets = index.reshape(-1, 4)
    nodes = cell_m * (used - np.array(cells) / 2)
    wrong = volumes_m3(nodes, tets) < 0
    tets[wrong] = tets[wrong][:, [1, 0, 2, 3]]
    share = np.zeros(len(nodes))
    np.add.at(share, tets, volumes_m3(nodes, tets)[:, None] / 4)
    return SoftModel(
        nodes_m=nodes.astype(np.float32),
        tets=tets.astype(np.int32),
        mass_fraction=(share / share.sum()).astype(np.float32),
        spacing_m=cell_m,
        mass_kg=mass_kg,
        young_pa=young_pa,
        poisson=poisson,
        damping_s=damping_s,
        size_m=tuple(cell_m * n for n in cells),
    )


@pytest.fixture(scope="session")
def box_of_cells() -> Callable[..., SoftModel]:
    return soft_box


@pytest.fixture(scope="module")
def urdf() -> str:
    return with_absolute_meshes(ROBOT.urdf_text())
