"""Colour and depth images in folders of their own become an index that the import reads."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from bridge.errors import UsageError
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from bridge.sources.folder.messages import read_index
from bridge.terminal import Output
from dashboards.opening import look_at
from dashboards.scene_index import propose_index, write_index

QUIET = Output(quiet=True)
K = np.array([[60.0, 0.0, 31.0], [0.0, 61.0, 23.0], [0.0, 0.0, 1.0]])


def pose(number: int) -> np.ndarray:
    R = se3.rotation_from_vector(np.array([0.1 * number, 0.2, 0.0]))
    return se3.transform_from(se3.quaternion_from_rotation(R), np.array([number, 2.0, 3.0]))


def images(folder: Path, numbers: range, *, color: str = "color", depth: str = "depth") -> Path:
    for name in (color, depth):
        (folder / name).mkdir(parents=True)
    for number in numbers:
        Image.new("RGB", (64, 48), (number, 0, 0)).save(folder / color / f"frame{number:06d}.jpg")
        plane = Image.fromarray(np.full((48, 64), 1000, dtype=np.uint16))
        plane.save(folder / depth / f"depth{number:06d}.png")
    return folder


def text(matrix: np.ndarray) -> str:
    return "\n".join(" ".join(repr(float(x)) for x in row) for row in matrix) + "\n"


def open3d(folder: Path, numbers: range) -> None:
    by_columns = {"width": 64, "height": 48, "intrinsic_matrix": K.T.ravel().tolist()}
    (folder / "camera_intrinsic.json").write_text(json.dumps(by_columns))
    blocks = [f"{n} {n} {n + 1}\n{text(pose(n))}" for n in numbers]
    (folder / "trajectory.log").write_text("".join(blocks))


def scannet(folder: Path, numbers: range) -> None:
    (folder / "intrinsic").mkdir()
    whole = np.eye(4)
    whole[:3, :3] = K
    (folder / "intrinsic" / "intrinsic_depth.txt").write_text(text(whole))
    (folder / "pose").mkdir()
    for n in numbers:
        (folder / "pose" / f"{n}.txt").write_text(text(pose(n)))


def replica(folder: Path, numbers: range) -> None:
    (folder / "camera-intrinsics.txt").write_text(text(K))
    rows = [" ".join(repr(float(x)) for x in pose(n).ravel()) for n in numbers]
    (folder / "traj.txt").write_text("\n".join(rows))


@pytest.mark.parametrize("export", [open3d, scannet, replica])
def test_the_import_reads_what_was_exported(tmp_path: Path, export: object) -> None:
    folder, numbers = images(tmp_path / "scan", range(5)), range(5)
    assert callable(export)
    export(folder, numbers)
    write_index(folder, folder / "scene.json", output=QUIET)
    index = read_index(folder)
    camera = index.depth_camera
    assert (camera.width, camera.height, index.depth_unit_m) == (64, 48, 0.001)
    assert camera == Camera.from_ros(
        width=64, height=48, fx=K[0, 0], fy=K[1, 1], cx=K[0, 2], cy=K[1, 2]
    )
    for n, frame in zip(numbers, index.frames, strict=True):
        assert frame.color_path.name == f"frame{n:06d}.jpg"
        assert frame.depth_path.name == f"depth{n:06d}.png"
        np.testing.assert_allclose(frame.T_world_depth, pose(n), atol=1e-9)


def test_lost_frames_and_images_without_a_partner_are_left_out(tmp_path: Path) -> None:
    """ScanNet writes -inf where tracking was lost."""
    folder = images(tmp_path / "scan", range(4), color="rgb")
    scannet(folder, range(4))
    (folder / "depth" / "depth000003.png").unlink()
    (folder / "pose" / "1.txt").write_text(text(np.full((4, 4), -np.inf)))
    index, notes = propose_index(folder)
    assert [frame["T_world_cam"] is None for frame in index["frames"]] == [False, True, False]
    assert notes[0] == "3 frames of 4 colour and 3 depth images"
    assert notes[-1] == "poses of 2 frames from pose"


def test_without_poses_the_images_themselves_are_followed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = images(tmp_path / "scan", range(2))
    (folder / "camera-intrinsics.txt").write_text(text(K))
    write_index(folder, folder / "scene.json", output=Output())
    assert "rebuild RUN --poses odometry" in capsys.readouterr().err
    assert len(read_index(folder).frames) == 2


@pytest.mark.parametrize(
    ("name", "content", "told"),
    [
        ("camera-intrinsics.txt", "1 2 3", "holds 3 numbers, not 3 x 3"),
        ("camera-intrinsics.txt", "1 2 x", "could not convert"),
        ("camera_intrinsic.json", "{}", "holds 0 numbers, not 3 x 3"),
        ("camera_intrinsic.json", "[1", "is no JSON object"),
        ("README", "", "does not say how its camera sees"),
    ],
)
def test_what_is_missing_is_named(tmp_path: Path, name: str, content: str, told: str) -> None:
    folder = images(tmp_path / "scan", range(2))
    (folder / name).write_text(content)
    with pytest.raises(UsageError, match=told):
        look_at(folder)


def test_a_log_that_names_some_frames_poses_those_alone(tmp_path: Path) -> None:
    """Numbers of images may begin at one; a log that names fewer goes by its numbers."""
    folder = images(tmp_path / "scan", range(1, 6))
    open3d(folder, range(5))
    index, _ = propose_index(folder)
    np.testing.assert_allclose([f["T_world_cam"] for f in index["frames"]], [*map(pose, range(5))])
    open3d(folder, range(1, 6, 2))
    index, _ = propose_index(folder)
    assert [f["T_world_cam"] is None for f in index["frames"]] == [False, True, False, True, False]
    np.testing.assert_allclose(index["frames"][2]["T_world_cam"], pose(3))
    open3d(folder, range(7))
    with pytest.raises(UsageError, match="7 poses for 5 frames"):
        propose_index(folder)


def test_colour_of_another_camera_is_seen_by_that_one(tmp_path: Path) -> None:
    """ScanNet's colour is 1296 x 968, its depth 640 x 480."""
    folder = images(tmp_path / "scan", range(2))
    scannet(folder, range(2))
    for path in (folder / "color").iterdir():
        Image.new("RGB", (130, 97)).save(path)
    with pytest.raises(UsageError, match="130 x 97 px is not what a depth camera of 64 x 48"):
        propose_index(folder)
    whole = np.diag([2.0, 2.0, 1.0, 1.0])
    whole[:3, :3] = whole[:3, :3] @ K
    (folder / "intrinsic" / "intrinsic_color.txt").write_text(text(whole))
    write_index(folder, folder / "scene.json", output=QUIET)
    color = read_index(folder).color_camera
    assert color == Camera.from_ros(
        width=130, height=97, fx=2 * K[0, 0], fy=2 * K[1, 1], cx=2 * K[0, 2], cy=2 * K[1, 2]
    )


