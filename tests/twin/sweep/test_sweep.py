"""A sweep against planes whose distance is known at every pixel, by rays cast onto them."""

import json
from pathlib import Path

import numpy as np
import pytest

import robot_gst
from bridge.episode.reader import Episode
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from bridge.media.color import encode_jpeg
from twin.sweep.planes import PosedImage, sweep

CAMERA = Camera(width=96, height=72, fx=90.0, fy=90.0, cx=48.0, cy=36.0)
WAVES = np.random.default_rng(0).normal(size=(60, 3)) * 60.0
MIDDLE = np.array([0.0, 0.0, 1.0])


def seen(T: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Brightness and depth of the plane through (0, 0, 1) m with this normal."""
    rays = CAMERA.rays() @ T[:3, :3].T
    depth_m = ((MIDDLE - T[:3, 3]) @ normal) / (rays @ normal)
    p = T[:3, 3] + depth_m[..., None] * rays
    waves = np.sin(p @ WAVES.T + np.arange(len(WAVES))).sum(axis=-1)
    return 0.5 + waves / 20.0, depth_m


def capture(normal: tuple[float, float, float]) -> tuple[list[PosedImage], np.ndarray]:
    """Seven images from an arc around what is seen, with the noise of a camera; and depths."""
    images, depths = [], []
    noise = np.random.default_rng(1)
    for angle in np.linspace(0.0, 4.0, 7):
        eye = np.array([0.25 * np.cos(angle), 0.25 * np.sin(angle), 0.05 * angle])
        T = se3.look_at(eye, MIDDLE, np.array([0.0, -1.0, 0.0]))
        grey, depth_m = seen(T, np.array(normal))
        grey += noise.normal(scale=0.005, size=grey.shape)
        images.append(PosedImage(grey=grey.astype(np.float32), camera=CAMERA, T_base_camera=T))
        depths.append(depth_m)
    return images, np.stack(depths)


def swept(images: list[PosedImage]) -> tuple[np.ndarray, float]:
    depths, confirmed = sweep(images, 4.0, lambda *_: None)
    return np.stack(depths), confirmed


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.5, 0.0, 1.0), (0.2, -0.4, 1.0)])
def test_a_textured_plane_is_found_where_it_is(normal: tuple[float, float, float]) -> None:
    images, true_m = capture(normal)
    depth_m, confirmed = swept(images)
    off = np.abs(depth_m / true_m - 1.0)
    assert confirmed > 0.6
    assert np.median(off) < 0.01
    assert np.quantile(off, 0.9) < 0.05


@pytest.mark.parametrize(("contrast", "code"), [(0.0, 1), (0.6, 0)])
def test_textured_images_are_rebuilt_and_even_ones_refused_before_the_fit(
    contrast: float, code: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frames = []
    for number, each in enumerate(capture((0.2, -0.4, 1.0))[0]):
        grey = 255 * np.clip(0.5 + contrast * (each.grey - 0.5), 0.0, 1.0)
        image = np.repeat(grey.astype(np.uint8)[..., None], 3, axis=2)
        (tmp_path / f"{number}.jpg").write_bytes(encode_jpeg(image))
        T = each.T_base_camera @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": f"{number}.jpg", "transform_matrix": T.tolist()})
    about = {"w": CAMERA.width, "h": CAMERA.height, "fl_x": CAMERA.fx, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(about))
    run = tmp_path / "run"
    assert robot_gst.run(["import", "rgbd", str(tmp_path), str(run), "--quiet"]) == 0
    topics = Episode.open(run / "episodes" / "scan.mcap").topics()
    assert not any(topic.endswith("depth/image") for topic in topics)
    assert robot_gst.run(["rebuild", str(run), "--quiet", "--iterations", "3"]) == code
    assert ("do not agree on one" in capsys.readouterr().err) == bool(code)
    if code == 0:
        assert "depth estimated from colour" in (run / "scene" / "scene.json").read_text()
