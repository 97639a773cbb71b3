"""One wrong number of a camera's geometry is found and said."""

import re
from dataclasses import replace

import numpy as np
import pytest
import textured_room

from bridge.episode.run_folder import RunFolder
from bridge.geometry import se3
from twin.scene.dataset.geometry_search import WrongGeometryError, check_geometry, search_geometry
from twin.scene.dataset.scan_check import CameraCheck, check_poses, check_scan
from twin.scene.frames.downscaled import DownscaledDepth, downscaled_depth
from twin.scene.frames.selection import FrameChoice, choose_frames, find_sources, load
from twin.scene.settings import FrameConfig

NUM_FRAMES = 10
FRAME_NS = 100_000_000
CONFIG = FrameConfig()


def pose_at(stamp_ns: int) -> np.ndarray:
    """Faster and slower along the arc, as a hand moves."""
    along = stamp_ns / FRAME_NS
    T_base_color = textured_room.camera_pose(0, NUM_FRAMES)
    swing = se3.transform_from(
        np.array([np.cos(0.04 * along), 0.0, 0.0, np.sin(0.04 * along)]), np.zeros(3)
    )
    lift = np.eye(4)
    lift[2, 3] = 0.09 * np.sin(0.9 * along) + 0.08 * np.sin(0.37 * along)
    return np.asarray(lift @ swing @ T_base_color @ textured_room.T_COLOR_DEPTH)


def image(
    index: int, *, depth: float = 1.0, focal: float = 1.0, delay: float = 0.0
) -> DownscaledDepth:
    """As a camera sees the room with 1 % noise, of which one number was written down wrongly."""
    stamp_ns = index * FRAME_NS
    rng = np.random.default_rng(index)
    camera = textured_room.DEPTH
    depth_m, _ = textured_room.depth_and_points(camera, pose_at(stamp_ns))
    depth_m = depth_m * (1 + 0.005 * rng.normal(size=depth_m.shape)) * depth
    return DownscaledDepth(
        stamp_ns=stamp_ns,
        camera=replace(camera, fx=camera.fx * focal, fy=camera.fy * focal),
        depth_m=depth_m.astype(np.float32),
        T_base_depth=pose_at(round(stamp_ns - delay * FRAME_NS)),
    )


@pytest.mark.parametrize(
    ("kind", "wrong"),
    [
        *(("depth", 1.05), ("depth", 0.5)),
        *(("focal", 0.5), ("focal", 1.2)),
        *(("delay", 4.0), ("delay", -1.3)),
    ],
)
def test_the_wrong_number_is_found_and_no_other(kind: str, wrong: float) -> None:
    late = wrong if kind == "delay" else 0.0
    images = [image(k, **{kind: wrong}) for k in range(NUM_FRAMES)]
    found = search_geometry(images, lambda t: pose_at(round(t - late * FRAME_NS)), FRAME_NS)
    assert found is not None
    assert found.kind == kind
    assert found.after > found.before + 0.02
    if kind == "delay":
        assert found.frames == pytest.approx(wrong, abs=0.15)
        assert f"{abs(wrong):.1f} frames {'late' if wrong > 0 else 'early'}" in found.describe()
    else:
        assert 1 / found.value == pytest.approx(wrong, rel=0.02)
        assert ("focal length is" if kind == "focal" else "depth reads") in found.describe()


@pytest.mark.parametrize(("depth", "positions"), [(0.2, 1.0), (10.0, 1.0), (1.0, 1000.0)])
def test_a_wrong_unit_is_a_wrong_depth_and_no_other_convention(
    depth: float, positions: float
) -> None:
    images = []
    for right in (downscaled_depth(textured_room.frame(k, NUM_FRAMES), 72) for k in range(10)):
        T = right.T_base_depth.copy()
        T[:3, 3] *= positions
        images.append(replace(right, T_base_depth=T, depth_m=np.float32(depth) * right.depth_m))
    assert check_poses(images).better is None
    found = search_geometry(images)
    assert found is not None
    assert found.kind == "depth"
    assert found.value == pytest.approx(positions / depth, rel=0.05)


@pytest.fixture(scope="module")
def choice(tmp_path_factory: pytest.TempPathFactory) -> FrameChoice:
    run = RunFolder.create(tmp_path_factory.mktemp("run"))
    textured_room.write_episode(run.episodes_dir / "scan.mcap", num_frames=10)
    return choose_frames(find_sources(run), CONFIG).choices[0]


def camera(choice: FrameChoice, depth_times: float) -> CameraCheck:
    images = [downscaled_depth(frame, 72) for frame in load(choice, choice.train_ns)]
    scaled = [replace(i, depth_m=np.float32(depth_times) * i.depth_m) for i in images]
    return CameraCheck(choice=choice, images=scaled, trusted=[1.0] * len(scaled))


def test_a_wrong_number_is_refused_and_the_way_out_is_named(choice: FrameChoice) -> None:
    wrong = camera(choice, 0.6)
    insist = FrameConfig(check_poses=False)
    report = check_scan([wrong], insist)
    with pytest.raises(WrongGeometryError, match=r"depth reads .* x .*--depth-unit-m") as told:
        check_geometry([wrong], report, CONFIG)
    (factor,) = re.findall(r"depth reads (\d\.\d+) x", str(told.value))
    assert float(factor) == pytest.approx(0.6, rel=0.01)
    insisted = check_geometry([wrong], report, insist)
    assert any("Import it again with another" in remark for remark in insisted.remarks())


def test_nothing_is_found_in_a_noisy_scan_that_is_right() -> None:
    images = [image(k) for k in range(NUM_FRAMES)]
    assert search_geometry(images, pose_at, FRAME_NS) is None
    rng = np.random.default_rng(1)
    noise = rng.normal(1, 0.02, (NUM_FRAMES, *images[0].depth_m.shape)).astype(np.float32)
    coarse = [replace(i, depth_m=i.depth_m * n) for i, n in zip(images, noise, strict=True)]
    assert search_geometry(coarse, pose_at, FRAME_NS) is None  # agreement is low, and no better
