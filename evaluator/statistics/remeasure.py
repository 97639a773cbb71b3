"""Where each statistic of agreement would fall if the same cells were measured again.

A band of measurement noise, not an interval of a true value: the noise itself pulls a correlation
towards 0 and errors away from it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float64

from evaluator.errors import UndefinedStatisticError
from evaluator.result import Interval
from evaluator.statistics.bootstrap import weighted_ends
from evaluator.statistics.columns import counted_cells
from evaluator.statistics.proportion import LEVEL
from evaluator.statistics.scales import NEAR, SCALES
from evaluator.statistics.weighted import values_of

NUM_DRAWS = 4_000
MIN_CELLS = 3
WHAT = "remeasurement band"


@dataclass(frozen=True)
class Remeasured:
    """Measured rates of each cell, and rates as they might have come out."""

    recorded: Float64[np.ndarray, " cells"]
    sim: Float64[np.ndarray, " cells"]
    recorded_again: Float64[np.ndarray, "draws cells"]
    sim_again: Float64[np.ndarray, "draws cells"]

    @cached_property
    def _every(self) -> Float64[np.ndarray, "draws cells"]:
        return np.ones_like(self.recorded_again)

    def band(self, statistic: str, *, level: float = LEVEL) -> Interval:
        """Return where a statistic would fall.

        Two measurements differ by sqrt(2) times the spread of one, around the value that was
        found; on Fisher's scale for correlations and shares, on the logarithm for errors.

        Raises:
            UndefinedStatisticError: Below 3 cells, when the statistic is undefined or at the end
                of its range, or when no redrawn rate changes it.
        """
        if len(self.recorded) < MIN_CELLS:
            reason = f"{counted_cells(len(self.recorded))}; it needs at least {MIN_CELLS}"
            raise UndefinedStatisticError(statistic=WHAT, reason=reason)
        scale = SCALES[statistic]
        (value,), (known,) = values_of(statistic, self._every[:1], self.recorded, self.sim)
        if not known:
            raise UndefinedStatisticError(statistic=WHAT, reason="the statistic is undefined")
        scale.refuse_limit(WHAT, float(value))
        values, defined = values_of(statistic, self._every, self.recorded_again, self.sim_again)
        weights = np.full(len(values), 1 / len(values))
        ends = weighted_ends(values, defined, weights, (1 - level) / 2, WHAT)
        low, high = (scale.there(end) for end in ends)
        centre, half = scale.there(float(value)), math.sqrt(2) * (high - low) / 2
        if half < NEAR:
            reason = "no other outcome of the trials changes it"
            raise UndefinedStatisticError(statistic=WHAT, reason=reason)
        return Interval(
            low=scale.clip(scale.back(centre - half)),
            high=scale.clip(scale.back(centre + half)),
            level=level,
            method="remeasurement",
        )


def remeasure_paired(
    tables: Sequence[tuple[int, int, int, int]],
    *,
    rng: np.random.Generator,
    num_draws: int = NUM_DRAWS,
) -> Remeasured:
    """Draw each cell's table of trials anew: both succeed, only sim, only recorded, neither.

    From a multinomial with the observed shares, 1/4 added to each count.

    Raises:
        UndefinedStatisticError: When a cell has no trial.
    """
    if any(sum(table) == 0 for table in tables):
        raise UndefinedStatisticError(statistic=WHAT, reason="a cell has no trial with both sides")
    counts = np.array(tables, dtype=np.float64).reshape(-1, 4)
    totals = counts.sum(axis=1)
    recorded, sim = [], []
    for table, total in zip(counts, totals.astype(int).tolist(), strict=True):
        again = rng.multinomial(total, (table + 0.25) / (total + 1), size=num_draws)
        recorded.append((again[:, 0] + again[:, 2]) / total)
        sim.append((again[:, 0] + again[:, 1]) / total)
    return Remeasured(
        (counts[:, 0] + counts[:, 2]) / totals,
        (counts[:, 0] + counts[:, 1]) / totals,
        np.array(recorded).reshape(len(tables), num_draws).T,
        np.array(sim).reshape(len(tables), num_draws).T,
    )


def remeasure_counts(
    recorded: Sequence[tuple[int, int]],
    sim: Sequence[tuple[int, int]],
    *,
    rng: np.random.Generator,
    num_draws: int = NUM_DRAWS,
) -> Remeasured:
    """Draw counts (k, n) anew, of sides whose trials are not paired; 1/2 added to each count."""
    found, drawn = [], []
    for side in (recorded, sim):
        found.append(np.array([k / n for k, n in side]))
        again = [rng.binomial(n, (k + 0.5) / (n + 1), size=num_draws) / n for k, n in side]
        drawn.append(np.array(again).reshape(len(side), num_draws).T)
    return Remeasured(found[0], found[1], drawn[0], drawn[1])
