"""Pictures to publish: real Kinect frames where they are at hand, a synthetic room otherwise."""

import io
import json
import os
from functools import cache
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
NATIVE_WIDTH, NATIVE_HEIGHT = 640, 480
NOISE_PER_MM = 1.2e-6
"""Standard deviation over depth squared [1/mm], about that of a D435; independent per pixel."""


def source_name() -> str:
    """Where the frames come from, for the notes beside a number."""
    return "Kinect frames (7-Scenes kitchen)" if _folder() else "synthetic frames"


def _folder() -> Path | None:
    data = Path(os.environ.get("GST_SHARED_DATA", ROOT.parent / "shared" / "data"))
    folder = data / "rgbd_7scenes_redkitchen_a"
    return folder if (folder / "scene.json").is_file() else None


@cache
def native_frames(count: int) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Colour (height x width x 3, uint8) and depth (height x width, uint16, mm), 640 x 480."""
    folder = _folder()
    return _synthetic(count) if folder is None else _kinect(folder, count)


def _kinect(folder: Path, count: int) -> tuple[list[np.ndarray], list[np.ndarray]]:
    from PIL import Image

    def load(name: str) -> np.ndarray:
        return np.asarray(Image.open(io.BytesIO((folder / name).read_bytes())))

    frames = json.loads((folder / "scene.json").read_text())["frames"]
    chosen = [frames[index] for index in np.linspace(0, len(frames) - 1, count).astype(int)]
    colors = [np.ascontiguousarray(load(frame["color"])[..., :3]) for frame in chosen]
    depths = [load(frame["depth"]).astype(np.uint16) for frame in chosen]
    for depth in depths:
        depth[depth == 65535] = 0
    return colors, depths


def _synthetic(count: int) -> tuple[list[np.ndarray], list[np.ndarray]]:
    rng = np.random.default_rng(7)
    across, down = np.meshgrid(np.arange(NATIVE_WIDTH), np.arange(NATIVE_HEIGHT))
    colors, depths = [], []
    for index in range(count):
        waves = np.sin((across + 9 * index) / 23) + np.cos((down - 5 * index) / 31)
        shades = 128 + 50 * waves + rng.normal(0, 4, waves.shape)
        colors.append(np.stack([shades, shades * 0.8, 255 - shades], -1).clip(0, 255).astype("u1"))
        slope = 600 + 1200 * across / NATIVE_WIDTH + 8 * index
        slope[(across // 40 + down // 40) % 9 == 0] = 0  # holes, as every depth camera has
        depths.append(slope.astype(np.uint16))
    return colors, depths


def enlarge(frame: np.ndarray, width: int, height: int) -> np.ndarray:
    """Tile a native frame to a larger one, which keeps the statistics of its noise."""
    across, down = -(-width // frame.shape[1]), -(-height // frame.shape[0])
    tiles = (down, across) + (1,) * (frame.ndim - 2)
    return np.ascontiguousarray(np.tile(frame, tiles)[:height, :width])


def add_noise(depth_mm: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Add what a stereo depth camera adds; holes stay holes."""
    depth = depth_mm.astype(np.float32)
    noisy = np.rint(depth + rng.standard_normal(depth.shape, np.float32) * NOISE_PER_MM * depth**2)
    return np.where(depth_mm == 0, 0, noisy.clip(1, 65534)).astype(np.uint16)
