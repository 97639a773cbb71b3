"""TUM and 7-Scenes folders: found by their files, read as their makers describe them."""

import io
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import robot_gst
from bridge.episode.cdr.messages import CameraInfo, DepthImage, transforms_from_cdr
from bridge.episode.reader import Episode
from bridge.episode.streams import rgbd_frames
from bridge.errors import PathNotFoundError, UsageError
from bridge.sources.folder.config import FolderConfig, FolderError
from bridge.sources.folder.messages import folder_messages, frame_times_ns, read_index
from bridge.sources.folder.tum import StampedFile, associate
from dashboards.opening import look_at

SMALL = FolderConfig(depth_intrinsics=(9.0, 9.5, 4.0, 3.0), color_intrinsics=(8.0, 8.5, 4.1, 3.1))
TUM = FolderConfig(depth_intrinsics=(9.0, 9.5, 4.0, 3.0))
STAMPS = ("1305031102.175304", "1305031102.211214", "1305031102.243211")
STAMPS_NS = (1305031102175304000, 1305031102211214000, 1305031102243211000)


def depth_png(value: int = 5000) -> bytes:
    stream = io.BytesIO()
    pixels = np.full((6, 8), value, np.uint16)
    pixels[0, :2] = (0, 65535)
    Image.fromarray(pixels).save(stream, "PNG")
    return stream.getvalue()


def color_png() -> bytes:
    stream = io.BytesIO()
    Image.new("RGB", (8, 6), (10, 200, 30)).save(stream, "PNG")
    return stream.getvalue()


@pytest.fixture
def tum(tmp_path: Path) -> Path:
    """Depth comes 5 ms after colour; the camera moves along x at 1 m/s."""
    folder = tmp_path / "tum"
    for part in ("rgb", "depth"):
        (folder / part).mkdir(parents=True)
    rgb, depth = ["# color images", "# timestamp filename"], ["# depth maps"]
    for stamp, stamp_ns in zip(STAMPS, STAMPS_NS, strict=True):
        (folder / "rgb" / f"{stamp}.png").write_bytes(color_png())
        rgb.append(f"{stamp} rgb/{stamp}.png")
        late = f"{stamp_ns // 10**9}.{(stamp_ns + 5_000_000) % 10**9:09d}"
        (folder / "depth" / f"{late}.png").write_bytes(depth_png())
        depth.append(f"{late} depth/{late}.png")
    (folder / "rgb.txt").write_text("\n".join(rgb) + "\n")
    (folder / "depth.txt").write_text("\n".join(depth) + "\n")
    poses = ["# timestamp tx ty tz qx qy qz qw"]
    for k in range(-2, 13):
        poses.append(f"1305031102.{175304 + 10_000 * k:06d} {0.01 * k:.4f} 0 1 0 0 0.6 0.8")
    (folder / "groundtruth.txt").write_text("\n".join(poses) + "\n")
    return folder


@pytest.fixture
def scenes(tmp_path: Path) -> Path:
    folder = tmp_path / "seq-01"
    folder.mkdir()
    for number in (0, 1, 12):
        stem = folder / f"frame-{number:06d}"
        stem.with_suffix(".color.png").write_bytes(color_png())
        stem.with_suffix(".depth.png").write_bytes(depth_png(1234))
        T = np.eye(4)
        T[0, 3] = number
        np.savetxt(stem.with_suffix(".pose.txt"), T, fmt="%.7e", delimiter="\t ")
    return folder


def test_a_tum_folder_keeps_its_times_to_the_nanosecond(tum: Path) -> None:
    index = read_index(tum, TUM)
    assert index.layout == "TUM"
    assert [frame.color_stamp_ns for frame in index.frames] == list(STAMPS_NS)
    assert [f.depth_stamp_ns for f in index.frames] == [s + 5_000_000 for s in STAMPS_NS]
    assert index.summary == "TUM layout with its own times: 3 frames"
    assert "depth_intrinsics" not in index.assumed
    assert frame_times_ns(index, TUM)[0] == (STAMPS_NS[0], STAMPS_NS[0] + 5_000_000)


