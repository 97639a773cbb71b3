"""Depth images: 16-bit PNG files, ROS's compressed depth (RVL, PNG), numbers to millimetres."""

import struct
from collections.abc import Iterable

import numpy as np
from jaxtyping import Float32, UInt8, UInt16

from bridge.errors import BridgeError
from bridge.media.color import MAX_PIXELS, UnreadableImageError, open_image

_BITS = {"L": "8 bits", "P": "8 bits and a palette", "RGB": "8 bits in 3 channels", "1": "1 bit"}
ROTATED_ENCODING = "rotated3"
"""The bits of each value are rotated right by three (APC 2016 files)."""


def decode_depth_png(data: bytes) -> UInt16[np.ndarray, "height width"]:
    """Decode a 16-bit greyscale PNG to its stored numbers."""
    with open_image(data) as image:
        if not image.mode.startswith("I"):
            found = f"depth has {_BITS.get(image.mode, image.mode)}"
            raise UnreadableImageError(found=found, expected="a 16-bit PNG of one channel")
        return np.asarray(image).astype(np.uint16)


def to_millimetres(
    stored: UInt16[np.ndarray, "height width"],
    *,
    unit_m: float,
    invalid_values: Iterable[int] = (0,),
    encoding: str = "",
) -> UInt16[np.ndarray, "height width"]:
    """Apply a folder's decode rules; every invalid code becomes 0."""
    rotated = encoding == ROTATED_ENCODING  # the bits of each, left by 13
    values = (stored >> np.uint16(3)) | (stored << np.uint16(13)) if rotated else stored
    invalid = np.isin(stored, list(invalid_values)) | (values == 0)
    millimetres = np.rint(values * (unit_m * 1e3))
    return np.where(invalid | (millimetres > 65535), 0, millimetres).astype(np.uint16)


def from_metres(
    depth_m: Float32[np.ndarray, "height width"],
) -> UInt16[np.ndarray, "height width"]:
    """Round metres to whole millimetres; NaN, infinity and what does not fit become 0.

    REP 118 says so of ``32FC1``: NaN is no measurement, infinity too near or too far.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        millimetres = np.rint(depth_m * np.float32(1e3))
        is_valid = (millimetres > 0) & (millimetres <= 65535)
    return np.where(is_valid, millimetres, 0).astype(np.uint16)


# Every image starts with 12 bytes: an int32, and two float32 that matter to depth in metres only.
# RVL then states its columns and rows (int32) before the nibble stream; PNG follows as a file.
# RVL is Wilson, "Fast lossless depth image compression" (2017): runs of zeros and of measurements
# alternate; each run is its length, each measurement the zigzag difference to the one before it;
# numbers are 3 bits a nibble, lowest first, the top bit saying that more follow; the first nibble
# is the highest of a little-endian 32-bit word.

try:
    from bridge.media._depth import decode_rvl, encode_rvl
except ImportError:

    def _not_built(*_: object) -> bytes:
        raise BridgeError("the depth codec is not built. robot-gst doctor says how to build it.")

    decode_rvl = encode_rvl = _not_built

PNG_MAGIC = b"\x89PNG"
_EXPECTED = "16-bit depth as PNG or RVL"
RVL_FORMAT = "16UC1; compressedDepth rvl"
_CONFIG = struct.pack("<iff", 0, 0.0, 0.0)
_RVL_FRONT_BYTES = len(_CONFIG) + 8


def pack_rvl(rows: UInt8[np.ndarray, "height row"], *, swap_bytes: bool = False) -> list[bytes]:
    """Encode 16-bit depth given as bytes.

    Returns:
        What a CompressedImage of ``RVL_FORMAT`` holds, in two parts.
    """
    height, width = rows.shape[0], rows.shape[1] // 2
    depth = np.ascontiguousarray(rows).view("<u2")
    stream = encode_rvl(depth.byteswap() if swap_bytes else depth)
    return [_CONFIG + struct.pack("<ii", width, height), stream]


def unpack(image_format: str, data: bytes) -> UInt16[np.ndarray, "height width"]:
    """Decode a compressed depth image to its stored numbers; metres become millimetres.

    Args:
        image_format: As the CompressedImage states it; without ``rvl`` it is PNG. A bare PNG file
            is read whatever the format says.
    """
    if data.startswith(PNG_MAGIC):
        return _unpack_png(data)
    encoding, _, transport = image_format.partition(";")
    kind = transport.replace("compressedDepth", "").strip()
    if encoding.strip() not in ("16UC1", "mono16", "32FC1") or kind not in ("rvl", "png", ""):
        raise _unreadable(f"format {image_format[:80]!r}")
    stored = _unpack_rvl(data) if kind == "rvl" else _unpack_png(data[len(_CONFIG) :])
    if encoding.strip() != "32FC1":
        return stored
    _, scale, shift = struct.unpack_from("<iff", data)  # stored is scale / metres + shift
    with np.errstate(divide="ignore"):
        depth_m = np.float32(scale) / (stored.astype(np.float32) - np.float32(shift))
    return from_metres(np.where(stored == 0, np.float32(0), depth_m))


def _unpack_png(data: bytes) -> UInt16[np.ndarray, "height width"]:
    try:
        return decode_depth_png(data)
    except UnreadableImageError as error:
        raise _unreadable(error.found) from error


def _unpack_rvl(data: bytes) -> UInt16[np.ndarray, "height width"]:
    if len(data) < _RVL_FRONT_BYTES:
        raise _unreadable(f"{len(data)} bytes of RVL depth")
    width, height = struct.unpack_from("<ii", data, len(_CONFIG))
    if width <= 0 or height <= 0 or width * height > MAX_PIXELS:
        raise _unreadable(f"RVL depth of {width} x {height} pixels")
    try:
        pixels = decode_rvl(memoryview(data)[_RVL_FRONT_BYTES:], width * height)
    except ValueError as error:
        raise _unreadable(str(error)) from error
    return np.asarray(pixels).reshape(height, width)


def _unreadable(found: str) -> UnreadableImageError:
    return UnreadableImageError(found=found, expected=_EXPECTED)
