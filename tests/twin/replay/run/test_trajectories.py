"""``robot-gst replay``: which trajectories go into which files, and going on after a kill."""

import json
import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from joint_samples import at_positions
from mcap.reader import make_reader
from verdicts import verdict_of

from bridge.episode import schema, streams
from bridge.episode.cdr.messages import string_to_cdr
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter
from bridge.errors import UsageError
from bridge.task.verdict import SAME_ENGINE
from bridge.terminal import Output
from twin.replay import run_job as run_job_module
from twin.replay import runner
from twin.replay import runner as runner_module
from twin.replay.config import ReplayConfig, ReplayRunConfig
from twin.replay.job import ReplayJob, divergence_of, row_of_existing, row_of_failure
from twin.replay.result import ReplayResult
from twin.replay.run_job import run_job
from twin.replay.runner import execution_of, replay_run, there_already
from twin.replay.scene import StartState, StartStates
from twin.replay.summary import count_verdicts, describe_run
from twin.scene.localise.episode import Phase

T0 = 1_700_000_000_000_000_000
START = T0 + 2_000_000_000
QUIET = Output(quiet=True)
VERDICT = verdict_of("round-1")


@pytest.fixture
def run(
    tmp_path: Path, script: SimpleNamespace, good: ReplayResult, monkeypatch: pytest.MonkeyPatch
) -> RunFolder:
    """One trial: a plan that was executed, and one that never was."""
    folder = RunFolder.create(tmp_path / "run")
    scene = script.scene()
    executed = script.plan(scene, plan_id="round-1")
    refused = replace(executed, id="round-0")
    track, widths = script.recorded_tracks(good, start_ns=START)
    with EpisodeWriter(folder.episodes_dir / "trial_0001.mcap") as writer:
        writer.describe(
            EpisodeInfo(
                id="trial_0001", kind="trial", task="cube_into_box", cell="standin", stand_in=True
            )
        )
        writer.write(
            "/robot_description", string_to_cdr(scene.urdf), type_name=schema.STRING, log_time_ns=T0
        )
        for offset_s, plan in ((0, refused), (1, executed)):
            writer.write(
                "/standin/plan",
                plan.to_json(),
                type_name=schema.PLAN,
                log_time_ns=T0 + offset_s * 10**9,
            )
        for kind, stamp in (
            ("execution_started", START),
            ("execution_ended", int(track.stamps_ns[-1])),
        ):
            event = {"schema_version": 1, "stamp_ns": stamp, "type": kind, "plan_id": "round-1"}
            writer.write("/standin/event", event, type_name=schema.EVENT, log_time_ns=stamp)
        for topic, recorded in (("joint_states", track), ("gripper/state", widths)):
            for stamp, position in zip(recorded.stamps_ns, recorded.position, strict=True):
                sample = at_positions(int(stamp), recorded.names, position)
                writer.write(
                    f"/standin/{topic}",
                    sample.to_cdr(),
                    type_name=schema.JOINT_STATE,
                    log_time_ns=int(stamp),
                )
    with EpisodeWriter(folder.episodes_dir / "scan.mcap") as writer:
        writer.describe(EpisodeInfo(id="scan", kind="scan"))

    def starts(*_: object, **__: object) -> StartStates:
        phase = Phase(name="start", plan_id=None, after_ns=None, before_ns=START)
        return StartStates(scene.task, [phase], [StartState(Ts_base_object=scene.Ts_base_object)])

    monkeypatch.setattr(runner_module, "localised_starts", starts)
    return folder


QUICK = ReplayConfig(settle_after_s=0.5)


