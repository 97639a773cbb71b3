"""Lenses against OpenCV: where points are seen, in straightened images, and what is refused."""

import numpy as np
import pytest
from jaxtyping import Float

from bridge.episode.cdr import codec
from bridge.episode.cdr.codec import MalformedMessageError
from bridge.episode.cdr.messages import CameraInfo, CompressedColor, DepthImage, color_from_message
from bridge.episode.cdr.straighten import Straightening, straightening
from bridge.episode.schema import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE
from bridge.geometry.camera import Camera
from bridge.media.color import UnreadableImageError, encode_png

RECORDED = Camera(width=160, height=120, fx=95.0, fy=96.5, cx=78.2, cy=61.3)
LENSES = {
    "plumb_bob": (-0.28, 0.09, 0.0011, -0.0007, -0.01),
    "rational_polynomial": (0.31, -2.6, 0.0008, -0.0003, 1.4, 0.19, -2.4, 1.3),
    "thin_prism_model": (-0.2, 0.05, 0.001, 0.0005, 0.0, 0, 0, 0, 0.002, -0.001, 0.001, 0.0005),
    "equidistant": (-0.012, 0.021, -0.018, 0.004),
}


def made(model: str, numbers: tuple[float, ...] = (), camera: Camera = RECORDED) -> Straightening:
    found = straightening(model, tuple(map(float, numbers or LENSES[model])), camera)
    assert isinstance(found, Straightening)
    return found


def seen_by_opencv(
    model: str, p_m: Float[np.ndarray, "num_points 3"], numbers: tuple[float, ...] = ()
) -> Float[np.ndarray, "num_points 2"]:
    """Pixels of the recorded image, centres at +0.5."""
    cv2 = pytest.importorskip("cv2")
    fx, fy, cx, cy = RECORDED.to_ros()
    K, d = (
        np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]),
        np.array(numbers or LENSES[model], float),
    )
    project, still = (cv2.fisheye if model == "equidistant" else cv2).projectPoints, np.zeros(3)
    pixels, _ = project(p_m[:, None], still, still, K, d)
    return np.asarray(pixels).reshape(-1, 2) + 0.5


