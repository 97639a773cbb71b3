"""Run-length and variable-length depth coding (RVL) in NumPy, where the extension is not built.

Wilson, "Fast lossless depth image compression" (2017), in the layout ROS uses: runs of zeros and
of measurements alternate; each run is its length, each measurement the zigzag difference to the
measurement before it; numbers are 3 bits a nibble, lowest first, the top bit saying that more
follow; the first nibble is the highest of a little-endian 32-bit word.
``bridge.media.depth`` uses ``_depth`` (native) instead of this module when it can;
``tests/parity`` compares the two.
"""

import numpy as np
from jaxtyping import Int64, UInt16

MAX_LENGTH_NIBBLES = 11
"""A run length has at most 33 bits; an encoder writes no longer number."""
MAX_DELTA_NIBBLES = 6
"""The zigzag difference of two 16-bit numbers has at most 17 bits."""
_WORD_SHIFTS = np.arange(28, -4, -4, dtype=np.uint32)


def encode_rvl(depth: UInt16[np.ndarray, "height width"]) -> bytes:
    """Encode pixel by pixel, row after row.

    Returns:
        The nibble stream, a whole number of 32-bit words.
    """
    pixels = depth.reshape(-1).astype(np.int64)
    tokens = _tokens(pixels)
    bits = np.frexp(tokens.astype(np.float64))[1]  # exact: tokens stay far below 2**53
    counts = np.maximum((bits + 2) // 3, 1)
    places = np.arange(counts.max(initial=1))
    nibbles = (tokens[:, None] >> (3 * places)) & 7
    nibbles |= np.where(places < counts[:, None] - 1, 8, 0)
    stream = nibbles[places < counts[:, None]].astype(np.uint32)
    words = np.zeros((-(-len(stream) // 8), 8), dtype=np.uint32)
    words.reshape(-1)[: len(stream)] = stream
    packed = (words << _WORD_SHIFTS).sum(axis=1, dtype=np.uint32)
    return bytes(packed.astype("<u4").tobytes())


def _tokens(pixels: Int64[np.ndarray, " num_pixels"]) -> Int64[np.ndarray, " num_tokens"]:
    measured = pixels != 0
    values = pixels[measured]
    deltas = np.diff(values, prepend=0)
    zigzag = (deltas << 1) ^ (deltas >> 63)
    edges = np.flatnonzero(np.diff(measured, prepend=False, append=measured[-1:]))
    bounds = np.concatenate([[0], edges, [len(pixels)]])
    lengths = np.diff(bounds)  # zeros, measurements, zeros, ...
    if len(pixels) == 0:
        return np.zeros(0, dtype=np.int64)
    if len(lengths) % 2:
        lengths = np.append(lengths, 0)
    runs = lengths.reshape(-1, 2)
    before = np.concatenate([[0], np.cumsum(runs[:-1, 1])])
    return np.insert(zigzag, np.repeat(before, 2), runs.reshape(-1))


def decode_rvl(stream: bytes | memoryview, num_pixels: int) -> UInt16[np.ndarray, " num_pixels"]:
    """Decode a nibble stream; what follows the last pixel is ignored.

    Args:
        stream: Little-endian words of 32 bits, the highest nibble of each first.
        num_pixels: How many the image has, rows one after the other.

    Raises:
        ValueError: The stream ends early, or holds a number no encoder writes.
    """
    tokens, counts = _read_tokens(stream)
    pixels = np.zeros(num_pixels, dtype=np.uint16)
    at, token, previous = 0, 0, 0
    while at < num_pixels:
        zeros, measured = tokens[token : token + 2].tolist() + [0] * max(0, token + 2 - len(tokens))
        if token + 2 > len(tokens) or counts[token : token + 2].max() > MAX_LENGTH_NIBBLES:
            raise ValueError(_ENDS_EARLY)
        token += 2
        if zeros + measured > num_pixels - at or token + measured > len(tokens):
            raise ValueError(_ENDS_EARLY)
        at += zeros
        if measured:
            deltas = tokens[token : token + measured]
            values = previous + np.cumsum((deltas >> 1) ^ -(deltas & 1))
            too_long = counts[token : token + measured].max() > MAX_DELTA_NIBBLES
            if too_long or values.min() < 0 or values.max() > 65535:
                raise ValueError(_OUT_OF_RANGE)
            pixels[at : at + measured] = values
            previous = int(values[-1])
            at += measured
            token += measured
    return pixels


_ENDS_EARLY = "the RVL stream does not hold the pixels its header claims"
_OUT_OF_RANGE = "the RVL stream holds a value outside 16 bits"


def _read_tokens(
    stream: bytes | memoryview,
) -> tuple[Int64[np.ndarray, " num_tokens"], Int64[np.ndarray, " num_tokens"]]:
    words = np.frombuffer(stream, dtype="<u4", count=len(stream) // 4)
    nibbles = ((words[:, None] >> _WORD_SHIFTS) & 15).reshape(-1).astype(np.int64)
    ends = np.flatnonzero(nibbles < 8) + 1
    starts = np.concatenate([[0], ends[:-1]]) if len(ends) else ends
    counts = ends - starts
    if len(ends) == 0:
        return counts, counts
    nibbles = nibbles[: ends[-1]]
    places = np.arange(len(nibbles)) - np.repeat(starts, counts)
    parts = np.where(places < MAX_LENGTH_NIBBLES, (nibbles & 7) << (3 * np.minimum(places, 20)), 0)
    return np.add.reduceat(parts, starts), counts
