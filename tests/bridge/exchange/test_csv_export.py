"""``export csv``, ``export tum``: every number reads back as itself, what goes out comes back."""

import csv
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from commands import run
from joint_samples import at_positions
from PIL import Image

from bridge.episode import schema
from bridge.episode.cdr.messages import CompressedColor, DepthImage
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.streams import joint_track, pose_track, rgbd_frames
from bridge.episode.writer import EpisodeWriter
from bridge.exchange.output import new_folder
from bridge.geometry import se3


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream, strict=True))


def test_joints_and_poses_read_back_exactly(
    make_trial: Callable[..., Path], tmp_path: Path
) -> None:
    path = make_trial(cameras=())
    assert run("export", "csv", path, tmp_path / "out") == 0
    track = joint_track(Episode.open(path))
    joints = rows(tmp_path / "out" / "joints.csv")
    assert len(joints) == track.position.size
    position = np.array([float(row["position"]) for row in joints])
    np.testing.assert_array_equal(position.reshape(-1, 3), track.position)
    assert [int(row["stamp_ns"]) for row in joints[::3]] == track.stamps_ns.tolist()
    assert joints[0]["stamp_s"] == "1700000000.123456789"
    assert int(joints[0]["log_ns"]) == int(joints[0]["stamp_ns"]) + 1_000_000
    assert {row["velocity"] for row in joints} == {repr(1 / 3)}
    assert {row["effort"] for row in joints} == {""}
    (pose,) = rows(tmp_path / "out" / "poses.csv")
    there = pose_track(Episode.open(path), "/lab/tcp/pose")
    assert [float(pose[f"{axis}_m"]) for axis in "xyz"] == there.p_m[0].tolist()
    assert [float(pose[f"q{axis}"]) for axis in "wxyz"] == there.q_wxyz[0].tolist()


def test_events_verdicts_and_losses_have_their_own_files(
    make_trial: Callable[..., Path], tmp_path: Path
) -> None:
    path = make_trial(cameras=(), num_frames=3)
    assert run("export", "csv", path, tmp_path / "out") == 0
    events = rows(tmp_path / "out" / "events.csv")
    assert [row["type"] for row in events] == ["execution_started", "mark", "execution_ended"]
    assert events[1]["text"] == 'a "quoted", word\nand more'
    (verdict,) = rows(tmp_path / "out" / "verdicts.csv")
    assert (verdict["accepted"], verdict["ik"], verdict["clearance"]) == ("false", "true", "false")
    assert (verdict["terminal"], verdict["clearance_cause"]) == ("", "touched")
    assert verdict["p_high"] == "0.3"
    (drops,) = rows(tmp_path / "out" / "drops.csv")
    assert (drops["of_topic"], drops["gaps"]) == ("/lab/joint_states", "2")
    (about,) = rows(tmp_path / "out" / "episodes.csv")
    assert (about["id"], about["result"], about["k"], about["n"]) == (
        "trial_0001",
        "success",
        "1",
        "1",
    )
    raw = (tmp_path / "out" / "events.csv").read_bytes()
    assert raw.count(b"\r\n") == 4  # header and three rows; the mark's own line break is bare


def test_the_same_run_gives_the_same_bytes_and_every_column_is_explained(
    make_trial: Callable[..., Path], tmp_path: Path
) -> None:
    make_trial(cameras=(), id="b", num_frames=3)
    make_trial(cameras=(), id="a", num_frames=3)
    for name in ("one", "two"):
        assert run("export", "csv", tmp_path / "run", tmp_path / name) == 0
    one, two = ({p.name: p.read_bytes() for p in (tmp_path / n).iterdir()} for n in ("one", "two"))
    assert one == two
    note = json.loads(one["robot_gst_export.json"])
    for name, columns in note["columns"].items():
        header = one[name].split(b"\r\n")[0].decode().split(",")
        assert header == list(columns)
        assert all(columns.values())
    files = [row["file"] for row in rows(tmp_path / "one" / "episodes.csv")]
    assert files == ["episodes/a.mcap", "episodes/b.mcap"]


