"""What cells are drawn from when the coverage of agreement is simulated."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64
from scipy.special import ndtr


@dataclass(frozen=True, kw_only=True)
class Population:
    """Cells whose recorded and simulated success rates go together more or less.

    Both rates of a cell are 0.05 + 0.9 x the normal distribution function of two normal variables
    with correlation ``correlation``; a share of each belongs to the cluster. Counts are binomial.
    """

    correlation: float
    cluster_share: float = 0.0
    cells_per_cluster: int = 1
    trials: int = 10

    @property
    def name(self) -> str:
        """What the map says about a worst case."""
        return f"r = {self.correlation:g}, {self.trials} trials per cell"

    def draw(
        self, num_clusters: int, rng: np.random.Generator
    ) -> tuple[Float64[np.ndarray, " cells"], Float64[np.ndarray, " cells"]]:
        """Draw measured rates, recorded and simulated, cluster by cluster."""
        recorded, sim = self.measure(self.true_rates(num_clusters, rng), rng)
        return recorded / self.trials, sim / self.trials

    def measure(
        self, true_rates: Float64[np.ndarray, "sides cells"], rng: np.random.Generator
    ) -> Int64[np.ndarray, "sides cells"]:
        """Count successes of cells with these true rates."""
        return np.asarray(rng.binomial(self.trials, true_rates), dtype=np.int64)

    def true_rates(
        self, num_clusters: int, rng: np.random.Generator
    ) -> Float64[np.ndarray, "sides cells"]:
        """Draw true rates, recorded and simulated, cluster by cluster."""
        own, shared = (1 - self.cluster_share) ** 0.5, self.cluster_share**0.5
        size = (num_clusters, self.cells_per_cluster)
        alone = self._pairs(size, rng)
        together = self._pairs((num_clusters, 1), rng)
        rates = 0.05 + 0.9 * ndtr(own * alone + shared * together)
        return np.asarray(rates.reshape(2, -1))

    def _pairs(self, size: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
        first, second = rng.standard_normal((2, *size))
        rest = (1 - self.correlation**2) ** 0.5
        return np.array([first, self.correlation * first + rest * second])


POPULATIONS = tuple(
    Population(correlation=r, trials=trials) for r in (0.0, 0.5, 0.9) for trials in (10, 50)
)
CLUSTERED = tuple(
    Population(correlation=r, trials=trials, cluster_share=0.5, cells_per_cluster=3)
    for r in (0.0, 0.5, 0.9)
    for trials in (10, 50)
)
