"""Millions of records in little memory and time: curves as packed doubles, no search for cycles."""

import gc
from array import array
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    Packed = array[float]
else:  # before Python 3.12 the class takes no parameters
    Packed = array


@contextmanager
def without_collecting() -> Iterator[None]:
    """Let only reference counts free memory, as long as the block lasts.

    An evaluation makes frozen records by the million and drops them all at its end. Looking for
    cycles among them took a fifth of its time. For blocks that end: what follows a session does
    not use it.
    """
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


def packed(values: bytes = b"") -> Packed:
    """Pack doubles, given by their bytes; none by default."""
    return array("d", values)
