"""``export lerobot``: the layout the format's repository states, and what the numbers mean."""

import json
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import run

from bridge.episode.reader import Episode
from bridge.exchange.lerobot.writer import RunningStats

av = pytest.importorskip("av")
pq = pytest.importorskip("pyarrow.parquet")

START_NS = 1_700_000_000_123_456_789


@pytest.fixture(scope="module")
def dataset(made_trial: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three trials, two cameras; the second failed."""
    folder = tmp_path_factory.mktemp("lerobot")

    def make(**fields: Any) -> None:
        made_trial(**fields).write(folder / "run" / "episodes" / f"{fields['id']}.mcap")

    for number, result in enumerate(("success", "failure", "success")):
        make(
            id=f"trial_{number}",
            cameras=("side", "wrist"),
            num_frames=12 + number,
            result=result,
            instruction="wipe" if number == 2 else "put the cube into the box",
        )
    make(id="scan", kind="scan", cameras=("side",))
    assert run("export", "lerobot", folder / "run", folder / "ds") == 0
    return folder / "ds"


def data(dataset: Path) -> list[dict[str, Any]]:
    return list(pq.read_table(dataset / "data/chunk-000/file-000.parquet").to_pylist())


def test_files_lie_where_the_format_says(dataset: Path) -> None:
    files = {path.relative_to(dataset).as_posix() for path in dataset.rglob("*") if path.is_file()}
    assert files == {
        "README.md",
        "robot_gst_export.json",
        "meta/info.json",
        "meta/stats.json",
        "meta/tasks.parquet",
        "meta/episodes/chunk-000/file-000.parquet",
        "data/chunk-000/file-000.parquet",
        "videos/observation.images.side/chunk-000/file-000.mp4",
        "videos/observation.images.wrist/chunk-000/file-000.mp4",
    }


def test_info_says_what_readers_look_for(dataset: Path) -> None:
    info = json.loads((dataset / "meta/info.json").read_text())
    assert {key: value for key, value in info.items() if key != "features"} == {
        "codebase_version": "v3.0",
        "robot_type": "arm",
        "total_episodes": 3,
        "total_frames": 39,
        "total_tasks": 2,
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": 30,
        "splits": {"train": "0:3"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
    }
    features = info["features"]
    names = ["a", "b", "c", "gripper_width"]
    assert features["observation.state"] == {"dtype": "float32", "shape": [4], "names": names}
    assert features["action"] == features["observation.state"]
    for key, dtype in {
        "timestamp": "float32",
        "frame_index": "int64",
        "episode_index": "int64",
        "index": "int64",
        "task_index": "int64",
        "next.done": "bool",
        "next.success": "bool",
    }.items():
        assert features[key] == {"dtype": dtype, "shape": [1], "names": None}
    assert features["observation.images.side"] == {
        "dtype": "video",
        "shape": [24, 32, 3],
        "names": ["height", "width", "channels"],
        "info": {
            "video.height": 24,
            "video.width": 32,
            "video.codec": "h264",
            "video.pix_fmt": "yuv420p",
            "video.is_depth_map": False,
            "video.fps": 30,
            "video.channels": 3,
            "has_audio": False,
        },
    }


def test_columns_are_the_features_and_nothing_else(dataset: Path) -> None:
    info = json.loads((dataset / "meta/info.json").read_text())
    schema = pq.read_schema(dataset / "data/chunk-000/file-000.parquet")
    wanted = {key for key, value in info["features"].items() if value["dtype"] != "video"}
    assert set(schema.names) == wanted
    types = {name: str(kind) for name, kind in zip(schema.names, schema.types, strict=True)}
    assert types["observation.state"].startswith("fixed_size_list<element: float>[4]")
    assert (types["timestamp"], types["index"], types["next.done"]) == ("float", "int64", "bool")
    file = pq.ParquetFile(dataset / "data/chunk-000/file-000.parquet")
    assert file.metadata.num_row_groups == 3  # one per episode


def test_episodes_say_where_their_rows_and_frames_lie(dataset: Path) -> None:
    path = dataset / "meta/episodes/chunk-000/file-000.parquet"
    rows = pq.read_table(path).to_pylist()
    frames = data(dataset)
    for number, row in enumerate(rows):
        assert row["episode_index"] == number
        assert row["data/chunk_index"] == row["data/file_index"] == 0
        assert row["meta/episodes/chunk_index"] == row["meta/episodes/file_index"] == 0
        first, last = row["dataset_from_index"], row["dataset_to_index"]
        assert last - first == row["length"] == 12 + number
        mine = frames[first:last]
        assert [item["episode_index"] for item in mine] == [number] * row["length"]
        assert [item["frame_index"] for item in mine] == list(range(row["length"]))
        assert [item["index"] for item in mine] == list(range(first, last))
        for key in ("observation.images.side", "observation.images.wrist"):
            assert row[f"videos/{key}/from_timestamp"] == pytest.approx(first / 30)
            assert row[f"videos/{key}/to_timestamp"] == pytest.approx(last / 30)
        assert row["stats/action/count"] == [row["length"]]
        assert np.shape(row["stats/observation.images.side/mean"]) == (3, 1, 1)
    assert [row["tasks"] for row in rows] == [["put the cube into the box"]] * 2 + [["wipe"]]


def test_tasks_are_found_by_their_words(dataset: Path) -> None:
    pd = pytest.importorskip("pandas")
    tasks = pd.read_parquet(dataset / "meta/tasks.parquet")
    assert tasks.loc["wipe"].task_index == 1
    assert tasks.index.name == "task"
    assert {row["task_index"] for row in data(dataset)[-14:]} == {1}


def test_state_is_measured_and_action_is_what_the_plan_commands_next(
    dataset: Path, made_trial: Any
) -> None:
    trial = made_trial(num_frames=12)
    for number, row in enumerate(data(dataset)[:12]):
        now, after = (START_NS + k * 10**9 // 30 for k in (number, number + 1))
        expected = [*trial.joint_at(now), 0.08 - (now - START_NS) * 1e-11]
        np.testing.assert_allclose(row["observation.state"], expected, atol=1e-7)
        assert row["timestamp"] == np.float32(number / 30)
        if number < 9:  # the plan ends at 0.3 s and holds then
            np.testing.assert_allclose(
                row["action"], [*(trial.joint_at(after) + 0.01), 0.08], atol=1e-7
            )
    np.testing.assert_allclose(data(dataset)[11]["action"][0], 0.31, atol=1e-6)


def test_success_stands_in_the_last_row_only(dataset: Path) -> None:
    rows = data(dataset)
    ends = [index for index, row in enumerate(rows) if row["next.done"]]
    assert ends == [11, 24, 38]
    assert [index for index, row in enumerate(rows) if row["next.success"]] == [11, 38]


def test_the_video_holds_the_images_in_order(dataset: Path, made_trial: Any) -> None:
    with av.open(str(dataset / "videos/observation.images.wrist/chunk-000/file-000.mp4")) as file:
        stream = file.streams.video[0]
        assert stream.codec_context.name == "h264"
        assert float(stream.average_rate) == 30
        found = [(frame.time, frame.key_frame, frame.to_ndarray(format="rgb24"))
                 for frame in file.decode(stream)]  # fmt: skip
    assert len(found) == 39
    np.testing.assert_allclose([time for time, _, _ in found], np.arange(39) / 30, atol=1e-6)
    for first, length in ((0, 12), (12, 13), (25, 14)):
        assert found[first][1]  # an episode can be decoded without the one before it
        for number in range(length):
            shown = found[first + number][2][6:, 6:].astype(float).mean(axis=(0, 1))
            sent = made_trial().image(number, "wrist")[6:, 6:].astype(float).mean(axis=(0, 1))
            np.testing.assert_allclose(shown, sent, atol=6)


def test_statistics_are_those_of_the_rows(dataset: Path) -> None:
    stats = json.loads((dataset / "meta/stats.json").read_text())
    for key in ("observation.state", "action"):
        rows = np.array([row[key] for row in data(dataset)])
        for name, value in (
            ("min", rows.min(axis=0)),
            ("max", rows.max(axis=0)),
            ("mean", rows.mean(axis=0)),
            ("std", rows.std(axis=0)),
        ):
            np.testing.assert_allclose(stats[key][name], value, atol=1e-6)
        assert stats[key]["count"] == [39]
    image = stats["observation.images.side"]
    assert np.shape(image["std"]) == (3, 1, 1)
    assert image["count"] == [39]
    assert 0 <= np.min(image["min"]) <= np.max(image["max"]) <= 1


def test_merged_statistics_are_those_of_the_whole() -> None:
    rng = np.random.default_rng(0)
    rows = rng.normal(1e6, 1.0, (1000, 3))
    total = RunningStats()
    for part in np.split(rows, [1, 2, 500, 500, 999]):
        other = RunningStats()
        other.add(part)
        total.merge(other)
    record = total.record()
    np.testing.assert_allclose(record["mean"], rows.mean(axis=0), rtol=1e-14)
    np.testing.assert_allclose(record["std"], rows.std(axis=0), rtol=1e-9)
    assert record["count"] == [1000]


@pytest.mark.parity
@pytest.mark.slow
def test_rerun_reads_the_dataset_as_lerobots(dataset: Path, tmp_path: Path) -> None:
    """Rerun has a LeRobot v3 reader of its own (Rust); it must find every episode and frame."""
    import subprocess
    import sys
    import time

    pytest.importorskip("rerun")
    script = """
import os, sys, time
import rerun as rr
rr.init("x")
rr.save(sys.argv[2])
rr.log_file_from_path(sys.argv[1])  # reads on a thread of its own, and does not say when it is done
sizes, end_s = [], time.monotonic() + 60
while time.monotonic() < end_s and (len(sizes) < 20 or sizes[-20] < sizes[-1] or sizes[-1] < 2000):
    time.sleep(0.1)
    sizes.append(os.path.getsize(sys.argv[2]))
rr.disconnect()
"""
    out = tmp_path / "x.rrd"
    command = [sys.executable, "-c", script, str(dataset), str(out)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    assert "transcode" not in done.stderr  # every episode begins with a key frame
    time.sleep(0.1)
    rerun = Path(sys.executable).with_name("rerun")
    stats = subprocess.run(
        [rerun, "rrd", "stats", out], capture_output=True, text=True, timeout=60, check=True
    ).stdout
    for entity in ("/action", "/observation.state", "/observation.images.side", "/task"):
        assert f"\n{entity}: " in stats
    assert "RecordingInfo:name: 3" in stats


def test_without_plans_the_next_state_is_the_action(
    make_trial: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make_trial(id="t1", cameras=(), result=None)
    make_trial(id="t2", cameras=(), has_plan=False)
    assert run("export", "lerobot", tmp_path / "run", tmp_path / "ds", "--fps", 20) == 0
    assert "actions: next state" in capsys.readouterr().out
    rows = data(tmp_path / "ds")
    info = json.loads((tmp_path / "ds/meta/info.json").read_text())
    assert info["fps"] == 20
    assert info["video_path"] is None
    assert "next.success" not in info["features"]  # t1 was never labelled
    first = [row for row in rows if row["episode_index"] == 0]
    for row, after in pairwise(first):
        assert row["action"] == after["observation.state"]
    assert first[-1]["action"] == first[-1]["observation.state"]
    assert "next row" in (tmp_path / "ds/README.md").read_text()
    code = run("export", "lerobot", tmp_path / "run", tmp_path / "x", "--action", "plan")
    assert code == 1
    assert "t2.mcap: no executed plan" in capsys.readouterr().err


def test_episodes_that_do_not_belong_together_are_named(
    make_trial: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make_trial(id="t1", cameras=())
    make_trial(id="t2", cameras=(), joints=("a", "b", "q"))
    assert run("export", "lerobot", tmp_path / "run", tmp_path / "ds") == 1
    error = capsys.readouterr().err
    assert "t2.mcap: joints a, b, q, gripper_width" in error
    assert "t1.mcap has a, b, c" in error
    assert not (tmp_path / "ds").exists()
    assert run("export", "lerobot", tmp_path / "run", tmp_path / "ds", "--episodes", "t2") == 0


def test_a_run_without_trials_or_an_unknown_name_is_wrong_use(
    make_trial: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make_trial(id="scan", kind="scan", cameras=())
    assert run("export", "lerobot", tmp_path / "run", tmp_path / "ds") == 2
    assert "no trial to export" in capsys.readouterr().err
    assert run("export", "lerobot", tmp_path / "run", tmp_path / "ds", "--episodes", "t7") == 2
    assert "no episode t7. There are: scan" in capsys.readouterr().err


def test_an_episode_without_joints_is_refused(
    make_trial: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make_trial(id="t1", has_joints=False, num_frames=2)
    assert run("export", "lerobot", tmp_path / "run", tmp_path / "ds") == 1
    assert "t1.mcap: no joint states" in capsys.readouterr().err


def test_full_files_are_followed_by_the_next_and_all_is_found_again(
    make_trial: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bridge.exchange.lerobot.layout.DATA_FILE_MB", 0)
    monkeypatch.setattr("bridge.exchange.lerobot.layout.VIDEO_FILE_MB", 0)
    monkeypatch.setattr("bridge.exchange.lerobot.layout.CHUNKS_SIZE", 2)
    monkeypatch.setattr("bridge.exchange.lerobot.writer.FLUSH_EPISODES", 2)
    for number in range(3):
        make_trial(id=f"t{number}", num_frames=6 + number)
    assert run("export", "lerobot", tmp_path / "run", tmp_path / "ds") == 0
    found = sorted(p.relative_to(tmp_path / "ds").as_posix() for p in tmp_path.rglob("file-*.mp4"))
    key = "videos/observation.images.wrist"
    assert found == [
        f"{key}/chunk-000/file-000.mp4",
        f"{key}/chunk-000/file-001.mp4",
        f"{key}/chunk-001/file-000.mp4",
    ]
    path = tmp_path / "ds/meta/episodes/chunk-000/file-000.parquet"
    rows = pq.read_table(path).to_pylist()
    assert [(row["data/chunk_index"], row["data/file_index"]) for row in rows] == [
        (0, 0),
        (0, 1),
        (1, 0),
    ]
    assert {row["videos/observation.images.wrist/from_timestamp"] for row in rows} == {0.0}
    assert run("import", "lerobot", tmp_path / "ds", tmp_path / "back") == 0
    for number in range(3):
        path = tmp_path / "back" / "episodes" / f"ep_{number:06d}.mcap"
        assert Episode.open(path).topics()["/lerobot/joint_states"].count == 6 + number


def test_a_broken_image_is_named_and_nothing_is_left(
    make_trial: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str],
    made_trial: Any, monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    from bridge.media import color

    calls = iter(range(100))
    monkeypatch.setitem(
        made_trial._write_camera.__globals__,
        "encode_jpeg",
        lambda image: color.encode_jpeg(image)[: 80 if next(calls) == 4 else None],
    )
    make_trial(id="t1")
    assert run("export", "lerobot", tmp_path / "run", tmp_path / "ds") == 1
    error = capsys.readouterr().err
    assert "t1.mcap: message 5 of /lab/cam/wrist/color/image: unreadable image" in error
    assert not (tmp_path / "ds").exists()
    assert [p.name for p in tmp_path.iterdir()] == ["run"]
