"""A room seen through lenses, each ray found with OpenCV, rebuilt as well as through a pinhole."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
import textured_room
from written_messages import depth_image, put

from bridge.episode import schema
from bridge.episode.cdr import codec
from bridge.episode.cdr.messages import (
    CameraInfo,
    CompressedColor,
    FrameTransform,
    transforms_to_cdr,
)
from bridge.episode.cdr.straighten import Straightening, straightening
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter
from bridge.geometry.camera import Camera
from bridge.media.color import decode_color, encode_png
from bridge.terminal import Output
from twin.scene import settings
from twin.scene.rebuild.record import describe_scene
from twin.scene.rebuild.run import rebuild
from twin.scene.store.folder import read_record

cv2 = pytest.importorskip("cv2")
pytestmark = [pytest.mark.slow, pytest.mark.parity]
FISHEYE = Camera(width=320, height=240, fx=175.0, fy=175.0, cx=162.0, cy=118.0)
RATIONAL = Camera(width=320, height=240, fx=262.0, fy=262.0, cx=158.0, cy=122.0)
LENSES = {
    "equidistant": (FISHEYE, (-0.01, 0.02, -0.015, 0.003)),
    "rational_polynomial": (RATIONAL, (0.55, -2.7, 0.0008, -0.0003, 1.5, 0.43, -2.5, 1.5)),
}
NUM_FRAMES, HALF_SIZE_M, CENTRE_M = 24, np.array([1.2, 0.9, 0.7]), np.array([0.0, -0.3, 0.7])


def texture(p_m: np.ndarray) -> np.ndarray:
    """Colour of a surface point, 0..1: slow waves with quick ones on them."""
    x, y, z = np.moveaxis(p_m, -1, 0)
    quick = 0.12 * np.sin(43 * x + 9 * z) * np.sin(37 * y - 31 * z)
    waves = (np.sin(9 * x + 2 * z), np.sin(8 * y + 6 * z + 1), np.cos(7 * x - 7 * y))
    return np.stack([0.5 + 0.3 * wave + quick for wave in waves], axis=-1)


def seen(rays: np.ndarray, T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Colour and depth along the axis of what rays (z = 1) meet inside of a box."""
    directions, origin = rays @ T[:3, :3].T, T[:3, 3]
    with np.errstate(divide="ignore"):
        ends = (CENTRE_M + np.sign(directions) * HALF_SIZE_M - origin) / directions
    depth = ends.min(axis=-1)
    return texture(origin + directions * depth[..., None]), depth


@cache
def rays_through(model: str, at: tuple[float, float]) -> np.ndarray:
    """Directions with z = 1 that OpenCV puts at a place in each pixel of the recorded image."""
    camera, numbers = LENSES[model]
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    project = cv2.fisheye.projectPoints if model == "equidistant" else cv2.projectPoints
    still, wanted = np.zeros(3), np.indices((camera.height, camera.width))[::-1].reshape(2, -1).T
    wanted = wanted + np.array(at)

    def landing(rays: np.ndarray) -> np.ndarray:
        points = np.column_stack([rays, np.ones(len(rays))])[:, None]
        return np.asarray(project(points, still, still, K, np.array(numbers))[0]).reshape(-1, 2)

    rays, step = (wanted - K[:2, 2]) / K[0, 0], 1e-6
    for _ in range(30):
        here = landing(rays)
        slopes = [(landing(rays + step * axis) - here) / step for axis in np.eye(2)]
        rays = rays + np.linalg.solve(np.stack(slopes, axis=-1), (wanted - here)[..., None])[..., 0]
    assert np.abs(landing(rays) - wanted).max() < 1e-3
    return np.column_stack([rays, np.ones(len(rays))]).reshape(camera.height, camera.width, 3)


def pinhole_rays(camera: Camera, at: tuple[float, float]) -> np.ndarray:
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    x, y = (u + at[0] - camera.cx) / camera.fx, (v + at[1] - camera.cy) / camera.fy
    return np.stack([x, y, np.ones_like(x)], axis=-1)


CORNERS = [(a, b) for a in (0.25, 0.75) for b in (0.25, 0.75)]


