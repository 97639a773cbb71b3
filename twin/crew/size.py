"""How many processes work side by side where nobody said a number."""

import os

MOST = 8
"""Each takes up to half a gigabyte; more are used when they are asked for."""


def default_size() -> int:
    """One process for each core that this one may use, and no more than ``MOST``."""
    try:
        cores = len(os.sched_getaffinity(0))
    except AttributeError:  # not on this system
        cores = os.cpu_count() or 1
    return min(MOST, cores)
