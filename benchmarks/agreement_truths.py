"""True success rates on which the model of agreement is judged, fixed before the first result.

Every truth is a population of groups: a pair of normal numbers with correlation ``rho``, turned
into a recorded rate and a rate of the twin. Judged is whether an interval holds the correlation and
the mean difference of the rates of that population. Groups of a task share a part of their numbers.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.special import ndtr, ndtri
from scipy.stats import beta

RHOS = (0.0, 0.6, 0.95)
NUM_GROUPS = (4, 5, 6, 7, 8, 12, 20, 30)
NUM_TRIALS = (5, 10, 20, 50)
SIM_FACTORS = (1, 10)
"""Trials of the twin for each recorded one: as many, or ten times as many."""
SHARED = 0.6
"""Part of the variance that groups of a task share, where groups are clustered."""
POLICIES = 3
NODES = 61


@dataclass(frozen=True, kw_only=True)
class Truth:
    """One population of groups."""

    shape: str
    """A name in ``SHAPES``."""
    rho: float
    clustered: bool = False
    """Whether ``POLICIES`` groups at a time share a task."""

    @property
    def name(self) -> str:
        """Shape and correlation in words."""
        return f"{self.shape}{', by task' if self.clustered else ''}, rho {self.rho:g}"

    def rates(
        self, normal: Float64[np.ndarray, "*groups sides"]
    ) -> Float64[np.ndarray, "*groups sides"]:
        """Turn standard normal numbers into recorded and twin rates."""
        share = ndtr(normal)
        recorded, sim = SHAPES[self.shape]
        return np.stack([recorded(share[..., 0]), sim(share[..., 1])], axis=-1)

    def population(self) -> tuple[float, float]:
        """Return the correlation of both rates over the population, and the mean difference."""
        steps = (np.arange(NODES * 8) + 0.5) / (NODES * 8)

        first = ndtri(steps)[:, None]
        second = self.rho * first + np.sqrt(1 - self.rho**2) * ndtri(steps)[None, :]
        normal = np.stack(np.broadcast_arrays(first, second), axis=-1)
        rates = self.rates(normal).reshape(-1, 2)
        r = float(np.corrcoef(rates.T)[0, 1])
        return r, float((rates[:, 1] - rates[:, 0]).mean())

    def draw(self, num_groups: int, rng: np.random.Generator) -> Float64[np.ndarray, "groups 2"]:
        """Draw the true rates of some groups."""
        chol = np.linalg.cholesky(np.array([[1.0, self.rho], [self.rho, 1.0]]))
        normal = rng.standard_normal((num_groups, 2))
        if self.clustered:
            tasks = np.array(self.tasks(num_groups))
            shared = rng.standard_normal((tasks.max() + 1, 2))[tasks]
            normal = np.sqrt(SHARED) * shared + np.sqrt(1 - SHARED) * normal
        return self.rates(normal @ chol.T)

    def tasks(self, num_groups: int) -> list[int]:
        """Return the task of each group; each its own where they are not clustered."""
        return [place // POLICIES if self.clustered else place for place in range(num_groups)]


def _zeros(share: Float64[np.ndarray, "*groups"], part: float) -> Float64[np.ndarray, "*groups"]:
    above = np.clip((share - part) / (1 - part), 0.0, 1.0)
    return np.where(share < part, 0.0, beta.ppf(above, 1.0, 2.0))


def _levels(share: Float64[np.ndarray, "*groups"], top: float) -> Float64[np.ndarray, "*groups"]:
    within = np.where(share < 0.5, 2 * share, 2 * share - 1)
    return np.where(share < 0.5, 0.1, top - 0.1) + 0.1 * within


SHAPES = {
    "middling": (lambda u: beta.ppf(u, 2, 2), lambda u: beta.ppf(u, 2.5, 2)),
    "U-shaped": (lambda u: beta.ppf(u, 0.4, 0.4), lambda u: beta.ppf(u, 0.5, 0.4)),
    "full of zeros": (lambda u: _zeros(u, 0.4), lambda u: _zeros(u, 0.3)),
    "two levels": (lambda u: _levels(u, 0.8), lambda u: _levels(u, 0.9)),
}
"""How a share of the population becomes a recorded rate, and a rate of the twin."""
TRUTHS = (
    *(Truth(shape=shape, rho=rho) for shape in SHAPES for rho in RHOS),
    *(
        Truth(shape=shape, rho=rho, clustered=True)
        for shape in ("middling", "U-shaped")
        for rho in RHOS
    ),
)
FEWEST_CLUSTERED = 12
"""Groups from which truths by task are asked for: four tasks of three policies."""
