"""Checksums against zlib, with and without the native function."""

import os
import sys
import zlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.episode.mcap import format

START = st.integers(0, 2**32 - 1)


@pytest.mark.parity
@given(data=st.binary(max_size=700), start=START, skip=st.integers(0, 20))
def test_any_start_length_and_place_in_memory_gives_zlibs_answer(
    data: bytes, start: int, skip: int
) -> None:
    piece = memoryview(data)[skip:]
    assert format.crc32(piece, start) == zlib.crc32(piece, start)


@pytest.mark.parity
@pytest.mark.parametrize("size", [65_535, 65_536, 1_000_003])
def test_large_buffers_of_every_kind_give_zlibs_answer(size: int) -> None:
    data = os.urandom(size)
    for buffer in (data, bytearray(data), memoryview(data)):
        assert format.crc32(buffer, 5) == zlib.crc32(data, 5)


def test_without_the_extension_zlib_does_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "bridge.episode._crc32", None)
    monkeypatch.delattr("bridge.episode._crc32", raising=False)
    assert format._fastest() is zlib.crc32
