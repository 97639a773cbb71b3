"""RGB-D folders as messages: made ones for every rule, real ones against their own files."""

import copy
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import robot_gst
from bridge.episode import schema
from bridge.episode.cdr.messages import CameraInfo, CompressedColor, DepthImage, transforms_from_cdr
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.run_folder import RunFolder
from bridge.episode.schema import StampedMessage
from bridge.episode.topics import type_of_topic
from bridge.errors import GstError, PathNotFoundError, UsageError
from bridge.exchange.rgbd import write_scan
from bridge.sources.folder.config import FolderConfig, FolderError
from bridge.sources.folder.messages import folder_messages, read_index

WIDTH, HEIGHT = 8, 6


def png16(stored: np.ndarray) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(stored.astype(np.uint16)).save(stream, "PNG")
    return stream.getvalue()


def color_image(kind: str) -> bytes:
    stream = io.BytesIO()
    pixels = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    Image.fromarray(pixels).save(stream, kind)
    return stream.getvalue()


@pytest.fixture
def stored() -> np.ndarray:
    values = np.arange(WIDTH * HEIGHT).reshape(HEIGHT, WIDTH) * 100
    values[0, :3] = (0, 65535, 12345)
    return values.astype(np.uint16)


@pytest.fixture
def index_record() -> dict[str, Any]:
    return {
        "name": "made",
        "depth_unit_m": 0.001,
        "depth_invalid_values": [0, 65535],
        "depth_intrinsics": {
            "fx": 9.0,
            "fy": 9.5,
            "cx": 4.0,
            "cy": 3.0,
            "width": WIDTH,
            "height": HEIGHT,
        },
        "color_registered_to_depth": True,
        "frames": [
            {"color": "c.jpg", "depth": "d.png", "T_world_cam": np.eye(4).tolist()},
            {"color": "c.png", "depth": "d.png", "T_world_cam": np.eye(4).tolist()},
        ],
    }


@pytest.fixture
def folder(tmp_path: Path, stored: np.ndarray, index_record: dict[str, Any]) -> Path:
    (tmp_path / "c.jpg").write_bytes(color_image("JPEG"))
    (tmp_path / "c.png").write_bytes(color_image("PNG"))
    (tmp_path / "d.png").write_bytes(png16(stored))
    (tmp_path / "scene.json").write_text(json.dumps(index_record))
    return tmp_path


def rewrite(folder: Path, record: dict[str, Any]) -> None:
    (folder / "scene.json").write_text(json.dumps(record))


def messages_of(folder: Path, **changes: Any) -> list[list[StampedMessage]]:
    config = FolderConfig(**{"cell": "lab", "camera": "eye", **changes})
    return list(folder_messages(read_index(folder), config))


def test_topics_types_and_stamps_are_those_of_a_camera(folder: Path) -> None:
    first, second = messages_of(folder, rate_hz=10.0)
    prefix = "/lab/cam/eye"
    assert {(m.topic, m.type_name) for m in first} == {
        ("/tf", schema.TF_MESSAGE),
        ("/tf_static", schema.TF_MESSAGE),
        (f"{prefix}/color/info", schema.CAMERA_INFO),
        (f"{prefix}/depth/info", schema.CAMERA_INFO),
        (f"{prefix}/color/image", schema.COMPRESSED_IMAGE),
        (f"{prefix}/depth/image", schema.IMAGE),
    }
    assert all(type_of_topic(m.topic) == m.type_name for m in first)
    assert {m.stamp_ns for m in first} == {0}
    assert {m.stamp_ns for m in second} == {100_000_000}
    assert len(second) == 3  # calibration is repeated once a second only


def test_jpeg_bytes_pass_through_and_png_becomes_jpeg(folder: Path) -> None:
    images = [
        CompressedColor.from_cdr(m.data)
        for frame in messages_of(folder)
        for m in frame
        if m.topic.endswith("color/image")
    ]
    assert images[0].data == (folder / "c.jpg").read_bytes()
    assert images[1].data[:2] == b"\xff\xd8"
    assert [image.format for image in images] == ["jpeg", "jpeg"]


def depth_of(frame: list[StampedMessage]) -> np.ndarray:
    (message,) = [m for m in frame if m.topic.endswith("depth/image")]
    return DepthImage.from_cdr(message.data).depth_mm


def test_invalid_codes_become_zero(folder: Path, stored: np.ndarray) -> None:
    expected = stored.copy()
    expected[stored == 65535] = 0
    np.testing.assert_array_equal(depth_of(messages_of(folder)[0]), expected)


