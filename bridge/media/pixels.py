"""Pixels of cameras under the names that ROS has for them, as sRGB: what OpenCV makes of them."""

import numpy as np
from jaxtyping import Integer, UInt8

_ORDERS = {"rgb": "RGB", "bgr": "BGR", "rgba": "RGBA", "bgra": "BGRA", "mono": "G"}
_COUNTS = {"8UC1": ("G", 1), "8UC3": ("BGR", 1), "8UC4": ("BGRA", 1), "16UC3": ("BGR", 2)}
PACKED = _COUNTS | {f"{name}{8 * n}": (_ORDERS[name], n) for name in _ORDERS for n in (1, 2)}
"""The order of the channels, and bytes of each."""
BAYER = {
    f"bayer_{tile}{bits}": (tile, bits // 8)
    for tile in ("rggb", "bggr", "gbrg", "grbg")
    for bits in (8, 16)
}
"""Colours of the first four pixels, row by row, and bytes of each."""
YUV422 = {"yuv422": 1, "uyvy": 1, "yuv422_yuy2": 0, "yuyv": 0}
"""Where brightness stands in each pair of bytes."""
YUV420 = {"nv12": 0, "nv21": 1}
"""Where U stands in each pair of bytes behind the brightness."""
COLORS = (*PACKED, *BAYER, *YUV422, *YUV420)


def pixel_bytes(encoding: str) -> int:
    """Bytes from one pixel of a row to the next."""
    if encoding in PACKED:
        order, size = PACKED[encoding]
        return len(order) * size
    return 2 if encoding in YUV422 else BAYER.get(encoding, ("", 1))[1]


def num_rows(encoding: str, height: int) -> int:
    """Rows of bytes below each other, those of colours at the end included."""
    return height + height // 2 if encoding in YUV420 else height


def rgb_from(
    rows: UInt8[np.ndarray, "rows row"], encoding: str, *, swap_bytes: bool = False
) -> UInt8[np.ndarray, "height width 3"]:
    """Turn the bytes of an image, padding cut off, into sRGB of 8 bits.

    Args:
        encoding: One of ``COLORS``. Alpha is dropped, 16 bits are scaled by 1/257.

    Raises:
        ValueError: Of colours that several pixels share: the size does not go with them.
    """
    if encoding in YUV422:
        at = YUV422[encoding]
        shared = rows.reshape(len(rows), -1, 4)
        pairs = np.repeat(shared[..., [1 - at, 3 - at]], 2, axis=1)
        return _rgb_of_yuv(rows[:, at::2], pairs[..., 0], pairs[..., 1])
    if encoding in YUV420:
        height, u = len(rows) * 2 // 3, YUV420[encoding]
        shared = rows[height:].reshape(height // 2, -1, 2)
        pairs = shared.repeat(2, axis=0).repeat(2, axis=1)
        return _rgb_of_yuv(rows[:height], pairs[..., u], pairs[..., 1 - u])
    order, size = PACKED.get(encoding) or BAYER[encoding]
    values = np.ascontiguousarray(rows)
    values = values if size == 1 else values.view(">u2" if swap_bytes else "<u2")
    if encoding in BAYER:
        image = _mosaic_filled(values.astype(np.int32), order)
    else:
        image = values.reshape(len(rows), -1, len(order))
        image = image[..., [order.find(c) if len(order) > 1 else 0 for c in "RGB"]]
    return image.astype(np.uint8) if size == 1 else np.rint(image / 257).astype(np.uint8)


_ROUND, _SHIFT = 1 << 19, 20
_Y, _U_IN_B, _U_IN_G, _V_IN_G, _V_IN_R = 1220542, 2116026, -409993, -852492, 1673527
"""ITU-R BT.601 of 16 to 235, times 2 to the power of ``_SHIFT``."""


def _rgb_of_yuv(
    y: UInt8[np.ndarray, "height width"],
    u: UInt8[np.ndarray, "height width"],
    v: UInt8[np.ndarray, "height width"],
) -> UInt8[np.ndarray, "height width 3"]:
    light = np.maximum(y.astype(np.int64) - 16, 0) * _Y + _ROUND
    blue, red = u.astype(np.int64) - 128, v.astype(np.int64) - 128
    parts = (_V_IN_R * red, _V_IN_G * red + _U_IN_G * blue, _U_IN_B * blue)
    rgb = np.stack([light + part for part in parts], axis=-1) >> _SHIFT
    return np.asarray(np.clip(rgb, 0, 255).astype(np.uint8))


def _mosaic_filled(
    values: Integer[np.ndarray, "height width"], tile: str
) -> Integer[np.ndarray, "height width 3"]:
    """Put the mean of the nearest pixels of a colour where it is not; the rim is its neighbour."""
    height, width = values.shape
    if min(height, width) < 4:
        raise ValueError(f"a mosaic of {width} x {height} pixels")
    inner = (slice(1, -1), slice(1, -1))

    def moved(down: int, right: int) -> Integer[np.ndarray, "rows columns"]:
        return values[1 + down : height - 1 + down, 1 + right : width - 1 + right]

    beside, above = moved(0, -1) + moved(0, 1), moved(-1, 0) + moved(1, 0)
    corners = moved(-1, -1) + moved(-1, 1) + moved(1, -1) + moved(1, 1)
    cross, corners = (beside + above + 2) >> 2, (corners + 2) >> 2
    beside, above = (beside + 1) >> 1, (above + 1) >> 1
    image = np.zeros((height, width, 3), values.dtype)
    down, right = np.indices((height, width))[:, 1:-1, 1:-1] % 2
    for channel, colour in enumerate("rgb"):
        here = np.array([c == colour for c in tile]).reshape(2, 2)
        is_here, is_beside = here[down, right], here[down, 1 - right]
        is_above = here[1 - down, right]
        mean = np.where(is_beside, np.where(is_above, cross, beside), above)
        mean = np.where(is_beside | is_above, mean, corners)
        image[(*inner, channel)] = np.where(is_here, moved(0, 0), mean)
    return np.asarray(np.pad(image[inner], ((1, 1), (1, 1), (0, 0)), mode="edge"))
