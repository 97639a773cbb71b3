"""Folders of posed images without depth: transforms.json."""

import json
from pathlib import Path

import numpy as np
import pytest

import robot_gst
from bridge.episode.cdr.messages import CameraInfo, CompressedColor, transforms_from_cdr
from bridge.episode.reader import Episode
from bridge.errors import GstError, PathNotFoundError, UsageError
from bridge.geometry import se3
from bridge.media.color import encode_jpeg
from bridge.sources.folder.config import FolderError
from bridge.sources.folder.posed import read_posed_index

WIDTH, HEIGHT, FOCAL = 32, 24, 30.0
CENTRE = np.array([0.3, -0.2, 4.0])
NUM_IMAGES = 5


def poses() -> list[np.ndarray]:
    """Cameras on an arc of radius 4 round one place, all looking at it."""
    up = np.array([0.0, -1.0, 0.0])
    places = [
        CENTRE + 4.0 * np.array([np.sin(a), 0.1 * k, -np.cos(a)])
        for k, a in enumerate(np.linspace(-0.4, 0.4, NUM_IMAGES))
    ]
    return [se3.look_at(place, CENTRE, up) for place in places]


def write_images(folder: Path) -> list[str]:
    (folder / "images").mkdir(parents=True)
    names = [f"images/{k:03d}.jpg" for k in range(NUM_IMAGES)]
    for k, name in enumerate(names):
        image = np.full((HEIGHT, WIDTH, 3), 20 * k, np.uint8)
        (folder / name).write_bytes(encode_jpeg(image))
    return names


def write_transforms(folder: Path, **changes: object) -> Path:
    names = write_images(folder)
    opengl = np.diag([1.0, -1.0, -1.0, 1.0])
    frames = [
        {"file_path": name, "transform_matrix": (T @ opengl).tolist()}
        for name, T in zip(names, poses(), strict=True)
    ]
    record = {"w": WIDTH, "h": HEIGHT, "fl_x": FOCAL, "cx": 15.0, "cy": 12.5, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(record | changes))
    return folder


def imported(folder: Path, run: Path, *words: str) -> Episode:
    assert robot_gst.run(["import", "images", str(folder), str(run), "--quiet", *words]) == 0
    return Episode.open(run / "episodes" / "scan.mcap")


def recorded_poses(episode: Episode) -> np.ndarray:
    found = [transforms_from_cdr(m.data) for m in episode.messages(["/tf"])]
    return np.stack([item.T_parent_child for items in found for item in items])


@pytest.mark.parametrize("scale", [None, 1.0, 0.25])
def test_the_poses_are_those_that_were_written(scale: float | None, tmp_path: Path) -> None:
    expected = np.stack(poses())
    expected[:, :3, 3] *= scale or 1.0
    folder = write_transforms(tmp_path / "folder")
    words = [] if scale is None else ["--metres-per-unit", str(scale)]
    episode = imported(folder, tmp_path / "run", *words)
    np.testing.assert_allclose(recorded_poses(episode), expected, atol=1e-9)
    info = CameraInfo.from_cdr(next(iter(episode.messages(["/scene/cam/camera/color/info"]))).data)
    assert (info.camera.fx, info.camera.cx, info.camera.cy) == (FOCAL, 15.0, 12.5)
    stored = [
        CompressedColor.from_cdr(m.data).data
        for m in episode.messages(["/scene/cam/camera/color/image"])
    ]
    assert stored == [p.read_bytes() for p in sorted((folder / "images").iterdir())]
    assert episode.metadata_records["source"]["is_metric"] is (scale is not None)


TURNED = np.eye(4).tolist()
OUTSIDE = {"file_path": "../secret.jpg", "transform_matrix": TURNED}
STRETCHED = {"file_path": "images/000.jpg", "transform_matrix": np.diag([2.0, 2, 2, 1]).tolist()}


@pytest.mark.parametrize(
    ("change", "found"),
    [
        ({"camera_model": "OPENCV_FISHEYE"}, "OPENCV_FISHEYE"),
        ({"k3": 0.1}, "k3"),
        ({"p2": -0.01}, "p2"),
        ({"fl_x": "wide"}, "fl_x"),
        ({"fl_x": -1.0}, "focal lengths"),
        ({"w": None}, "w"),
        ({"frames": []}, "no frame"),
        ({"frames": [{"file_path": "images/000.jpg"}]}, "transform_matrix"),
        ({"frames": [OUTSIDE]}, "secret"),
        ({"frames": [STRETCHED]}, "rotation"),
        ({"frames": None}, "no list of frames"),
        ({"frames": [{"file_path": "a\0b", "transform_matrix": TURNED}]}, "image not found"),
        ({"frames": [{"file_path": "a" * 5000, "transform_matrix": TURNED}]}, "image not found"),
        ({"fl_x": 10**400}, "fl_x"),
        ({"w": 1e12}, "At most 65500"),
        ({"camera_angle_x": 0}, "camera_angle_x of 0"),
        ({"distortion_model": "kannala_brandt4"}, "has the model 'kannala_brandt4'"),
    ],
)
def test_a_wrong_transforms_file_is_refused_by_name(
    change: dict[str, object], found: str, tmp_path: Path
) -> None:
    folder = write_transforms(tmp_path / "folder", **change)
    (tmp_path / "secret.jpg").write_bytes(b"-")
    with pytest.raises(GstError, match=found):
        read_posed_index(folder)


def test_an_index_nested_beyond_reading_is_refused(tmp_path: Path) -> None:
    folder = write_transforms(tmp_path / "folder")
    (folder / "transforms.json").write_text("[" * 100_000)
    with pytest.raises(FolderError, match="no list of frames"):
        read_posed_index(folder)


def test_what_is_missing_is_named(tmp_path: Path) -> None:
    with pytest.raises(PathNotFoundError, match=r"transforms\.json"):
        read_posed_index(tmp_path)
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    for name in ("images.bin", "images.txt"):
        (tmp_path / "sparse" / "0" / name).write_bytes(b"")
        with pytest.raises(PathNotFoundError, match=rf"{name} is COLMAP's: ns-process-data"):
            read_posed_index(tmp_path)
    folder = write_transforms(tmp_path / "folder")
    (folder / "images" / "002.jpg").unlink()
    with pytest.raises(UsageError, match=r"002\.jpg"):
        read_posed_index(folder)


def test_an_image_of_another_size_ends_the_import_and_leaves_nothing(tmp_path: Path) -> None:
    folder = write_transforms(tmp_path / "folder")
    (folder / "images" / "003.jpg").write_bytes(encode_jpeg(np.zeros((8, 8, 3), np.uint8)))
    words = ["import", "images", str(folder), str(tmp_path / "run"), "--quiet"]
    assert robot_gst.run(words) == 2
    assert not list((tmp_path / "run" / "episodes").glob("*.mcap"))
