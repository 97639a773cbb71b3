"""Stretches of time in which something holds."""

import numpy as np
from jaxtyping import Bool, Int


def stretches_ns(
    stamps_ns: Int[np.ndarray, " num_steps"], flags: Bool[np.ndarray, " num_steps"]
) -> list[tuple[int, int]]:
    """First and last stamp of each run of True."""
    edges = np.diff(np.concatenate([[0], flags.astype(np.int8), [0]]))
    first, last = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1) - 1
    return [(int(stamps_ns[a]), int(stamps_ns[b])) for a, b in zip(first, last, strict=True)]
