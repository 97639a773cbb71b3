"""A curve as packed doubles: kept, compared and handed on without a Python object per number."""

from array import array
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    Packed = array[float]
else:  # before Python 3.12 the class takes no parameters
    Packed = array


def packed(values: bytes = b"") -> Packed:
    """Pack doubles, given by their bytes; none by default."""
    return array("d", values)