def test_tum_depth_is_a_fifth_of_a_millimetre_and_quaternions_end_with_w(tum: Path) -> None:
    index = read_index(tum, TUM)
    frames = list(folder_messages(index, TUM))
    messages = [message for frame in frames for message in frame]
    depth = [DepthImage.from_cdr(m.data) for m in messages if m.topic.endswith("depth/image")]
    assert depth[0].depth_mm[3, 3] == 1000
    assert depth[0].depth_mm[0, 0] == 0
    assert depth[0].depth_mm[0, 1] == 13107  # 65535 is a distance here, 13.1 m
    poses = [t for m in messages if m.topic == "/tf" for t in transforms_from_cdr(m.data)]
    # Every pose from the last before the first frame to the first after the last one.
    stamps = [pose.stamp_ns for pose in poses]
    assert stamps == [STAMPS_NS[0] + 10_000_000 * k for k in range(9)]
    R = poses[0].T_parent_child[:3, :3]
    np.testing.assert_allclose(R[:2, 0], [0.28, 0.96], atol=1e-12)  # 2 atan2(0.6, 0.8) about z
    assert all(a.stamp_ns <= b.stamp_ns for f in frames for a, b in pairwise(f))


def test_poses_of_frames_lie_between_those_of_the_motion_capture(tum: Path, tmp_path: Path) -> None:
    arguments = ["--depth-intrinsics", "9", "9.5", "4", "3", "--camera", "eye"]
    assert robot_gst.run(["import", "rgbd", str(tum), str(tmp_path / "run"), *arguments]) == 0
    episode = Episode.open(tmp_path / "run" / "episodes" / "scan.mcap")
    for frame, stamp_ns in zip(rgbd_frames(episode, "eye"), STAMPS_NS, strict=True):
        assert frame.stamp_ns == stamp_ns
        elapsed = (stamp_ns - STAMPS_NS[0]) * 1e-9
        np.testing.assert_allclose(frame.T_base_color[0, 3], elapsed, atol=1e-9)
        np.testing.assert_allclose(frame.T_base_depth[0, 3], elapsed + 0.005, atol=1e-9)
    source = episode.metadata_records["source"]
    assert (source["layout"], source["times"]) == ("TUM", "the folder's own")


def test_frames_without_a_pose_or_a_partner_are_left_out_and_counted(tum: Path) -> None:
    poses = (tum / "groundtruth.txt").read_text().splitlines()
    (tum / "groundtruth.txt").write_text("\n".join(poses[:3]))  # ends 10 ms before the first frame
    with (tum / "rgb.txt").open("a") as stream:
        stream.write(f"1305031109.0 rgb/{STAMPS[0]}.png\n")
    index = read_index(tum, TUM)
    assert (len(index.frames), index.num_unposed, index.num_unpaired) == (2, 1, 1)
    assert "1 without a pose left out, 1 colour images without depth" in index.summary


def test_each_depth_image_is_used_once_and_the_closest_pair_wins() -> None:
    def files(stamps: list[int]) -> list[StampedFile]:
        return [StampedFile(stamp_ns=s * 1_000_000, name=str(s), line=1) for s in stamps]

    pairs = associate(files([0, 10, 100, 200]), files([8, 25, 121, 195]))
    names = [(color.name, depth.name) for color, depth in pairs]
    assert names == [("10", "8"), ("200", "195")]
    assert associate(files([0, 10]), files([8, -12])[::-1]) == [
        (files([0])[0], files([-12])[0]),
        (files([10])[0], files([8])[0]),
    ]


@pytest.mark.parametrize(
    ("name", "text", "match"),
    [
        ("rgb.txt", "1305031102.1 a b\n", r"rgb.txt: line 1 has 3 fields, expected 2"),
        ("rgb.txt", "# only\nnow rgb/x.png\n", r"rgb.txt: line 2: 'now' is no time in seconds"),
        ("rgb.txt", "1305031102175304000 rgb/x.png", r"line 1: '1305\d+' is no time in seconds"),
        ("rgb.txt", "-1 rgb/x.png", "line 1: '-1' is no time"),
        ("rgb.txt", "# nothing\n", "rgb.txt: no images listed"),
        ("rgb.txt", "1.0 rgb/x.png", "no colour image lies within 20 ms of a depth image"),
        ("rgb.txt", "\x80", "rgb.txt: line 1 has 1 fields"),
        ("groundtruth.txt", "1 2 3\n", r"groundtruth.txt: line 1 has 3 fields, expected 8"),
        ("groundtruth.txt", "1 0 0 0 0 0 0 x\n", r"line 1: could not convert string to float"),
        ("groundtruth.txt", "1 0 0 0 0 0 0 7\n", r"line 1: quaternion of length 7"),
        ("groundtruth.txt", "1 0 0 0 nan 0 0 1\n", "no poses"),
        ("groundtruth.txt", "1 0 0 0 0 0 0 1\n", "no pose within 50 ms of any frame"),
        ("camera.json", "{", "camera.json: cannot be read"),
        ("camera.json", '{"depth": {}}', "camera.json: cannot be read"),
    ],
)
def test_a_bad_line_is_named(tum: Path, name: str, text: str, match: str) -> None:
    (tum / name).write_text(text)
    config = FolderConfig() if name == "camera.json" else TUM
    with pytest.raises(FolderError, match=match) as caught:
        read_index(tum, config)
    assert caught.value.exit_code == 2