def pattern(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Colours that say where they are: a slope to the right, one down."""
    return np.stack([40 + u, 40 + v, np.full_like(u, 90.0)], axis=-1)


@pytest.mark.parametrize("model", LENSES)
def test_a_straightened_image_shows_points_where_a_pinhole_camera_sees_them(model: str) -> None:
    """A pixel's colour says where it was recorded; OpenCV says where it should have been."""
    v, u = np.mgrid[0 : RECORDED.height, 0 : RECORDED.width] + 0.5
    shown = made(model).color(np.rint(pattern(u, v)).astype(np.uint8)).astype(float) - 40
    camera = made(model).camera
    rows, columns = np.mgrid[0 : camera.height, 0 : camera.width]
    expected = seen_by_opencv(model, camera.rays().reshape(-1, 3))
    found = shown[rows.ravel(), columns.ravel(), :2]
    # 8 bits of colour round by half a pixel at most, and by chance.
    assert np.abs(found - expected).max() < 1.0
    assert np.abs((found - expected).mean(axis=0)).max() < 0.05
    places = np.stack(made(model)._places, axis=-1).reshape(-1, 2) + 0.5
    assert np.linalg.norm(places - expected, axis=1).max() < 0.2
    size = np.array([RECORDED.width, RECORDED.height])
    assert -0.1 < np.minimum(expected - 0.5, size - 0.5 - expected).min() < 0.5  # and no narrower
    grid = expected.reshape(RECORDED.height, RECORDED.width, 2).astype(np.float32)
    rim = np.concatenate([grid[0], grid[1:, -1], grid[-1, -2::-1], grid[-2:0:-1, 0]])
    share = pytest.importorskip("cv2").contourArea(rim) / np.prod(size - 1)
    assert made(model).cut == pytest.approx(1 - share, abs=0.002)


def test_depth_is_moved_and_never_mixed() -> None:
    depth_mm = np.where(np.arange(RECORDED.width) < 80, 500, 2000).astype(np.uint16)
    depth_mm = np.repeat(depth_mm[None], RECORDED.height, axis=0)
    lens = made("equidistant")
    straight = lens.depth(depth_mm)
    assert set(np.unique(straight)) == {500, 2000}
    u = seen_by_opencv("equidistant", lens.camera.rays().reshape(-1, 3))[:, 0]
    sure = np.abs(u - 80) > 0.5
    assert np.array_equal(straight.ravel()[sure], np.where(u < 80, 500, 2000)[sure])


@pytest.mark.parametrize("model", ["equidistant", "plumb_bob"])
def test_depth_of_a_slanted_plane_is_that_of_the_pinhole_camera(model: str) -> None:
    cv2 = pytest.importorskip("cv2")
    normal, away_mm = np.array([0.75, -0.35, 0.56]), 700.0
    v, u = np.mgrid[0 : RECORDED.height, 0 : RECORDED.width].astype(float)
    fx, fy, cx, cy = RECORDED.to_ros()
    undo = (cv2.fisheye if model == "equidistant" else cv2).undistortPoints
    K, d = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.array(LENSES[model])
    rays = undo(np.stack([u, v], axis=-1).reshape(-1, 1, 2), K, d).reshape(*u.shape, 2)
    recorded = away_mm / np.maximum(rays @ normal[:2] + normal[2], 0.02)
    expected = away_mm / np.maximum(made(model).camera.rays() @ normal, 0.02)
    found = made(model).depth(np.rint(np.minimum(recorded, 60_000)).astype(np.uint16))
    near = expected < 1200  # farther off it is so steep that each pixel stands alone
    off = np.abs(found - expected)[near]
    assert near.mean() > 0.3
    assert off.max() < 2.0  # a millimetre rounds twice


def test_a_message_keeps_its_lens_and_images_are_read_through_it() -> None:
    lens = made("equidistant")
    straight = CameraInfo(stamp_ns=5, frame_id="eye", camera=RECORDED)
    about = {"distortion_model": "equidistant", "d": np.array(LENSES["equidistant"])}
    message = codec.decode(CAMERA_INFO, straight.to_cdr()) | about
    info = CameraInfo.from_cdr(codec.encode(CAMERA_INFO, message))
    assert (info.camera, info.lens) == (lens.camera, lens)
    image = np.random.default_rng(1).integers(0, 255, (120, 160, 3)).astype(np.uint8)
    file = CompressedColor(stamp_ns=5, frame_id="eye", format="png", data=encode_png(image))
    read = color_from_message(COMPRESSED_IMAGE, file.to_cdr(), lens).image_u8()
    assert np.array_equal(read, lens.color(image))
    assert not np.array_equal(read, image)
    depth = DepthImage(stamp_ns=5, frame_id="eye", depth_mm=image[..., 0].astype(np.uint16))
    read = DepthImage.from_message(IMAGE, depth.to_cdr(), lens).depth_mm
    assert np.array_equal(read, lens.depth(depth.depth_mm))
    with pytest.raises(UnreadableImageError, match=r"100 x 120 pixels.*160 x 120 as its camera"):
        lens.color(image[:, :100])


@pytest.mark.parametrize(
    ("model", "numbers"),
    [("plumb_bob", (0.0,) * 5), ("", ()), ("pinhole", ()), ("inverse_brown_conrady", (0.0,) * 5)],
)
def test_a_lens_that_bends_nothing_leaves_images_alone(
    model: str, numbers: tuple[float, ...]
) -> None:
    assert straightening(model, numbers, RECORDED) is None


@pytest.mark.parametrize(
    ("model", "numbers", "found"),
    [
        ("plumb_bob", (-0.9, 0.0, 0.0, 0.0, 0.0), "turns back inside the image"),
        ("equidistant", (-0.6, 0.0, 0.0, 0.0), "turns back inside the image"),
        ("rational_polynomial", (0, 0, 0, 0, 0, 3.0, 0, 0), "turns back inside the image"),
        ("plumb_bob", (1e300, 1.0, 0.0, 0.0, 0.0), "leaves none"),
        ("plumb_bob", (float("nan"), 0.0, 0.0, 0.0, 0.0), "plumb_bob with the numbers nan"),
        ("plumb_bob", (0.1, 0, 0, 0, 0, 0.2), "0.2, and it has 5"),
        ("equidistant", (0.1, 0, 0, 0, 0.1), "and it has 4"),
        ("mei", (0.0,), "lens model 'mei', which is none of plumb_bob"),
        ("inverse_brown_conrady", (0.1,), "lens model 'inverse_brown_conrady'"),
        ("", (0.1, 0.0), "1 numbers of a lens without a model"),
    ],
)
def test_what_cannot_be_straightened_is_refused_with_what_to_do(
    model: str, numbers: tuple[float, ...], found: str
) -> None:
    info = CameraInfo(stamp_ns=5, frame_id="eye", camera=RECORDED)
    message = codec.decode(CAMERA_INFO, info.to_cdr())
    data = codec.encode(
        CAMERA_INFO, {**message, "distortion_model": model, "d": np.array(numbers, dtype=float)}
    )
    with pytest.raises(MalformedMessageError, match=f"{found}.*(?s:.*)calibrate the camera"):
        CameraInfo.from_cdr(data)
