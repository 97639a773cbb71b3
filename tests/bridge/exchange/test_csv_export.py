"""``export csv``: every number reads back as itself, and the same input gives the same bytes."""

import csv
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from commands import run
from joint_samples import at_positions

from bridge.episode import schema
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.streams import joint_track, pose_track
from bridge.episode.writer import EpisodeWriter
from bridge.exchange.output import new_folder


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