def test_a_broken_message_is_named_and_nothing_is_left(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "broken.mcap"
    good = at_positions(1, ("a",), np.zeros(1)).to_cdr()
    with EpisodeWriter(path) as writer:
        writer.describe(EpisodeInfo(id="broken", kind="trial"))
        for data in (good, good[:9]):
            writer.write("/x/joint_states", data, type_name=schema.JOINT_STATE, log_time_ns=1)
    assert run("export", "csv", path, tmp_path / "out") == 1
    assert "broken.mcap: message 2 of /x/joint_states" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["broken.mcap"]


@pytest.mark.parametrize("value", [0.1, -0.0, 5e-324, 1.7976931348623157e308, 1 / 3, 1e22])
def test_awkward_numbers_survive(tmp_path: Path, value: float) -> None:
    path = tmp_path / "n.mcap"
    sample = at_positions(7, ("a",), np.array([value]))
    with EpisodeWriter(path) as writer:
        writer.describe(EpisodeInfo(id="n", kind="trial"))
        writer.write(
            "/x/gripper/state", sample.to_cdr(), type_name=schema.JOINT_STATE, log_time_ns=9
        )
    assert run("export", "csv", path, tmp_path / "out") == 0
    (row,) = rows(tmp_path / "out" / "gripper.csv")
    assert np.float64(row["position"]).tobytes() == np.float64(value).tobytes()
    assert row["stamp_s"] == "0.000000007"


def test_an_empty_run_is_wrong_use(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "run").mkdir()
    assert run("export", "csv", tmp_path / "run", tmp_path / "out") == 2
    assert "no episodes in" in capsys.readouterr().err


def test_a_full_disk_is_named_and_leaves_nothing(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with pytest.raises(OSError, match="No space") as error, new_folder(out, force=False):
        raise OSError(28, "No space left on device")
    assert error.value.filename == str(out)
    assert not list(tmp_path.iterdir())


def images(path: Path, camera: str, kind: str) -> list[tuple[int, object]]:
    episode = Episode.open(path)
    (topic,) = [t for t in episode.topics() if t.endswith(f"/cam/{camera}/{kind}/image")]
    found: list[tuple[int, object]] = []
    for message in episode.messages([topic]):
        if kind == "color":
            color = CompressedColor.from_cdr(message.data)
            found.append((color.stamp_ns, bytes(color.data)))
        else:
            depth = DepthImage.from_cdr(message.data)
            found.append((depth.stamp_ns, depth.depth_mm.tobytes()))
    return found


@pytest.mark.parametrize("lag_ns", [0, 3_333_333])
@pytest.mark.parametrize("registered", [True, False])
def test_an_exported_episode_comes_back_bit_for_bit(
    make_trial: Callable[..., Path], tmp_path: Path, lag_ns: int, registered: bool
) -> None:
    T_color_depth = np.eye(4)
    if not registered:
        T_color_depth = se3.transform_from(
            np.array([np.cos(0.02), np.sin(0.02), 0.0, 0.0]), np.array([0.03, -0.01, 0.002])
        )
    path = make_trial(depth_lag_ns=lag_ns, T_color_depth=T_color_depth)
    assert run("export", "tum", path, tmp_path / "tum") == 0
    assert run("import", "rgbd", tmp_path / "tum", tmp_path / "back", "--camera", "wrist") == 0
    back = tmp_path / "back" / "episodes" / "scan.mcap"
    for kind in ("color", "depth"):
        assert images(back, "wrist", kind) == images(path, "wrist", kind)
    before, after = (list(rgbd_frames(Episode.open(p), "wrist")) for p in (path, back))
    assert len(after) == len(before) == 12
    for old, new in zip(before, after, strict=True):
        assert new.stamp_ns == old.stamp_ns
        np.testing.assert_allclose(new.T_base_color, old.T_base_color, atol=1e-12)
        np.testing.assert_allclose(new.T_base_depth, old.T_base_depth, atol=1e-12)
        assert new.color_camera == old.color_camera
        assert new.depth_camera == old.depth_camera
    assert run("check", back) == 0


def test_the_files_are_what_the_benchmark_describes(
    make_trial: Callable[..., Path], tmp_path: Path
) -> None:
    path = make_trial(num_frames=3)
    assert run("export", "tum", path, tmp_path / "tum") == 0
    folder = tmp_path / "tum"
    lines = (folder / "depth.txt").read_text().splitlines()
    assert lines[2] == "1700000000.123456789 depth/1700000000.123456789.png"
    stamp, name = lines[3].split()
    with Image.open(folder / name) as image:
        stored = np.asarray(image).astype(np.int64)
        assert image.mode == "I;16"
    (first, second, third) = images(path, "wrist", "depth")
    assert stamp == "1700000000.156790122"
    np.testing.assert_array_equal(stored.ravel(), 5 * np.frombuffer(second[1], np.uint16))  # type: ignore[call-overload]
    with Image.open(folder / "rgb" / "1700000000.123456789.jpg") as image:
        assert image.size == (32, 24)
        assert image.mode == "RGB"
    rows = np.loadtxt(folder / "groundtruth.txt")
    assert rows.shape == (3, 8)
    # The last four are qx qy qz qw: the camera turns about z.
    np.testing.assert_allclose(rows[0, 4:], [0, 0, 0, 1], atol=1e-12)
    assert rows[2, 6] > 0.03
    assert first[0] < third[0]


def test_depth_that_does_not_fit_is_left_out_and_counted(
    make_trial: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = make_trial(num_frames=2, far_mm=60_000)
    assert run("export", "tum", path, tmp_path / "tum", "--json") == 0
    (camera,) = json.loads(capsys.readouterr().out)["cameras"]
    every = np.concatenate([np.frombuffer(d, np.uint16) for _, d in images(path, "wrist", "depth")])  # type: ignore[call-overload]
    assert camera["depth_pixels_too_far"] == int((every > 13107).sum()) > 0


def test_several_cameras_get_a_folder_each(make_trial: Callable[..., Path], tmp_path: Path) -> None:
    path = make_trial(cameras=("side", "wrist"), num_frames=2)
    assert run("export", "tum", path, tmp_path / "both") == 0
    assert (tmp_path / "both" / "side" / "rgb.txt").is_file()
    assert (tmp_path / "both" / "wrist" / "rgb.txt").is_file()
    assert run("export", "tum", path, tmp_path / "one", "--camera", "side") == 0
    assert (tmp_path / "one" / "rgb.txt").is_file()


def test_nothing_that_is_not_an_export_is_ever_replaced(
    make_trial: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = make_trial(num_frames=2), tmp_path / "out"
    assert run("export", "tum", path, out) == 0
    assert run("export", "tum", path, out) == 2
    assert "replace it with --force" in capsys.readouterr().err
    (out / "leftover").write_text("x")
    assert run("export", "tum", path, out, "--force") == 0
    assert not (out / "leftover").exists()
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "thesis.txt").write_text("x")
    assert run("export", "tum", path, mine, "--force") == 2
    assert "not written by an export" in capsys.readouterr().err
    assert (mine / "thesis.txt").read_text() == "x"
    link = tmp_path / "link"
    link.symlink_to(out)
    assert run("export", "tum", path, link, "--force") == 2


def test_a_failed_export_leaves_nothing(
    make_trial: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = make_trial(num_frames=2)
    assert run("export", "tum", path, tmp_path / "out", "--camera", "nose") == 1
    assert "no camera 'nose'. Cameras here: wrist" in capsys.readouterr().err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run"]


def test_names_from_a_recording_cannot_leave_the_folder_or_meet() -> None:
    from bridge.exchange.output import safe_names

    names = safe_names(["..", "a.b", "a_b", "../../etc", "\u0000", "wrist"])
    assert len(set(names.values())) == 6
    assert all(set(name) <= set("abcdefghijklmnopqrstuvwxyz_0123456789") for name in names.values())
    assert names["wrist"] == "wrist"
