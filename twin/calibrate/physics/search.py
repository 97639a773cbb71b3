"""Look for the best point: the covariance matrix adaptation evolution strategy.

Hansen, "The CMA evolution strategy: a tutorial" (2016), in the package ``cmaes``. All points see
the same noise (common random numbers), so that differences between them are the parameters' own.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from cmaes import CMA
from jaxtyping import Float

SIGMA = 0.6
"""First step size in units of the prior."""
NARROW = 0.03
"""The search ends when every parameter is searched for within this."""

Worth = Callable[[Float[np.ndarray, "num_points num_parameters"]], list[float]]
"""Log-posterior of each point."""


@dataclass(frozen=True, kw_only=True)
class Best:
    """Where the search ended."""

    x: Float[np.ndarray, " num_parameters"]
    log_posterior: float
    num_evaluations: int


def search(
    worth: Worth,
    bounds: Float[np.ndarray, "num_parameters 2"],
    *,
    evaluations: int,
    seed: int,
    has_time: Callable[[], bool],
    advance: Callable[[int, str], None],
) -> Best:
    """Maximise from the nominal point.

    Args:
        worth: The log-posterior.
        bounds: Limits of each parameter.
        evaluations: At most so many points; a generation that was begun is finished.
        seed: Of the points that are drawn.
        has_time: Asked before each generation.
        advance: Told how many points were tried.
    """
    start = np.zeros(len(bounds))
    best = Best(x=start, log_posterior=worth(start[None])[0], num_evaluations=1)
    if len(bounds) < 2:  # the package asks for at least two dimensions
        bounds = np.concatenate([bounds, [[-1.0, 1.0]]])
    size = len(start)
    optimiser = CMA(mean=np.zeros(len(bounds)), sigma=SIGMA, bounds=bounds, seed=seed)
    count = 1
    while count < evaluations and has_time():
        points = np.stack([optimiser.ask() for _ in range(optimiser.population_size)])
        values = worth(points[:, :size])
        optimiser.tell([(x, -value) for x, value in zip(points, values, strict=True)])
        count += len(points)
        top = int(np.argmax(values))
        if values[top] > best.log_posterior:
            best = Best(x=points[top, :size], log_posterior=values[top], num_evaluations=count)
        advance(count, f"best log-posterior {best.log_posterior:.1f}")
        spread = np.std(points[:, :size], axis=0)
        if optimiser.should_stop() or float(spread.max()) < NARROW:
            break
    return Best(x=best.x, log_posterior=best.log_posterior, num_evaluations=count)
