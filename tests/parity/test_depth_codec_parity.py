"""RVL in C++, and nibble by nibble as the paper tells it; PNG against OpenCV."""

from collections.abc import Iterator
from itertools import groupby

import hypothesis.extra.numpy as hnp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from bridge.media.depth import unpack

native = pytest.importorskip("bridge.media._depth")
pytestmark = pytest.mark.parity

plain = hnp.arrays(np.uint16, st.integers(0, 300))
holed = hnp.arrays(
    np.uint16, st.integers(0, 300), elements=st.sampled_from([0, 1, 7, 8, 4095, 4096, 65535])
)
smooth = st.builds(
    lambda steps, start: (start + np.cumsum(steps)).astype(np.uint16),
    hnp.arrays(np.int8, st.integers(1, 300)),
    st.integers(0, 65535),
)
pixels = st.one_of(plain, holed, smooth)
# Bytes whose nibbles mostly end a number, so that streams get far before they break.
mostly_short = st.lists(st.sampled_from([0, 1, 0x10, 0x11, 0x22, 0x91, 0x19, 0xF7]), max_size=200)
streams = st.one_of(st.binary(max_size=200), mostly_short.map(bytes))


def reference_encode(values: list[int]) -> bytes:
    nibbles: list[int] = []

    def put(number: int) -> None:
        while number > 7:
            nibbles.append(number & 7 | 8)
            number >>= 3
        nibbles.append(number)

    before = 0
    for is_zero, group in groupby(values, key=lambda value: value == 0):
        run = list(group)
        if not is_zero and not nibbles:
            put(0)  # no zeros before the first run
        put(len(run))
        for value in () if is_zero else run:
            delta = value - before
            put(2 * delta if delta >= 0 else -2 * delta - 1)
            before = value
    if values and not values[-1]:
        put(0)  # no run after the last zeros
    digits = "".join(f"{nibble:x}" for nibble in nibbles)
    digits += "0" * (-len(digits) % 8)
    return b"".join(bytes.fromhex(digits[i : i + 8])[::-1] for i in range(0, len(digits), 8))


def reference_decode(stream: bytes, count: int) -> list[int]:
    def nibbles() -> Iterator[int]:
        for start in range(0, len(stream) // 4 * 4, 4):
            for byte in stream[start : start + 4][::-1]:
                yield byte >> 4
                yield byte & 15
        raise ValueError

    source = nibbles()

    def take(most: int) -> int:
        number = 0
        for place in range(most):
            nibble = next(source)
            number |= (nibble & 7) << (3 * place)
            if nibble < 8:
                return number
        raise ValueError

    values: list[int] = []
    before = 0
    while len(values) < count:
        zeros = take(11)
        run = take(11)
        if zeros + run > count - len(values):
            raise ValueError
        values += [0] * zeros
        for _ in range(run):
            coded = take(6)
            before += -((coded + 1) // 2) if coded & 1 else coded // 2
            if not 0 <= before <= 65535:
                raise ValueError
            values.append(before)
    return values


@given(pixels)
def test_both_encode_the_same_bytes(values: np.ndarray) -> None:
    expected = reference_encode(values.tolist())
    assert native.encode_rvl(values) == expected


@given(pixels)
def test_both_decode_what_was_encoded(values: np.ndarray) -> None:
    stream = reference_encode(values.tolist())
    np.testing.assert_array_equal(native.decode_rvl(stream, len(values)), values)
    assert reference_decode(stream, len(values)) == values.tolist()


@settings(max_examples=400)
@given(streams, st.integers(0, 400))
@example(bytes(4), 1)
@example(b"\xff" * 40, 3)
def test_both_agree_on_what_is_broken(stream: bytes, count: int) -> None:
    try:
        expected = reference_decode(stream, count)
    except (ValueError, RuntimeError):
        with pytest.raises(ValueError, match="the RVL stream"):
            native.decode_rvl(stream, count)
        return
    np.testing.assert_array_equal(native.decode_rvl(stream, count), expected)


@pytest.mark.parametrize("ending", range(24))
def test_streams_end_at_every_place_of_a_word(ending: int) -> None:
    """Every fill of the last word, with numbers of every length across its edge."""
    for last in (1, 3, 40, 300, 3000, 20_000):
        values = np.array([5] * ending + [5 + last], dtype=np.uint16)
        assert native.encode_rvl(values) == reference_encode(values.tolist())


def test_a_noisy_frame_with_holes_agrees() -> None:
    rng = np.random.default_rng(0)
    slope = np.linspace(600, 4000, 640 * 480)
    frame = np.rint(slope + rng.normal(size=slope.size) * 1.2e-6 * slope**2).astype(np.uint16)
    frame[rng.random(frame.size) < 0.1] = 0
    stream = native.encode_rvl(frame)
    assert stream == reference_encode(frame.tolist())
    np.testing.assert_array_equal(native.decode_rvl(stream, frame.size), frame)


def test_the_extension_takes_whole_pixels_only() -> None:
    with pytest.raises(ValueError, match="16-bit pixels"):
        native.encode_rvl(b"abc")
    with pytest.raises(ValueError, match="at most"):
        native.decode_rvl(b"", 1 << 29)
    with pytest.raises((BufferError, ValueError)):
        native.encode_rvl(np.zeros((4, 4), dtype=np.uint16)[:, ::2])
    with pytest.raises(TypeError):
        native.decode_rvl(b"", -1)


@given(hnp.arrays(np.uint16, (5, 7)))
@settings(max_examples=25)
def test_depth_png_of_opencv_is_read(depth: np.ndarray) -> None:
    cv2 = pytest.importorskip("cv2")
    data = bytes(12) + cv2.imencode(".png", depth)[1].tobytes()
    np.testing.assert_array_equal(unpack("16UC1; compressedDepth png", data), depth)
