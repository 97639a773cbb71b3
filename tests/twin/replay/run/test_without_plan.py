"""``robot-gst replay`` of trials that nobody planned, of nothing, and without a scene to draw."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from joint_samples import at_positions

from bridge.cli.episodes import label
from bridge.episode import schema, streams
from bridge.episode.cdr.messages import string_to_cdr
from bridge.episode.executions import NO_PLAN
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.streams import JointTrack
from bridge.episode.writer import EpisodeWriter
from bridge.errors import PathNotFoundError
from bridge.task.task_file import load_task
from bridge.terminal import Output
from twin import cli
from twin.replay import runner as runner_module
from twin.replay.config import ReplayConfig, ReplayRunConfig
from twin.replay.result import ReplayResult
from twin.replay.runner import describe_undrawn, replay_run
from twin.replay.scene import StartState, StartStates
from twin.scene.localise.episode import Phase
from twin.scene.store.folder import write_record

START = 1_700_000_000_000_000_000
QUICK = ReplayRunConfig(replay=ReplayConfig(settle_after_s=0.5))
QUIET = Output(quiet=True)
TRIAL = EpisodeInfo(id="trial", kind="trial", task="cube_into_box", cell="lab", policy="act")
Write = Callable[..., Path]


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    return RunFolder.create(tmp_path / "run")


@pytest.fixture
def seen(monkeypatch: pytest.MonkeyPatch, script: SimpleNamespace) -> dict[str, Any]:
    """Where the objects are found before the motion; a test may take them away."""
    scene = script.scene()
    found = dict(scene.Ts_base_object)

    def starts(*_: object, **__: object) -> StartStates:
        lost = {name: "no quiet frames" for name in scene.task.objects if name not in found}
        state = StartState(Ts_base_object=dict(found), reasons=lost)
        phase = Phase(name="start", plan_id=None, after_ns=None, before_ns=None)
        return StartStates(scene.task, [phase], [state])

    monkeypatch.setattr(runner_module, "localised_starts", starts)
    return found


@pytest.fixture
def write(folder: RunFolder, script: SimpleNamespace, good: ReplayResult) -> Write:
    """Write an episode of joints and fingers at rest, moving as the good plan does, at rest."""
    urdf = script.scene().urdf
    tracks = [resting_around(track) for track in script.recorded_tracks(good, start_ns=START)]

    def save(
        info: EpisodeInfo = TRIAL,
        *,
        leave_out: tuple[str, ...] = (),
        rename: str = "",
        still: bool = False,
    ) -> Path:
        path = folder.episodes_dir / f"{info.id}.mcap"
        with EpisodeWriter(path) as writer:
            writer.describe(info)
            if "description" not in leave_out:
                text = string_to_cdr(urdf)
                writer.write("/robot_description", text, type_name=schema.STRING, log_time_ns=START)
            for topic, track in zip(("joint_states", "gripper/state"), tracks, strict=True):
                if topic in leave_out:
                    continue
                names = tuple(f"{rename}{name}" for name in track.names)
                for stamp_ns, row in zip(track.stamps_ns.tolist(), track.position, strict=True):
                    sample = at_positions(stamp_ns, names, track.position[0] if still else row)
                    writer.write(
                        f"/lab/{topic}",
                        sample.to_cdr(),
                        type_name=schema.JOINT_STATE,
                        log_time_ns=stamp_ns,
                    )
        return path

    return save


def resting_around(track: JointTrack, seconds: float = 1.0) -> JointTrack:
    step_ns = int(np.median(np.diff(track.stamps_ns)))
    count = round(seconds * 1e9 / step_ns)
    before = track.stamps_ns[0] - step_ns * np.arange(count, 0, -1)
    after = track.stamps_ns[-1] + step_ns * np.arange(1, count + 1)
    return replace(
        track,
        stamps_ns=np.concatenate([before, track.stamps_ns, after]),
        position=np.concatenate(
            [
                np.repeat(track.position[:1], count, axis=0),
                track.position,
                np.repeat(track.position[-1:], count, axis=0),
            ]
        ),
    )


@pytest.mark.slow
def test_what_was_executed_is_replayed_and_nothing_is_said_to_be_planned(
    folder: RunFolder, write: Write, seen: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    write()
    label(folder.path, "trial", result="success", output=QUIET)
    assert cli.replay(folder.path, config=QUICK) == 0
    said = capsys.readouterr().out
    assert "executed in twin 1 of 1" in said
    assert "planned" not in said
    summary = replay_run(folder, QUICK, QUIET)
    assert {
        (row["plan"], row["trajectory"], row["mode"]): row["accepted"] for row in summary["rows"]
    } == {(NO_PLAN, "executed", "dynamic"): True, (NO_PLAN, "executed", "kinematic"): None}
    assert summary["against_recorded"]["cube_into_box"]["executed in twin"] == {"k": 1, "n": 1}
    (path,) = folder.derived("trial.replay.executed.dynamic.*")
    episode = Episode.open(path)
    assert not streams.plans(episode), "no plan is made up for viewers"
    assert (episode.info.kind, episode.info.policy) == ("trial", "act")
    started = streams.execution_ns(streams.events(episode), NO_PLAN)[0] or 0
    assert abs(started - START) < 50_000_000
    cube = streams.pose_track(episode, streams.object_pose_topics(episode)["cube"])
    assert np.linalg.norm(cube.p_m[-1] - cube.p_m[0]) > 0.2


@pytest.mark.parametrize(
    ("how", "why"),
    [
        ({"still": True}, "nothing moved"),
        ({"rename": "other_"}, "lacks shoulder_pan_joint"),
        ({"leave_out": ("gripper/state",)}, "gripper/state"),
        ({"leave_out": ("joint_states",)}, "neither plans nor joint states"),
        ({"leave_out": ("description",)}, "nobody said which robot it is"),
        ({"info": EpisodeInfo(id="trial", kind="trial")}, "a trial of no task"),
        ({"info": EpisodeInfo(id="trial", kind="scan")}, "a scan"),
        (
            {"info": EpisodeInfo(id="trial", kind="imported"), "leave_out": ("joint_states",)},
            "nobody said",
        ),
    ],
)
def test_nothing_to_replay_is_named_and_is_no_success(
    folder: RunFolder,
    write: Write,
    seen: dict[str, Any],
    capsys: pytest.CaptureFixture[str],
    how: dict[str, Any],
    why: str,
) -> None:
    write(**how)
    assert cli.replay(folder.path, config=QUICK) == 2
    said = capsys.readouterr().out
    assert "episodes with nothing to replay:" in said
    assert why in said


def test_nothing_to_replay_stops_no_other_episode(
    folder: RunFolder, write: Write, seen: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    write()
    write(replace(TRIAL, id="still"), still=True)
    write(EpisodeInfo(id="scan", kind="scan"))
    done: list[str] = []

    def note(job: Any) -> dict[str, Any]:
        done.append(job.episode_path.stem)
        return runner_module.row_of_failure(job, "only looked at") | {"error": None}

    monkeypatch.setattr(runner_module, "run_job", note)
    summary = replay_run(folder, QUICK, QUIET)
    assert done == ["trial", "trial"]
    assert set(summary["nothing_to_replay"]) == {"still"}, "a scan was never meant to be replayed"


@pytest.mark.slow
def test_of_objects_never_seen_only_the_robot_is_replayed_and_that_is_said(
    folder: RunFolder, write: Write, seen: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    write()
    seen.clear()
    assert cli.replay(folder.path, config=QUICK) == 2
    said = capsys.readouterr().out
    assert (
        "only the robot is replayed; not seen before it moved: cube, box (no quiet frames)" in said
    )
    assert "executed kinematic" in said


def test_pictures_without_a_scene_are_refused_before_anything_is_replayed(run: RunFolder) -> None:
    with EpisodeWriter(run.episodes_dir / "scan.mcap") as writer:
        writer.describe(EpisodeInfo(id="scan", kind="scan"))
    with pytest.raises(PathNotFoundError, match=r"--render draws it.*robot-gst rebuild RUN"):
        replay_run(run, ReplayRunConfig(render=True), Output(quiet=True))


def test_what_was_not_scanned_and_a_missing_robot_are_named_with_the_reason(run: RunFolder) -> None:
    run.scene_dir.mkdir()
    record = {
        "schema_version": 1, "key": "k", "scene_hash": "h", "background": {}, "sources": [],
        "views": [], "objects": {"box": {}}, "objects_remark": "cube not found: hidden",
        "robot": {"links": {}, "remark": "no joints"},
    }  # fmt: skip
    write_record(run, record)
    assert describe_undrawn(run, [load_task("cube_into_box")]) == [
        "cube was not scanned: drawn from the task's shape, with colours from before the first "
        "motion (cube not found: hidden)",
        "robot: not in the scene, not in pictures (no joints)",
    ]
