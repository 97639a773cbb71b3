"""Folders as NeRF programs keep them: transforms.json with colour and depth images."""

import json
from pathlib import Path

import numpy as np
import pytest

import robot_gst
from bridge.episode.cdr.messages import (
    CameraInfo,
    CompressedColor,
    DepthImage,
    transforms_from_cdr,
)
from bridge.episode.reader import Episode
from bridge.errors import GstError, PathNotFoundError, UsageError
from bridge.geometry import se3
from bridge.media.color import encode_jpeg, encode_png
from bridge.sources.folder.config import FolderConfig, FolderError
from bridge.sources.folder.messages import read_index

WIDTH, HEIGHT, FOCAL = 32, 24, 30.0
CENTRE = np.array([0.3, -0.2, 4.0])
NUM_IMAGES = 5
TURNED = np.eye(4).tolist()


def poses() -> list[np.ndarray]:
    """Cameras on an arc of radius 4 round one place, all looking at it."""
    up = np.array([0.0, -1.0, 0.0])
    places = [
        CENTRE + 4.0 * np.array([np.sin(a), 0.1 * k, -np.cos(a)])
        for k, a in enumerate(np.linspace(-0.4, 0.4, NUM_IMAGES))
    ]
    return [se3.look_at(place, CENTRE, up) for place in places]


def depth_of(number: int) -> np.ndarray:
    return np.full((HEIGHT, WIDTH), 1000 + number, np.uint16)


def write_transforms(folder: Path, **changes: object) -> Path:
    for name in ("images", "depth"):
        (folder / name).mkdir(parents=True)
    opengl, frames = np.diag([1.0, -1.0, -1.0, 1.0]), []
    for k, T in enumerate(poses()):
        image = np.full((HEIGHT, WIDTH, 3), 20 * k, np.uint8)
        (folder / "images" / f"{k:03d}.jpg").write_bytes(encode_jpeg(image))
        (folder / "depth" / f"{k:03d}.png").write_bytes(encode_png(depth_of(k)))
        names = {"file_path": f"images/{k:03d}.jpg", "depth_file_path": f"depth/{k:03d}"}
        frames.append({**names, "transform_matrix": (T @ opengl).tolist()})
    record = {"w": WIDTH, "h": HEIGHT, "fl_x": FOCAL, "cx": 15.0, "cy": 12.5, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(record | changes))
    return folder


@pytest.mark.parametrize(
    ("about", "words", "unit"),
    [({}, (), 1.0), ({"depth_unit_scale_factor": 2e-4}, (), 0.2), ({}, ("5e-4",), 0.5)],
)
def test_poses_colour_and_depth_are_those_that_were_written(
    about: dict[str, object], words: tuple[str, ...], unit: float, tmp_path: Path
) -> None:
    folder = write_transforms(tmp_path / "folder", **about)
    command = ["import", "rgbd", str(folder), str(tmp_path / "run"), "--quiet", "--cell", "lab"]
    command += [word for number in words for word in ("--depth-unit-m", number)]
    assert robot_gst.run(command) == 0
    episode = Episode.open(tmp_path / "run" / "episodes" / "scan.mcap")

    def read(topic: str) -> list[bytes]:
        return [message.data for message in episode.messages([topic])]

    found = [item.T_parent_child for data in read("/tf") for item in transforms_from_cdr(data)]
    np.testing.assert_allclose(np.stack(found), np.stack(poses()), atol=1e-9)
    for stream in ("color", "depth"):
        camera = CameraInfo.from_cdr(read(f"/lab/cam/kinect/{stream}/info")[0]).camera
        assert (camera.width, camera.fx, camera.cx, camera.cy) == (WIDTH, FOCAL, 15.0, 12.5)
    colors = [CompressedColor.from_cdr(each).data for each in read("/lab/cam/kinect/color/image")]
    assert colors == [p.read_bytes() for p in sorted((folder / "images").iterdir())]
    for number, data in enumerate(read("/lab/cam/kinect/depth/image")):
        expected = np.rint(depth_of(number) * unit)
        np.testing.assert_array_equal(DepthImage.from_cdr(data).depth_mm, expected)


OUTSIDE = {"file_path": "../secret.jpg", "depth_file_path": "depth/000.png"}
PLAIN = {"file_path": "images/000.jpg", "depth_file_path": "depth/000.png"}
STRETCHED = {**PLAIN, "transform_matrix": np.diag([2.0, 2, 2, 1]).tolist()}


@pytest.mark.parametrize(
    ("change", "found"),
    [
        ({"camera_model": "OPENCV_FISHEYE"}, "OPENCV_FISHEYE"),
        ({"k3": 0.1}, "k3"),
        ({"p2": -0.01}, "p2"),
        ({"is_fisheye": True}, "frame 1 has is_fisheye"),
        ({"fl_x": "wide"}, "fl_x"),
        ({"fl_x": -1.0}, "focal lengths"),
        ({"w": None}, "w"),
        ({"frames": []}, "0 different cameras in 0 frames"),
        ({"frames": [PLAIN]}, "transform_matrix"),
        ({"frames": [OUTSIDE | {"transform_matrix": TURNED}]}, "secret"),
        ({"frames": [STRETCHED]}, "rotation"),
        ({"frames": [{**PLAIN, "transform_matrix": TURNED, "fl_x": f} for f in (20, 30)]}, "2 dif"),
        ({"frames": None}, "no list of frames"),
        ({"frames": [{**PLAIN, "file_path": "a\0b"}]}, "image not found"),
        ({"frames": [{**PLAIN, "file_path": "a" * 5000}]}, "image not found"),
        ({"fl_x": 10**400}, "fl_x"),
        ({"w": 1e12}, "At most 65500"),
        ({"camera_angle_x": 0}, "camera_angle_x of 0"),
        ({"distortion_model": "kannala_brandt4"}, "has the model 'kannala_brandt4'"),
        ({"depth_unit_scale_factor": "mm"}, "depth_unit_scale_factor: no number"),
    ],
)
def test_a_wrong_transforms_file_is_refused_by_name(
    change: dict[str, object], found: str, tmp_path: Path
) -> None:
    folder = write_transforms(tmp_path / "folder", **change)
    (tmp_path / "secret.jpg").write_bytes(b"-")
    with pytest.raises(GstError, match=found):
        read_index(folder)


def test_an_index_nested_beyond_reading_is_refused(tmp_path: Path) -> None:
    folder = write_transforms(tmp_path / "folder")
    (folder / "transforms.json").write_text("[" * 100_000)
    with pytest.raises(FolderError, match="no list of frames"):
        read_index(folder)


def test_intrinsics_stand_in_the_file_and_an_image_that_lacks_is_named(tmp_path: Path) -> None:
    folder = write_transforms(tmp_path / "folder")
    with pytest.raises(UsageError, match="--depth-intrinsics was given"):
        read_index(folder, FolderConfig(depth_intrinsics=(30.0, 30.0, 15.0, 12.0)))
    (folder / "images" / "002.jpg").unlink()
    with pytest.raises(PathNotFoundError, match=r"002\.jpg"):
        read_index(folder)


def test_an_image_of_another_size_ends_the_import_and_leaves_nothing(tmp_path: Path) -> None:
    folder = write_transforms(tmp_path / "folder")
    (folder / "images" / "003.jpg").write_bytes(encode_jpeg(np.zeros((8, 8, 3), np.uint8)))
    words = ["import", "rgbd", str(folder), str(tmp_path / "run"), "--quiet"]
    assert robot_gst.run(words) == 2
    assert not list((tmp_path / "run" / "episodes").glob("*.mcap"))
