"""Typed Arrow columns from Python values and back, at once and without pandas.

``pyarrow.array`` and ``to_numpy`` load pandas wherever it is installed, which takes a third of a
second, and ``to_pylist`` takes a second for a million values. So columns are filled from buffers
and read out of them, in the layout that the Arrow columnar format, version 1, lays down.
Importing this module loads pyarrow.
"""

from array import array
from collections.abc import Sequence
from itertools import accumulate, chain, pairwise
from typing import Any

import numpy as np
import pyarrow as pa
from jaxtyping import Int32

from evaluator.memory import Packed, packed

TEXT, WHOLE, NUMBER, ANSWER = pa.string(), pa.int64(), pa.float64(), pa.bool_()
"""Column types in which unknown is null, never "", 0, NaN or False."""
SHARED_TEXT = pa.dictionary(pa.int32(), TEXT)
"""Texts as they are read where many rows share few: each place names one of a list."""
_NUMPY = {pa.int32(): np.int32, WHOLE: np.int64, NUMBER: np.float64}
_TAKEN: dict[pa.DataType, tuple[type, ...]] = {
    TEXT: (str,),
    pa.int32(): (int, np.integer),
    WHOLE: (int, np.integer),
    NUMBER: (float, int, np.floating, np.integer),
    ANSWER: (bool, np.bool_),
}
_NONE = packed()
_MOST = 2**31 - 1
"""Bytes of one column of texts, or values of one of lists: their places have 32 bits."""


def column_of(values: Sequence[Any], kind: pa.DataType) -> pa.Array | pa.ChunkedArray:
    """Fill a column.

    Args:
        values: Texts, whole numbers, numbers or answers, or for a list type sequences of them
            (arrays of doubles are the quickest); None is null.
        kind: One of the types above, or a list of one of them.

    Raises:
        TypeError: When a value is of another type.
        OverflowError: When a number needs more than 64 bits, or a list column has over 2^31 values.
        ValueError: When a text is no Unicode.
    """
    there = [value is not None for value in values]
    buffers = [None if all(there) else _bits(there)]
    if pa.types.is_list(kind):
        lists = [_NONE if value is None else value for value in values]
        inner = _inner(lists, kind.value_type)
        buffers.append(_buffer(_ends(map(len, lists))))
        return pa.Array.from_buffers(kind, len(values), buffers, children=[inner])
    _check(values, kind)
    if kind == TEXT:
        texts = [b"" if value is None else value.encode() for value in values]
        if sum(map(len, texts)) > _MOST:
            return pa.array(values, kind)  # which cuts it into pieces
        buffers += [_buffer(_ends(map(len, texts))), pa.py_buffer(b"".join(texts))]
    elif kind == ANSWER:
        buffers.append(_bits([bool(value) for value in values]))
    else:
        numbers = [0 if value is None else value for value in values]
        buffers.append(_buffer(np.array(numbers, dtype=_NUMPY[kind])))
    return pa.Array.from_buffers(kind, len(values), buffers)