@pytest.mark.parametrize("unit_m", [1000.0, 1e-9])
def test_a_unit_that_leaves_no_depth_is_refused(
    unit_m: float, folder: Path, index_record: dict[str, Any]
) -> None:
    """Sixteen bits of millimetres end at 65.5 m; all zeros would say that nothing was measured."""
    rewrite(folder, {**index_record, "depth_unit_m": unit_m})
    with pytest.raises(FolderError, match=r"with .* m for each stored number .*depth_unit_m"):
        messages_of(folder)


def test_an_image_in_which_nothing_was_measured_is_no_wrong_unit(folder: Path) -> None:
    (folder / "d.png").write_bytes(png16(np.full((HEIGHT, WIDTH), 65535)))
    assert not depth_of(messages_of(folder)[0]).any()


def test_frames_without_depth_are_refused(folder: Path, index_record: dict[str, Any]) -> None:
    frames = [{k: v for k, v in f.items() if k != "depth"} for f in index_record["frames"]]
    rewrite(folder, {**index_record, "frames": frames})
    with pytest.raises(FolderError, match=r"no depth image. A scene is rebuilt from depth"):
        read_index(folder)


def test_rotated_bits_are_turned_back(
    folder: Path, stored: np.ndarray, index_record: dict[str, Any]
) -> None:
    wide = stored.astype(np.uint32)
    rotated = ((wide << 3) | (wide >> 13)) & 0xFFFF
    (folder / "d.png").write_bytes(png16(rotated))
    rewrite(folder, {**index_record, "depth_encoding": "rotated3", "depth_invalid_values": [0]})
    np.testing.assert_array_equal(depth_of(messages_of(folder)[0]), stored)


def test_a_colour_camera_of_its_own_is_kept_apart(
    folder: Path, index_record: dict[str, Any]
) -> None:
    estimate = {
        "fx": 8.0,
        "fy": 8.0,
        "cx": 4.2,
        "cy": 2.8,
        "t_color_from_depth_m": [-0.035, 0.0075, 0.0],
        "R_color_from_depth": "identity assumed",
    }
    rewrite(
        folder,
        {**index_record, "color_registered_to_depth": False, "color_camera_estimate": estimate},
    )
    first = messages_of(folder)[0]
    by_topic = {m.topic: m.data for m in first}
    info = CameraInfo.from_cdr(by_topic["/lab/cam/eye/color/info"])
    assert info.frame_id == "eye_color_optical"
    np.testing.assert_allclose(info.camera.to_ros(), (8.0, 8.0, 4.2, 2.8))
    (between,) = transforms_from_cdr(by_topic["/tf_static"])
    assert (between.parent, between.child) == ("eye_depth_optical", "eye_color_optical")
    # A point of the depth camera, moved by t, is where the colour camera sees it.
    p_depth = np.array([0.1, 0.2, 1.0, 1.0])
    p_color = np.linalg.inv(between.T_parent_child) @ p_depth
    np.testing.assert_allclose(p_color[:3], p_depth[:3] + estimate["t_color_from_depth_m"])


def test_frames_without_a_pose_are_left_out_and_counted(
    folder: Path, index_record: dict[str, Any]
) -> None:
    record = copy.deepcopy(index_record)
    record["frames"][0]["T_world_cam"] = None
    rewrite(folder, record)
    index = read_index(folder)
    assert (len(index.frames), index.num_unposed) == (1, 1)


def broken(record: dict[str, Any], key: str, value: Any = None) -> dict[str, Any]:
    made = copy.deepcopy(record)
    if value is None:
        del made[key]
    else:
        made[key] = value
    return made


@pytest.mark.parametrize(
    ("key", "value", "match"),
    [
        ("depth_unit_m", None, r"scene.json: key 'depth_unit_m' is missing \(there: color_regis"),
        ("depth_intrinsics", None, "key 'depth_intrinsics' is missing"),
        ("depth_invalid_values", 0, "scene.json: a value of another kind .'int' object is not"),
        ("frames", [], "no frames"),
        ("depth_unit_m", -1, "depth_unit_m = -1. It must be a number above zero"),
        ("depth_encoding", [0], "scene.json: a value of another kind"),
        ("depth_encoding", "morse", "'morse' is unknown. Known: 'rotated3'"),
        ("color_registered_to_depth", False, "'color_camera_estimate' is missing"),
    ],
)
def test_a_broken_index_is_one_sentence(
    folder: Path, index_record: dict[str, Any], key: str, value: Any, match: str
) -> None:
    rewrite(folder, broken(index_record, key, value))
    if key == "color_registered_to_depth":
        rewrite(folder, {**index_record, key: False})
    with pytest.raises(FolderError, match=match) as caught:
        read_index(folder)
    assert caught.value.exit_code == 2


