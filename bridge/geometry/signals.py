"""Signals over time: where a flag holds, and by how much one signal comes later than another."""

import numpy as np
from jaxtyping import Bool, Float

LAGS_S = np.arange(-20, 61) / 100
"""Delays that are tried between two motions: -0.2 s to 0.6 s in steps of 10 ms."""
EQUAL_M = 1e-5
"""Delays whose mean distances differ by less fit equally well."""


def runs_of_true(flags: Bool[np.ndarray, " num_steps"]) -> list[tuple[int, int]]:
    """First step of each run of True, and the one after its last."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    return [(int(first), int(end)) for first, end in edges.reshape(-1, 2)]


def lag_of_least_cost(costs_m: Float[np.ndarray, " num_lags"]) -> float:
    """Choose which of ``LAGS_S`` two motions differ least at [s].

    Of lags that fit equally well the smallest is taken: a motion that hardly moves has none.
    """
    near = LAGS_S[costs_m <= costs_m.min() + EQUAL_M]
    return float(near[np.argmin(np.abs(near))])