def _inner(lists: Sequence[Any], kind: pa.DataType) -> pa.Array:
    if kind == NUMBER and all(isinstance(each, array) and each.typecode == "d" for each in lists):
        data = b"".join(lists)
        return pa.Array.from_buffers(kind, len(data) // 8, [None, pa.py_buffer(data)])
    return column_of(list(chain.from_iterable(lists)), kind)


def values_of(column: pa.ChunkedArray) -> list[Any]:
    """Read a column out, as what ``column_of`` was given; lists are tuples.

    Raises:
        ValueError: When a text is no Unicode.
    """
    return [value for piece in column.chunks for value in _values(piece)]


def arrays_of(column: pa.ChunkedArray) -> list[Packed | None]:
    """Read a column of lists of numbers out as packed arrays: a fifth of the time of tuples.

    Raises:
        ValueError: When a number within a list is missing.
    """
    return [each for piece in column.chunks for each in _arrays(piece)]


def _arrays(piece: pa.Array) -> list[Packed | None]:
    if piece.values.null_count:
        message = "a number is missing in a list"
        raise ValueError(message)
    first, end = piece.offset, piece.offset + len(piece)
    mask, ends, *_ = piece.buffers()
    places = _places(ends, end)[first:]
    start, data = piece.values.offset, piece.values.buffers()[1]
    numbers = memoryview(b"" if data is None else data).cast("B")
    found: list[Packed | None] = [
        packed(numbers[8 * (start + low) : 8 * (start + high)].tobytes())
        for low, high in pairwise(places)
    ]
    return _without_missing(found, piece, mask)


def _values(piece: pa.Array) -> list[Any]:
    if piece.type == SHARED_TEXT:
        texts, places = _values(piece.dictionary), _values(piece.indices)
        if not piece.null_count:
            return [texts[place] for place in places]
        return [None if place is None else texts[place] for place in places]
    first, end = piece.offset, piece.offset + len(piece)
    mask, *buffers = piece.buffers()
    if pa.types.is_list(piece.type):
        flat, places = _values(piece.values), _places(buffers[0], end)[first:]
        values: list[Any] = [tuple(flat[low:high]) for low, high in pairwise(places)]
    elif piece.type == TEXT:
        values = _texts(buffers[1], _places(buffers[0], end)[first:])
    elif piece.type == ANSWER:
        values = _read_bits(buffers[0], end)[first:]
    elif end:
        values = np.frombuffer(buffers[0], _NUMPY[piece.type], end)[first:].tolist()
    else:
        values = []
    return _without_missing(values, piece, mask)


def _without_missing(values: list[Any], piece: pa.Array, mask: pa.Buffer | None) -> list[Any]:
    if not piece.null_count:
        return values
    there = _read_bits(mask, piece.offset + len(piece))[piece.offset :]
    return [value if is_there else None for value, is_there in zip(values, there, strict=True)]


def _texts(buffer: pa.Buffer | None, places: list[int]) -> list[str]:
    data = b"" if buffer is None else buffer.to_pybytes()
    if data.isascii():  # a character is a byte: what is decoded at once is cut at the same places
        text = data.decode()
        return [text[low:high] for low, high in pairwise(places)]
    return [data[low:high].decode() for low, high in pairwise(places)]


def _check(values: Sequence[Any], kind: pa.DataType) -> None:
    found = {type(value) for value in values if value is not None}
    refused = [one for one in found if not issubclass(one, _TAKEN[kind])]
    if bool in found and kind != ANSWER:  # an answer is no number, though Python says it is one
        refused.append(bool)
    if refused:
        message = f"a column of {kind} does not take {refused[0].__name__}"
        raise TypeError(message)


def _ends(lengths: "map[int]") -> Int32[np.ndarray, " places"]:
    places = list(accumulate(lengths, initial=0))
    if places[-1] > _MOST:
        message = f"{places[-1]} values do not fit one column of lists"
        raise OverflowError(message)
    return np.array(places, dtype=np.int32)


def _places(buffer: pa.Buffer | None, end: int) -> list[int]:
    # A column without rows may leave out its buffers.
    return [0] if buffer is None or not end else np.frombuffer(buffer, np.int32, end + 1).tolist()


def _bits(flags: Sequence[bool]) -> pa.Buffer:
    return _buffer(np.packbits(np.array(flags, dtype=bool), bitorder="little"))


def _read_bits(buffer: pa.Buffer | None, end: int) -> list[bool]:
    if buffer is None or not end:
        return []
    bits = np.frombuffer(buffer, np.uint8, -(-end // 8))
    return np.unpackbits(bits, count=end, bitorder="little").view(bool).tolist()


def _buffer(values: np.ndarray) -> pa.Buffer:
    return pa.py_buffer(values.tobytes())
