"""CRC-32 as fast as the machine can, and of two pieces without reading them again.

The CRC of a whole file is wanted beside the CRC of every chunk; reading each image twice would
cost as much as writing it. A CRC-32 is a remainder of polynomials over GF(2): appending n bytes
multiplies the first remainder by x^(8n). Bit 31 of the reflected form is the coefficient of x^0.
"""

import zlib
from collections.abc import Callable
from functools import lru_cache
from importlib import import_module

from bridge.episode.mcap.format import Buffer


def _fastest() -> Callable[[Buffer, int], int]:
    """Return the native function where it is built and the processor has the instruction."""
    try:
        native = import_module("bridge.episode._crc32")
    except ImportError:
        return zlib.crc32
    return native.crc32 if native.is_fast() else zlib.crc32


crc32 = _fastest()
"""``crc32(data, value)`` continues from ``value``, 0 at first, as ``zlib.crc32`` does."""

_POLYNOMIAL = 0xEDB88320
_ONE = 1 << 31


def _times(a: int, b: int) -> int:
    """Multiply two polynomials modulo the CRC's."""
    product = 0
    while a:
        if a & _ONE:
            product ^= b
        a = (a << 1) & 0xFFFF_FFFF
        b = (b >> 1) ^ _POLYNOMIAL if b & 1 else b >> 1
    return product


def _powers() -> list[int]:
    """Return x^8, x^16, x^32, ... for lengths of up to 2^64 bytes."""
    power = _ONE >> 8
    found = []
    for _ in range(64):
        found.append(power)
        power = _times(power, power)
    return found


_X_POWERS = _powers()


@lru_cache(maxsize=512)
def _shift(num_bytes: int) -> int:
    factor, place = _ONE, 0
    while num_bytes:
        if num_bytes & 1:
            factor = _times(_X_POWERS[place], factor)
        num_bytes >>= 1
        place += 1
    return factor


def joined_crc(first: int, second: int, second_length: int) -> int:
    """Return the CRC-32 of two pieces from that of each.

    Args:
        first: CRC of the first piece.
        second: CRC of the second piece.
        second_length: Bytes in the second piece.
    """
    return _times(_shift(second_length), first) ^ second
