"""Localisation of recorded episodes: which frames count, what is written, what is never read."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from written_messages import put, put_calibration, put_frame

from bridge.episode import schema, streams
from bridge.episode.cdr import messages
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.streams import RgbdFrame
from bridge.episode.writer import EpisodeWriter
from bridge.geometry import se3
from bridge.task.task_file import Task
from twin.scene.frames.selection import rgbd_camera_ids
from twin.scene.localise.episode import localise_episode, quiet_phases, write_localised
from twin.scene.localise.stationary_frames import stationary_frames
from twin.scene.shape.known import pose_of

S = 1_000_000_000
EYE, TARGET = (1.05, -0.1, 0.6), (0.48, 0.0, 0.0)
START = {
    "cube": pose_of(np.array([0.50, -0.15, 0.02, 0.4])),
    "box": pose_of(np.array([0.49, 0.19, 0.0, -0.1])),
}
END = {**START, "cube": START["box"] @ pose_of(np.array([0.0, 0.01, 0.026, 0.2]))}


def put_event(writer: EpisodeWriter, kind: str, stamp_ns: int) -> None:
    record = {"schema_version": 1, "stamp_ns": stamp_ns, "type": kind, "plan_id": "plan_1"}
    writer.write("/standin/event", record, type_name=schema.EVENT, log_time_ns=stamp_ns)


@pytest.fixture(scope="module")
def frames() -> dict[str, RgbdFrame]:
    return {}


@pytest.fixture
def episode(
    tmp_path: Path, stage: Callable[..., Any], task: Task, frames: dict[str, RgbdFrame]
) -> Episode:
    """Start at 1, 2, 3 s; execution from 4 to 6 s; the cube is in the box at 7 and 8 s."""
    if not frames:
        rng = np.random.default_rng(0)
        for name, poses in (("start", START), ("end", END)):
            frames[name] = stage(poses).frame("side", EYE, TARGET, rng)
    run = RunFolder.create(tmp_path / "run")
    with EpisodeWriter(run.episodes_dir / "trial_1.mcap") as writer:
        prefix, truth = "/standin/cam/side", "/standin/truth/cam/spy"
        put_calibration(writer, frames["start"], prefix)
        put_calibration(writer, frames["start"], truth)
        put_frame(writer, frames["end"], truth, 1)
        lie = messages.PoseSample(stamp_ns=1, frame_id="base_link", T_frame_body=np.eye(4))
        put(writer, "/standin/truth/object/cube/pose", lie, 1)
        for second in (1, 2, 3):
            put_frame(writer, frames["start"], prefix, second * S)
        put_event(writer, "execution_started", 4 * S)
        put_frame(writer, frames["end"], prefix, 5 * S)
        put_event(writer, "execution_ended", 6 * S)
        for second in (7, 8):
            put_frame(writer, frames["end"], prefix, second * S)
        writer.describe(EpisodeInfo(id="trial_1", kind="trial", cell="standin", stand_in=True))
    return Episode.open(run.episodes_dir / "trial_1.mcap")


def test_only_frames_before_the_execution_count(episode: Episode, task: Task) -> None:
    found = localise_episode(episode, task)
    assert found["cube"].found, found["cube"].reason
    assert found["cube"].stamp_ns == 3 * S
    distance = np.linalg.norm(found["cube"].T_base_object[:3, 3] - START["cube"][:3, 3])
    assert distance < 0.003


def test_truth_cameras_and_truth_poses_are_never_read(episode: Episode) -> None:
    assert "/standin/truth/cam/spy/color/image" in episode.topics()
    assert rgbd_camera_ids(episode) == ["side"]
    assert streams.object_pose_topics(episode) == {}
    assert {frame.camera_id for frame in stationary_frames(episode, 3, None, None)} == {"side"}


def test_phases_are_the_start_and_what_follows_each_execution(episode: Episode) -> None:
    phases = [(p.name, p.plan_id, p.after_ns, p.before_ns) for p in quiet_phases(episode)]
    assert phases == [("start", None, None, 4 * S), ("end", "plan_1", 6 * S, None)]


def test_the_derived_episode_holds_start_and_end_with_provenance(
    episode: Episode, task: Task
) -> None:
    run = RunFolder(episode.path.parents[1])
    path = write_localised(run, episode, task, scene_hash="0123456789abcdef")
    assert path.name == "trial_1.localised.0123456789ab.mcap"
    derived = Episode.open(path)
    assert derived.derived is not None
    assert derived.derived.kind == "localised"
    assert derived.derived.source_episode == "trial_1"
    assert derived.info.stand_in
    records = streams.localisations(derived)
    assert [(r["object"], r["phase"], r["found"]) for r in records] == [
        ("cube", "start", True),
        ("box", "start", True),
        ("cube", "end", True),
        ("box", "end", True),
    ]
    start, end = (se3.pose_from_record(r["T_base_object"]) for r in records[::2])
    np.testing.assert_allclose(start[:3, 3], START["cube"][:3, 3], atol=0.003)
    np.testing.assert_allclose(end[:3, 3], END["cube"][:3, 3], atol=0.004)
    assert [r["stamp_ns"] for r in records[::2]] == [3 * S, 8 * S]


def test_a_derived_episode_is_kept_until_its_settings_change(episode: Episode, task: Task) -> None:
    run = RunFolder(episode.path.parents[1])
    path = write_localised(run, episode, task)
    first = path.stat().st_mtime_ns
    assert write_localised(run, episode, task).stat().st_mtime_ns == first
    content = path.read_bytes()
    path.unlink()
    assert write_localised(run, episode, task).read_bytes() == content  # same input, same bytes
