"""Work on many images with a few threads; NumPy and the image decoders let go of the interpreter.

Episodes are read and compared by processes: ``workers``.
"""

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

MAX_THREADS = 8
"""More only cost memory: each holds the images it works on."""


def spread(
    work: Callable[[Item], Result], items: Iterable[Item], *, threads: int | None = None
) -> list[Result]:
    """Call ``work`` on each item and return the results in the order of the items.

    Args:
        work: Must not share anything that changes.
        items: What to work on.
        threads: How many at once; as many as there are cores without it.
    """
    count = min(MAX_THREADS, os.cpu_count() or 1) if threads is None else threads
    if count <= 1:
        return [work(item) for item in items]
    with ThreadPoolExecutor(max_workers=count) as pool:
        return list(pool.map(work, items))
