"""Every encoding of ROS images, against the conversions of OpenCV that cv_bridge calls."""

import struct

import numpy as np
import pytest

from bridge.episode import schema
from bridge.episode.cdr import codec
from bridge.episode.cdr.messages import DepthImage, color_from_message
from bridge.media.pixels import COLORS

cv2 = pytest.importorskip("cv2")
pytestmark = pytest.mark.parity

RGB = {"rgb": None, "bgr": "BGR2RGB", "rgba": "RGBA2RGB", "bgra": "BGRA2RGB", "mono": "GRAY2RGB"}
CHANNELS = {"rgb": 3, "bgr": 3, "rgba": 4, "bgra": 4, "mono": 1}
PLAIN = {f"{name}{bits}": (name, bits) for name in RGB for bits in (8, 16)}
PLAIN |= {"8UC1": ("mono", 8), "8UC3": ("bgr", 8), "8UC4": ("bgra", 8), "16UC3": ("bgr", 16)}
SECOND_ROW = {"rggb": "BG", "bggr": "RG", "gbrg": "GR", "grbg": "GB"}
"""OpenCV names a mosaic by its second row."""
MOSAIC = {f"bayer_{t}{b}": (f"Bayer{n}2RGB", b) for t, n in SECOND_ROW.items() for b in (8, 16)}
PAIRS = {"yuv422": "UYVY", "uyvy": "UYVY", "yuv422_yuy2": "YUY2", "yuyv": "YUY2"}
PLANES = {"nv12": "NV12", "nv21": "NV21"}
EVERY = [*PLAIN, *MOSAIC, *PAIRS, *PLANES]


def stored_and_rgb(encoding: str, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Random pixels as a camera stores them, and what OpenCV makes of those."""
    rng = np.random.default_rng(abs(hash((height, width))))
    if encoding in PLAIN or encoding in MOSAIC:
        name, bits = PLAIN[encoding] if encoding in PLAIN else MOSAIC[encoding]
        shape = (height, width, CHANNELS.get(name, 1))
        stored = rng.integers(0, 1 << bits, shape, dtype=f"u{bits // 8}")
        code = RGB.get(name, name)
        rgb = stored if code is None else cv2.cvtColor(stored, getattr(cv2, f"COLOR_{code}"))
        return stored, rgb if bits == 8 else cv2.convertScaleAbs(rgb, alpha=255 / 65535)
    if encoding in PAIRS:
        stored = rng.integers(0, 256, (height, width, 2), dtype=np.uint8)
        return stored, cv2.cvtColor(stored, getattr(cv2, f"COLOR_YUV2RGB_{PAIRS[encoding]}"))
    stored = rng.integers(0, 256, (height * 3 // 2, width), dtype=np.uint8)
    return stored, cv2.cvtColor(stored, getattr(cv2, f"COLOR_YUV2RGB_{PLANES[encoding]}"))


def message(stored: np.ndarray, encoding: str, height: int, width: int, **fields: object) -> bytes:
    """A sensor_msgs/Image whose rows have three bytes more than they need."""
    rows = np.ascontiguousarray(stored).view(np.uint8).reshape(len(stored), -1)
    wide = np.pad(rows, ((0, 0), (0, 3)), constant_values=0xAB)
    said = {"height": height, "width": width, "encoding": encoding, "step": wide.shape[1]}
    return codec.encode(schema.IMAGE, {**said, "data": wide.tobytes(), **fields})


def test_nothing_is_read_that_is_not_compared() -> None:
    assert sorted(EVERY) == sorted(COLORS)


@pytest.mark.parametrize("encoding", EVERY)
@pytest.mark.parametrize("size", [(32, 48), (4, 6), (5, 7), (33, 50)])
def test_colour_is_that_of_opencv_to_the_last_bit(encoding: str, size: tuple[int, int]) -> None:
    if encoding in PAIRS or encoding in PLANES:
        size = (size[0] + size[0] % 2, size[1] + size[1] % 2)
    stored, rgb = stored_and_rgb(encoding, *size)
    found = color_from_message(schema.IMAGE, message(stored, encoding, *size))
    np.testing.assert_array_equal(found.image_u8(), rgb)
    if stored.dtype == np.uint16:
        swapped = message(stored.byteswap(), encoding, *size, is_bigendian=1)
        np.testing.assert_array_equal(color_from_message(schema.IMAGE, swapped).image_u8(), rgb)


@pytest.mark.parametrize("encoding", ["bayer_rggb8", "yuv422", "nv12", "rgb16", "8UC3"])
def test_every_encoding_can_be_shown(encoding: str) -> None:
    stored, rgb = stored_and_rgb(encoding, 32, 48)
    shown = color_from_message(schema.IMAGE, message(stored, encoding, 32, 48)).as_file()
    decoded = cv2.cvtColor(cv2.imdecode(np.frombuffer(shown, np.uint8), 1), cv2.COLOR_BGR2RGB)
    assert decoded.shape == rgb.shape
    assert abs(float(decoded.mean()) - float(rgb.mean())) < 4


@pytest.mark.parametrize(
    ("encoding", "size", "found"),
    [
        ("yuv422", (4, 5), "4 pixels of yuv422|5 x 4 pixels of yuv422"),
        ("nv12", (4, 5), "5 x 4 pixels of nv12"),
        ("bayer_gbrg8", (3, 8), "a mosaic of 8 x 3"),
        ("nv24", (4, 4), "encoding 'nv24' cannot be read.*Have the camera send one of"),
        ("8UC2", (4, 4), "encoding '8UC2' cannot be read"),
        ("nv21", (6, 4), "bytes for 9 rows"),
    ],
)
def test_what_no_camera_can_mean_is_refused(
    encoding: str, size: tuple[int, int], found: str
) -> None:
    stored = np.zeros((size[0], size[1] * 2), dtype=np.uint8)
    with pytest.raises(codec.MalformedMessageError, match=found):
        color_from_message(schema.IMAGE, message(stored, encoding, *size)).image_u8()


def test_depth_in_metres_is_unpacked_as_image_transport_packs_it() -> None:
    """Its codec: 16 bits of (a / metres + b), 0 where nothing was measured."""
    metres = np.random.default_rng(0).uniform(0.3, 9.0, (24, 32)).astype(np.float32)
    metres[3:5] = np.nan
    a, b = 100.0 * (100.0 + 1), 1 - 100.0 * (100.0 + 1) / 10.0
    packed = np.nan_to_num(a / metres + b).astype(np.uint16)
    png = cv2.imencode(".png", packed)[1].tobytes()
    data = codec.encode(
        schema.COMPRESSED_IMAGE,
        {"format": "32FC1; compressedDepth png", "data": struct.pack("<iff", 0, a, b) + png},
    )
    found = DepthImage.from_message(schema.COMPRESSED_IMAGE, data).depth_mm.astype(float) / 1e3
    assert (found[3:5] == 0).all()
    kept = np.isfinite(metres)
    step_m = metres[kept] ** 2 / a
    assert (np.abs(found[kept] - metres[kept]) <= step_m + 6e-4).all()


def test_grey_of_16_bits_in_a_png_is_scaled_and_not_cut() -> None:
    grey = np.random.default_rng(1).integers(0, 65536, (8, 9), dtype=np.uint16)
    about = {"format": "mono16; png compressed ", "data": cv2.imencode(".png", grey)[1].tobytes()}
    data = codec.encode(schema.COMPRESSED_IMAGE, about)
    found = color_from_message(schema.COMPRESSED_IMAGE, data).image_u8()
    np.testing.assert_array_equal(found[..., 1], cv2.convertScaleAbs(grey, alpha=255 / 65535))