@pytest.mark.slow
def test_every_plan_and_every_execution_becomes_one_episode(
    run: RunFolder, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    summary = replay_run(run, ReplayRunConfig(replay=QUICK), QUIET)
    assert {(r["plan"], r["trajectory"], r["mode"]): r["accepted"] for r in summary["rows"]} == {
        ("round-0", "planned", "dynamic"): True,
        ("round-1", "planned", "dynamic"): True,
        ("round-1", "executed", "dynamic"): True,
        ("round-1", "executed", "kinematic"): None,
    }
    assert not any(row["error"] for row in summary["rows"])
    assert summary["scene_hash"] is None
    assert len(run.derived("*.replay.*")) == 4
    _check_file(run, "trial_0001.replay.planned.dynamic.round-1.pybullet.*")
    assert summary["against_recorded"] == {}, "nobody labelled it"
    (told,) = [row["divergence"] for row in summary["rows"] if row["divergence"]]
    assert told["lag_s"] is not None, "compared with the plan, replayed before"
    (path,) = run.derived("trial_0001.replay.executed.dynamic.*")
    record = divergence_of(Episode.open(path))
    assert record is not None
    assert all(item["between"] != ["planned", "executed"] for item in record["quantities"])

    stamps = {path: path.stat().st_mtime_ns for path in run.derived()}
    again = replay_run(run, ReplayRunConfig(replay=QUICK), QUIET)
    assert all(row["skipped"] for row in again["rows"])
    assert {path: path.stat().st_mtime_ns for path in run.derived()} == stamps
    assert again["counts"] == summary["counts"]
    QUIET.result(again, describe_run(again))
    assert "planned dynamic, never executed" in capsys.readouterr().out

    done: list[ReplayJob] = []
    monkeypatch.setattr(runner_module, "run_job", lambda job: done.append(job) or again["rows"][0])
    replay_run(run, ReplayRunConfig(replay=QUICK), QUIET)
    assert not done
    replay_run(run, ReplayRunConfig(replay=QUICK, force=True), QUIET)
    assert len(done) == 4
    assert {job.path() for job in done} == set(run.derived("*.replay.*"))
    stricter = replace(QUICK, eps_col_m=0.003)
    replay_run(run, ReplayRunConfig(replay=stricter), QUIET)
    assert not {job.path() for job in done[4:]} & {job.path() for job in done[:4]}
    assert len(done) == 8


def _check_file(run: RunFolder, pattern: str) -> None:
    (path,) = run.derived(pattern)
    with path.open("rb") as stream:
        reader = make_reader(stream)
        header = reader.get_header()
        counts: dict[str, int] = {}
        times = []
        for record, channel, message in reader.iter_messages():
            assert record is not None
            counts[channel.topic] = counts.get(channel.topic, 0) + 1
            times.append(message.log_time)
    assert header.profile == "ros2"
    assert times == sorted(times)
    assert counts["/standin/plan"] == counts["/standin/verdict"] == 1
    assert counts["/standin/joint_states"] == counts["/standin/replay/clearance"]
    assert counts["/standin/object/cube/pose"] == counts["/standin/tcp/pose"]
    assert counts["/robot_description"] == 1
    assert counts["/standin/replay/contact"] > 2

    episode = Episode.open(path)
    assert episode.derived is not None
    assert episode.derived.plan_id == "round-1"
    assert episode.derived.source_episode == "trial_0001"
    assert episode.info.task == "cube_into_box"
    track = streams.joint_track(episode)
    assert track.stamps_ns[0] == START
    assert None not in streams.execution_ns(streams.events(episode), "round-1")
    ((_, verdict),) = streams.verdicts(episode)
    assert verdict.accepted is True
    cube = streams.pose_track(episode, streams.object_pose_topics(episode)["cube"])
    assert np.linalg.norm(cube.p_m[-1] - cube.p_m[0]) > 0.2


@pytest.mark.slow
def test_what_the_cells_own_engine_says_is_shown_and_marked(run: RunFolder) -> None:
    summary = replay_run(run, ReplayRunConfig(replay=replace(QUICK, engine="mujoco")), QUIET)
    dynamic = [row for row in summary["rows"] if row["mode"] == "dynamic"]
    assert len(dynamic) == 3
    for row in dynamic:
        assert row["accepted"] is True
        assert ".mujoco." in row["file"]
        episode = Episode.open(run.derived_dir / row["file"])
        ((_, verdict),) = streams.verdicts(episode)
        assert episode.derived is not None
        assert verdict.engine == episode.derived.engine
        assert str(verdict.engine).startswith("mujoco-")
        assert SAME_ENGINE in verdict.warnings
    assert SAME_ENGINE in describe_run(summary)


def test_an_unknown_episode_lists_those_that_exist(run: RunFolder) -> None:
    with pytest.raises(UsageError, match="trial_0001"):
        replay_run(run, ReplayRunConfig(episode=("trial_9",)), QUIET)


def write_scene(run: RunFolder) -> None:
    """A rebuilt scene that holds nothing."""
    run.scene_dir.mkdir(exist_ok=True)
    record = {"schema_version": 1, "key": "k", "scene_hash": "abc", "background": {},
              "sources": [], "views": []}  # fmt: skip
    (run.scene_dir / "scene.json").write_text(json.dumps(record))


def test_what_the_scene_lacks_is_said_once_for_all_replays(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_scene(run)
    monkeypatch.setattr(runner_module, "run_job", lambda job: row_of_failure(job, "looked at"))
    replay_run(run, ReplayRunConfig(), Output())
    said = capsys.readouterr().err
    assert said.count("cube_into_box: the scene has no sdf.npz: only the table") == 1


def test_distances_that_cannot_be_read_leave_everything_not_evaluated(run: RunFolder) -> None:
    write_scene(run)
    (run.scene_dir / "sdf.npz").write_bytes(b"no arrays")
    summary = replay_run(run, ReplayRunConfig(replay=QUICK), QUIET)
    assert len(summary["rows"]) == 4
    for row in summary["rows"]:
        assert row["accepted"] is None
        assert "sdf.npz: not a file of arrays" in row["error"]


def marks(*said: str) -> list[dict[str, Any]]:
    """Events of plan a, one second apart: > it starts, < it ends."""
    kinds = {">": "execution_started", "<": "execution_ended", ".": "note"}
    return [
        {"type": kinds[sign], "plan_id": "a", "stamp_ns": stamp}
        for stamp, sign in enumerate("".join(said))
    ]


@pytest.mark.parametrize(
    ("said", "interval", "problem"),
    [
        ("..", None, ""),
        ("<", None, ""),
        (".>.<.", (1, 3), ""),
        (".>..", None, "began, and nobody recorded that it ended"),
        (">.<>.<", (0, 2), "was executed 2 times, and which end"),
        (">.<>", (0, 2), "was executed 2 times"),
    ],
)
def test_an_execution_without_an_end_of_its_own_is_no_plan_that_was_never_executed(
    said: str, interval: tuple[int, int] | None, problem: str
) -> None:
    interval_ns, told = execution_of(marks(said), "a")
    assert interval_ns == interval
    assert problem in told
    assert bool(told) is bool(problem)
    assert execution_of(marks(said), "b") == (None, "")


def test_a_recording_that_ends_while_the_robot_moves_says_so(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    events = marks(".>.")
    for event in events:
        event["plan_id"] = "round-1"
    monkeypatch.setattr(runner_module.streams, "events", lambda _: events)
    monkeypatch.setattr(run_job_module, "_replay", lambda job: (VERDICT, None))
    summary = replay_run(run, ReplayRunConfig(replay=QUICK), QUIET)
    said = {(r["plan"], r["trajectory"], r["mode"]): r for r in summary["rows"]}
    assert len(said) == 4
    for mode in ("dynamic", "kinematic"):
        row = said["round-1", "executed", mode]
        assert row["error"].startswith("the execution of plan 'round-1' began, and")
        assert row["accepted"] is None
    assert summary["counts"]["planned dynamic"]["n"] == 1
    assert summary["counts"]["planned dynamic, never executed"]["n"] == 1


BRIEF = ReplayConfig(settle_after_s=0.3, settle_before_s=0.1)


def test_a_half_written_replay_does_not_count(jobs: list[ReplayJob]) -> None:
    path = jobs[0].path()
    path.with_name(path.name + ".part").write_bytes(b"half")
    assert row_of_existing(jobs[0]) is None
    path.write_bytes(b"torn")
    assert row_of_existing(jobs[0]) is None


def test_what_is_asked_for_last_counts_also_when_it_was_made_first(
    jobs: list[ReplayJob], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The newest replay of a trajectory is the one that an evaluation takes."""
    monkeypatch.setattr(runner, "row_of_existing", lambda job: {} if job.path().exists() else None)
    sampled = replace(jobs[0], config=replace(BRIEF, samples=4))
    for age_s, job in enumerate((sampled, jobs[0], jobs[1])):
        job.path().touch()
        os.utime(job.path(), ns=(0, (10 - age_s) * 10**9))
    before = {job.path(): job.path().stat().st_mtime_ns for job in (jobs[0], jobs[1], sampled)}

    rows, todo = there_already(jobs, force=False)
    assert (rows, todo) == ([{}, {}], [jobs[2]])
    after = {path: path.stat().st_mtime_ns for path in before}
    assert after[jobs[0].path()] > after[sampled.path()] == before[sampled.path()]
    assert there_already(jobs, force=True) == ([], jobs)


def test_settings_of_samples_name_another_file(jobs: list[ReplayJob]) -> None:
    sampled = replace(jobs[0], config=replace(BRIEF, samples=4))
    assert sampled.path() != jobs[0].path()
    assert sampled.cost() == 5 * jobs[0].cost()


@pytest.mark.slow
def test_what_a_killed_replay_left_is_made_again_and_whole(jobs: list[ReplayJob]) -> None:
    job = replace(jobs[0], config=replace(BRIEF, samples=1))
    part = job.path().with_name(job.path().name + ".part")
    writer = EpisodeWriter(job.path())
    writer.describe(EpisodeInfo(id="trial_0001", kind="trial"))
    writer.abandon()
    assert part.is_file()
    assert row_of_existing(job) is None
    row = run_job(job)
    assert row["error"] is None
    assert not part.exists()
    again = row_of_existing(job)
    assert again is not None
    assert again["skipped"]
    assert again == {**row, "skipped": True}
    episode = Episode.open(job.path())
    ((_, verdict),) = streams.verdicts(episode)
    assert verdict.p_success == row["p_success"]
    assert verdict.p_success is not None
    assert verdict.p_success["n"] == 1
    assert "varied replays that succeed:" in describe_run(
        {"rows": [row], "counts": count_verdicts([row])}
    )
