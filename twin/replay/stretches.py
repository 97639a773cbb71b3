"""Stretches of time in which something holds."""

import numpy as np
from jaxtyping import Bool, Int


def stretches(flags: Bool[np.ndarray, " num_steps"]) -> list[tuple[int, int]]:
    """First step of each run of True, and the one after its last."""
    edges = np.diff(np.concatenate([[0], flags.astype(np.int8), [0]]))
    first, end = np.flatnonzero(edges == 1).tolist(), np.flatnonzero(edges == -1).tolist()
    return list(zip(first, end, strict=True))


def stretches_ns(
    stamps_ns: Int[np.ndarray, " num_steps"], flags: Bool[np.ndarray, " num_steps"]
) -> list[tuple[int, int]]:
    """First and last stamp of each run of True."""
    return [(int(stamps_ns[first]), int(stamps_ns[end - 1])) for first, end in stretches(flags)]