def test_a_matrix_that_is_no_rotation_is_refused(
    folder: Path, index_record: dict[str, Any]
) -> None:
    index_record["frames"][1]["T_world_cam"][0][0] = -1.0
    rewrite(folder, index_record)
    with pytest.raises(FolderError, match=r"rotation of T_world_cam of frames\[1\] is none"):
        read_index(folder)


LENSES = (
    *({"k1": -0.1}, {"is_fisheye": True}, {"distortion": [0, 0.1]}, {"D": {"k1": 0.1}}),
    *({"camera_model": "OPENCV_FISHEYE"}, {"distortion_model": "equidistant", "D": [0, 0]}),
)
STRAIGHT = {"camera_model": "PINHOLE", "distortion_model": "plumb_bob", "k1": 0, "D": [0.0] * 5}


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("where", ["", "depth_intrinsics", "frames"])
def test_a_lens_is_refused_whichever_key_says_it(
    folder: Path, index_record: dict[str, Any], lens: dict[str, Any], where: str
) -> None:
    part = index_record[where] if where else index_record
    part = part[1] if where == "frames" else part
    part |= STRAIGHT
    rewrite(folder, index_record)
    assert read_index(folder).unused == ()
    part |= lens
    rewrite(folder, index_record)
    with pytest.raises(FolderError, match=f"{'|'.join(lens)}|the model.*image_undistorter"):
        read_index(folder)


def test_keys_that_nobody_reads_are_named_with_their_frames(
    folder: Path, index_record: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    for frame in index_record["frames"]:
        frame["mask"] = "m.png"
    index_record["depth_intrinsics"]["skew"] = 0.1
    rewrite(folder, index_record)
    assert robot_gst.run(["import", "rgbd", str(folder), str(folder / "run")]) == 0
    said = capsys.readouterr().err
    assert all(f"not used: {what}: not read" in said for what in ("mask of 2 frames", "skew"))


def test_missing_files_are_named(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(PathNotFoundError, match=r"RGB-D folder not found: .*nowhere"):
        read_index(tmp_path / "nowhere")
    (folder / "d.png").unlink()
    with pytest.raises(PathNotFoundError, match=r"depth image not found: .*d.png.*frames\[0\]"):
        read_index(folder)
    (folder / "scene.json").unlink()
    with pytest.raises(PathNotFoundError, match=r"index not found: .*scene.json"):
        read_index(folder)
    (folder / "scene.json").write_text("{")
    with pytest.raises(FolderError, match="not readable as JSON"):
        read_index(folder)


def test_unreadable_and_misfit_images_are_named(folder: Path) -> None:
    whole = (folder / "c.jpg").read_bytes()
    (folder / "c.jpg").write_bytes(whole[:100])
    with pytest.raises(FolderError, match=r"c.jpg: unreadable image"):
        messages_of(folder)
    (folder / "c.jpg").write_bytes(whole)
    (folder / "d.png").write_bytes(png16(np.ones((3, 3))))
    with pytest.raises(FolderError, match=r"d.png: 3 x 3 pixels, camera 8 x 6"):
        messages_of(folder)
    (folder / "d.png").write_bytes(color_image("PNG"))
    with pytest.raises(FolderError, match=r"d.png: .*depth has 8 bits in 3 channels.*a 16-bit PNG"):
        messages_of(folder)


def test_names_that_cannot_be_topics_are_refused() -> None:
    with pytest.raises(UsageError, match="cell name 'a/b' cannot be part of a topic"):
        FolderConfig(cell="a/b")
    with pytest.raises(UsageError, match="--rate-hz 0"):
        FolderConfig(rate_hz=0.0)


def test_a_failed_import_leaves_no_episode(folder: Path, run: RunFolder) -> None:
    (folder / "c.png").write_bytes(b"no image")
    messages = (m for frame in folder_messages(read_index(folder), FolderConfig()) for m in frame)
    with pytest.raises(GstError, match="unreadable image"):
        write_scan(run, EpisodeInfo(id="scan", kind="scan"), messages, source={})
    assert list(run.episodes_dir.iterdir()) == []