def test_replica_has_both_kinds_in_one_folder_and_says_its_unit(tmp_path: Path) -> None:
    made = images(tmp_path / "made", range(3))
    folder = tmp_path / "scan"
    (folder / "results").mkdir(parents=True)
    for path in (*(made / "color").iterdir(), *(made / "depth").iterdir()):
        path.rename(folder / "results" / path.name)
    replica(folder, range(3))
    (folder / "camera-intrinsics.txt").unlink()
    camera = {"fx": 60, "fy": 61, "cx": 31, "cy": 23, "scale": 6553.5}
    (tmp_path / "cam_params.json").write_text(json.dumps({"camera": camera}))
    assert "depth is taken for 0.00015259 m a number" in look_at(folder).holds
    write_index(folder, folder / "scene.json", output=QUIET)
    index = read_index(folder)
    assert index.depth_unit_m == pytest.approx(1 / 6553.5)
    assert [frame.depth_path.name for frame in index.frames] == [
        f"depth{n:06d}.png" for n in range(3)
    ]


def test_a_path_that_holds_no_whole_poses_is_refused(tmp_path: Path) -> None:
    folder = images(tmp_path / "scan", range(2))
    (folder / "camera-intrinsics.txt").write_text(text(K))
    (folder / "traj.txt").write_text("1 2 3")
    with pytest.raises(UsageError, match="3 numbers, which are no poses of 16 each"):
        look_at(folder)
    (folder / "depth" / "depth000001.png").rename(folder / "depth" / "depth000009.png")
    (folder / "depth" / "depth000000.png").unlink()
    with pytest.raises(UsageError, match="the same number"):
        look_at(folder)


def test_an_index_is_written_into_its_folder_alone(tmp_path: Path) -> None:
    folder = images(tmp_path / "scan", range(2))
    replica(folder, range(2))
    with pytest.raises(UsageError, match=r"its index lies in it: .*scan/scene\.json"):
        write_index(folder, tmp_path / "run", output=QUIET)
    assert not (tmp_path / "run").exists()
