"""Folders of posed images without depth: COLMAP's text model and transforms.json."""

import json
from pathlib import Path

import numpy as np
import pytest

import robot_gst
from bridge.episode.cdr.messages import CameraInfo, CompressedColor, transforms_from_cdr
from bridge.episode.reader import Episode
from bridge.errors import GstError, PathNotFoundError, UsageError
from bridge.geometry import se3
from bridge.geometry.cameras_view import distance_to_what_is_seen
from bridge.media.color import encode_jpeg
from bridge.sources.folder.config import FolderError, PosedConfig
from bridge.sources.folder.posed_index import read_posed_index
from bridge.sources.folder.posed_messages import metres_per_unit

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


def write_colmap(folder: Path, camera: str = f"PINHOLE 32 24 {FOCAL} {FOCAL} 15 12.5") -> Path:
    names = write_images(folder)
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text(f"# a comment\n1 {camera}\n")
    lines = []
    for k, (name, T) in enumerate(zip(names, poses(), strict=True), start=1):
        q, p = se3.split(se3.invert(T))
        numbers = " ".join(repr(float(v)) for v in (*q, *p))
        lines += [f"{k} {numbers} 1 {Path(name).name}", "" if k % 2 else "1.0 2.0 -1"]
    (model / "images.txt").write_text("# comments\n" + "\n".join(lines) + "\n")
    point = " ".join(str(v) for v in CENTRE)
    (model / "points3D.txt").write_text(f"# points\n1 {point} 9 9 9 0.5 1 0\n")
    return folder


def imported(folder: Path, run: Path, *words: str) -> Episode:
    assert robot_gst.run(["import", "images", str(folder), str(run), "--quiet", *words]) == 0
    return Episode.open(run / "episodes" / "scan.mcap")


def recorded_poses(episode: Episode) -> np.ndarray:
    found = [transforms_from_cdr(m.data) for m in episode.messages(["/tf"])]
    return np.stack([item.T_parent_child for items in found for item in items])


def test_both_layouts_give_the_poses_that_were_written(tmp_path: Path) -> None:
    expected = np.stack(poses())
    for name, write in (("nerf", write_transforms), ("colmap", write_colmap)):
        folder = write(tmp_path / name)
        episode = imported(folder, tmp_path / f"{name}_run", "--metres-per-unit", "1")
        np.testing.assert_allclose(recorded_poses(episode), expected, atol=1e-9)
        info = CameraInfo.from_cdr(
            next(iter(episode.messages(["/scene/cam/camera/color/info"]))).data
        )
        assert (info.camera.fx, info.camera.cx, info.camera.cy) == (FOCAL, 15.0, 12.5)
        stored = [
            CompressedColor.from_cdr(m.data).data
            for m in episode.messages(["/scene/cam/camera/color/image"])
        ]
        assert stored == [p.read_bytes() for p in sorted((folder / "images").iterdir())]
        assert episode.metadata_records["source"]["is_metric"] is True


@pytest.mark.parametrize("write", [write_transforms, write_colmap])
def test_poses_without_a_scale_look_at_what_is_one_metre_away(
    write: object, tmp_path: Path
) -> None:
    folder = write(tmp_path / "folder")  # type: ignore[operator]
    episode = imported(folder, tmp_path / "run")
    source = episode.metadata_records["source"]
    assert source["is_metric"] is False
    found = recorded_poses(episode)
    assert distance_to_what_is_seen(found) == pytest.approx(1.0, rel=0.03)
    scaled = np.stack(poses())[:, :3, 3] * source["metres_per_unit"]
    np.testing.assert_allclose(found[:, :3, 3], scaled, atol=1e-9)


def test_parallel_axes_without_points_need_a_scale(tmp_path: Path) -> None:
    folder = write_transforms(tmp_path / "folder")
    record = json.loads((folder / "transforms.json").read_text())
    for k, frame in enumerate(record["frames"]):
        T = np.eye(4)
        T[0, 3] = k
        frame["transform_matrix"] = T.tolist()
    (folder / "transforms.json").write_text(json.dumps(record))
    index = read_posed_index(folder)
    with pytest.raises(FolderError, match="--metres-per-unit"):
        metres_per_unit(index, PosedConfig())
    assert metres_per_unit(index, PosedConfig(metres_per_unit=2.0)) == 2.0


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


@pytest.mark.parametrize(
    ("camera", "found"),
    [
        ("OPENCV 32 24 30 30 15 12 0 0 0 0", "image_undistorter"),
        ("PINHOLE 32 24 30 30 15", "3 numbers"),
        ("PINHOLE 32 24 nan 30 15 12", "not finite"),
        ("PINHOLE 32 24 -30 30 15 12", "focal lengths -30"),
        ("PINHOLE 99999999999 24 30 30 15 12", "At most 65500"),
    ],
)
def test_a_wrong_colmap_camera_is_refused(camera: str, found: str, tmp_path: Path) -> None:
    folder = write_colmap(tmp_path / "folder", camera)
    with pytest.raises(FolderError, match=found):
        read_posed_index(folder)


@pytest.mark.parametrize(
    ("name", "old", "new", "found"),
    [
        ("images.txt", "1 ", "1 nan ", "not finite"),
        ("images.txt", "000.jpg", "../../../secret.jpg", "image not found"),
        ("points3D.txt", "1 0.3 -0.2 4.0 9 9 9 0.5 1 0", "1 2", "fewer than three"),
    ],
)
def test_a_broken_colmap_line_ends_the_import_as_wrong_use(
    name: str, old: str, new: str, found: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_colmap(tmp_path / "folder")
    (tmp_path / "secret.jpg").write_bytes(encode_jpeg(np.zeros((HEIGHT, WIDTH, 3), np.uint8)))
    path = folder / "sparse" / "0" / name
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    run = tmp_path / "run"
    assert robot_gst.run(["import", "images", str(folder), str(run), "--quiet"]) == 2
    assert found in capsys.readouterr().err
    assert not list(run.rglob("*.mcap"))


def test_an_index_nested_beyond_reading_is_refused(tmp_path: Path) -> None:
    folder = write_transforms(tmp_path / "folder")
    (folder / "transforms.json").write_text("[" * 100_000)
    with pytest.raises(FolderError, match="no list of frames"):
        read_posed_index(folder)


def test_what_is_missing_is_named(tmp_path: Path) -> None:
    with pytest.raises(PathNotFoundError, match=r"transforms\.json"):
        read_posed_index(tmp_path)
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    (tmp_path / "sparse" / "0" / "images.bin").write_bytes(b"")
    with pytest.raises(PathNotFoundError, match="model_converter"):
        read_posed_index(tmp_path)
    folder = write_colmap(tmp_path / "folder")
    (folder / "images" / "002.jpg").unlink()
    with pytest.raises(UsageError, match=r"002\.jpg"):
        read_posed_index(folder)


def test_an_image_of_another_size_ends_the_import_and_leaves_nothing(tmp_path: Path) -> None:
    folder = write_transforms(tmp_path / "folder")
    (folder / "images" / "003.jpg").write_bytes(encode_jpeg(np.zeros((8, 8, 3), np.uint8)))
    words = ["import", "images", str(folder), str(tmp_path / "run"), "--quiet"]
    assert robot_gst.run(words) == 2
    assert not list((tmp_path / "run" / "episodes").glob("*.mcap"))
