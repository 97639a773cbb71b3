"""Our Sobol points against SciPy's, and what scrambling must leave as it was."""

import numpy as np
import pytest
from scipy.stats import qmc

from evaluator.statistics.sobol import MOST_DIMENSIONS, sobol

pytestmark = pytest.mark.parity


def test_points_are_those_of_scipy() -> None:
    reference = qmc.Sobol(MOST_DIMENSIONS, scramble=False).random(1024)
    assert np.array_equal(sobol(1024, MOST_DIMENSIONS), reference)


@pytest.mark.parametrize("seed", range(3))
def test_scrambled_points_fill_every_part_of_each_side_once(seed: int) -> None:
    points = sobol(512, MOST_DIMENSIONS, np.random.default_rng(seed))
    assert (np.sort(np.floor(points * 512), axis=0) == np.arange(512)[:, None]).all()
    corners = np.floor(points[:, :2] * (16, 32)).astype(int)
    assert len({*map(tuple, corners)}) == 512  # a net: one point in each box of the first two


def test_scrambled_means_are_unbiased_and_better_than_random_ones() -> None:
    def mean(seed: int) -> float:
        points = sobol(1024, 6, np.random.default_rng(seed))
        return float(np.prod(1 + (points - 0.5) / 2, axis=1).mean())

    means = np.array([mean(seed) for seed in range(40)])
    at_random = np.sqrt(((1 + 1 / 48) ** 6 - 1) / 1024)
    assert abs(means.mean() - 1) < 4 * means.std() / np.sqrt(40)
    assert means.std() < at_random / 10


@pytest.mark.parametrize(("count", "dimensions"), [(8, MOST_DIMENSIONS + 1), (0, 2), (8, 0)])
def test_what_the_generators_do_not_reach_is_refused(count: int, dimensions: int) -> None:
    with pytest.raises(ValueError, match="Sobol points"):
        sobol(count, dimensions)