def test_missing_parts_of_a_tum_folder_are_named(tum: Path) -> None:
    (tum / "rgb" / f"{STAMPS[1]}.png").unlink()
    with pytest.raises(PathNotFoundError, match=r"color image not found.*rgb.txt line 4 names it"):
        read_index(tum, TUM)
    (tum / "groundtruth.txt").unlink()
    with pytest.raises(FolderError, match=r"no groundtruth.txt, so no frame has a pose"):
        read_index(tum, TUM)


def test_a_rate_is_refused_where_times_are_known(tum: Path) -> None:
    config = FolderConfig(depth_intrinsics=(9.0, 9.5, 4.0, 3.0), rate_hz=10.0)
    with pytest.raises(UsageError, match=r"--rate-hz 10 was given, but .*rgb.txt says when"):
        list(folder_messages(read_index(tum, config), config))


def test_intrinsics_are_asked_for_where_none_are_documented(tum: Path, scenes: Path) -> None:
    for folder in (tum, scenes):
        with pytest.raises(FolderError, match=r"images of 8 x 6 pixels.*--depth-intrinsics FX"):
            read_index(folder)


def test_a_sevenscenes_folder_is_read_in_the_order_of_its_numbers(scenes: Path) -> None:
    index = read_index(scenes, SMALL)
    assert index.layout == "7-Scenes"
    assert [frame.T_world_depth[0, 3] for frame in index.frames] == [0, 1, 12]
    assert not index.has_times
    assert "nominal" in index.assumed["color_from_depth"]
    first = next(iter(folder_messages(index, SMALL)))
    by_topic = {message.topic: message.data for message in first}
    depth = DepthImage.from_cdr(by_topic["/kitchen/cam/kinect/depth/image"]).depth_mm
    assert depth[3, 3] == 1234
    assert depth[0, 1] == 0  # 65535 is "no measurement" here
    color = CameraInfo.from_cdr(by_topic["/kitchen/cam/kinect/color/info"])
    assert color.camera.to_ros() == pytest.approx((8.0, 8.5, 4.1, 3.1))


def test_lost_tracking_and_missing_files_of_a_sevenscenes_folder(scenes: Path) -> None:
    (scenes / "frame-000000.pose.txt").write_text("nan nan nan nan\n" * 4)
    (scenes / "frame-000001.pose.txt").unlink()
    index = read_index(scenes, SMALL)
    assert (len(index.frames), index.num_unposed) == (1, 2)
    (scenes / "frame-000012.pose.txt").write_text("1 0 0\n0 1 0\n")
    with pytest.raises(FolderError, match=r"frame-000012.pose.txt: 2 rows of numbers"):
        read_index(scenes, SMALL)
    (scenes / "frame-000012.pose.txt").write_text("1 0 0 0\n0 -1 0 0\n0 0 1 0\n0 0 0 1\n")
    with pytest.raises(FolderError, match=r"pose.txt: the rotation of the pose is none"):
        read_index(scenes, SMALL)
    (scenes / "frame-000012.depth.png").unlink()
    with pytest.raises(PathNotFoundError, match=r"depth image not found.*frame-000012.color.png"):
        read_index(scenes, SMALL)


def test_a_folder_of_sequences_points_to_them(scenes: Path) -> None:
    with pytest.raises(PathNotFoundError, match="robot-gst open says what is there"):
        read_index(scenes.parent)
    with pytest.raises(UsageError, match=r"holds seq-01 \(RGB-D folder\)"):
        look_at(scenes.parent)


def test_options_that_a_scene_json_answers_itself_are_refused(tmp_path: Path) -> None:
    (tmp_path / "scene.json").write_text("{}")
    with pytest.raises(FolderError, match="--depth-unit-m was given, but the file holds this"):
        read_index(tmp_path, FolderConfig(depth_unit_m=0.001))
    with pytest.raises(UsageError, match="--depth-intrinsics"):
        FolderConfig(depth_intrinsics=(0.0, 1.0, 1.0, 1.0))