def picture(lens: Straightening, model: str, T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Colour in 8 bits, of four rays a pixel, and depth; of a pinhole camera without a model."""
    rays = [
        rays_through(model, at) if model else pinhole_rays(lens.camera, at)
        for at in (*CORNERS, (0.5, 0.5))
    ]
    color = np.mean([seen(each, T)[0] for each in rays[:4]], axis=0)
    return np.rint(color * 255).astype(np.uint8), seen(rays[4], T)[1]


def record(path: Path, lens: Straightening, model: str) -> None:
    """Write a scan, through the lens where a model is named, else with its pinhole camera."""
    info = CameraInfo(stamp_ns=10**9, frame_id="eye", camera=lens.camera)
    message = codec.decode(schema.CAMERA_INFO, info.to_cdr())
    if model:
        camera, numbers = LENSES[model]
        fx, fy, cx, cy = camera.to_ros()
        message |= {"distortion_model": model, "d": np.array(numbers)}
        message |= {"k": [fx, 0, cx, 0, fy, cy, 0, 0, 1]}
    with EpisodeWriter(path) as writer:
        writer.describe(EpisodeInfo(id=path.stem, kind="scan", cell="room", stand_in=True))
        for stream in ("color", "depth"):
            about = codec.encode(schema.CAMERA_INFO, message)
            topic = f"/room/cam/wrist/{stream}/info"
            writer.write(topic, about, type_name=schema.CAMERA_INFO, log_time_ns=10**9)
        for index in range(NUM_FRAMES):
            stamp, T = 10**9 + index * 10**8, textured_room.camera_pose(index, NUM_FRAMES)
            place = FrameTransform(
                stamp_ns=stamp, parent="base_link", child="eye", T_parent_child=T
            )
            data = transforms_to_cdr([place])
            writer.write("/tf", data, type_name=schema.TF_MESSAGE, log_time_ns=stamp)
            image_u8, depth_m = picture(lens, model, T)
            png = encode_png(image_u8)
            color = CompressedColor(stamp_ns=stamp, frame_id="eye", format="png", data=png)
            put(writer, "/room/cam/wrist/color/image", color, stamp)
            put(writer, "/room/cam/wrist/depth/image", depth_image(stamp, "eye", depth_m), stamp)


def quality_db(run: RunFolder, lens: Straightening) -> float:
    """Mean PSNR of held-out views against what a pinhole camera would have seen there."""
    (path,) = run.derived("*views*")
    found = []
    for message in Episode.open(path).messages(["/room/views/cam/wrist/rendered/image"]):
        index = round((message.publish_time_ns - 10**9) / 10**8)
        truth, _ = picture(lens, "", textured_room.camera_pose(index, NUM_FRAMES))
        drawn = decode_color(CompressedColor.from_cdr(message.data).data)
        error = np.square((drawn.astype(float) - truth) / 255).mean()
        found.append(-10 * np.log10(error))
    assert len(found) >= 3
    return float(np.mean(found))


@pytest.mark.usefixtures("few_voxels")
@pytest.mark.parametrize("model", LENSES)
def test_a_scene_is_rebuilt_through_a_lens_as_well_as_through_a_pinhole(
    model: str, tmp_path: Path
) -> None:
    camera, numbers = LENSES[model]
    lens = straightening(model, numbers, camera)
    assert isinstance(lens, Straightening)
    config = settings.RebuildConfig(
        fit=settings.FitConfig(iterations=150, threads=1),
        initialise=settings.InitialiseConfig(max_splats=2_500),
    )
    reached = {}
    for name in (model, ""):
        run = RunFolder.create(tmp_path / (name or "pinhole"))
        record(run.episodes_dir / "scan.mcap", lens, name)
        rebuild(run, config, Output(quiet=True))
        reached[name] = quality_db(run, lens)
        about = read_record(run)
        assert about is not None
        assert ("of its view cut off" in describe_scene(about)) == bool(name)
    print(f"{model}: {reached[model]:.2f} dB, pinhole {reached['']:.2f} dB, {lens.said}")
    assert reached[""] > 24
    assert reached[model] > reached[""] - 0.3
