"""What replays take from a calibration, and that they name it."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from bridge.episode import schema, streams
from bridge.episode.cdr.messages import string_to_cdr
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter
from bridge.task.task_file import load_task
from twin.physics.config import PhysicsConfig
from twin.replay.config import ReplayConfig
from twin.replay.job import ReplayJob
from twin.replay.rebuilt_scene import for_task
from twin.replay.run_job import run_job
from twin.replay.scene import StartState
from twin.scene.store.calibration import Calibration, read_calibration, write_physics

T0 = 1_700_000_000_000_000_000


def calibration(**physics: Any) -> Calibration:
    return Calibration(record={"calibration_id": "12345678", "physics": physics}, cameras={})


def with_calibration(run: RunFolder, **physics: Any) -> Calibration:
    """As the command writes it."""
    write_physics(run, {"promoted": True, "identified": {}, "id": "x", **physics})
    found = read_calibration(run)
    assert found is not None
    return found


def test_a_replay_names_its_calibration(tmp_path: Path, script: SimpleNamespace) -> None:
    run, scene = RunFolder.create(tmp_path / "run"), script.scene()
    known = with_calibration(run)
    plan = script.plan(scene)
    plan = replace(plan, tau=plan.tau[:1])
    path = run.episodes_dir / "trial_0001.mcap"
    with EpisodeWriter(path) as writer:
        writer.describe(EpisodeInfo(id="trial_0001", kind="trial", task="cube_into_box"))
        for topic, data, kind in (
            ("/robot_description", string_to_cdr(scene.urdf), schema.STRING),
            ("/standin/plan", plan.to_json(), schema.PLAN),
        ):
            writer.write(topic, data, type_name=kind, log_time_ns=T0)
    run.derived_dir.mkdir(exist_ok=True)
    job = ReplayJob(
        episode_path=path, episode_sha256="0" * 64, plan_id=plan.id, plan_index=0,
        trajectory="planned", start_ns=T0, end_ns=None, task=load_task("cube_into_box"),
        start=StartState(Ts_base_object=scene.Ts_base_object), scene_hash=None,
        config=ReplayConfig(mode="kinematic"), folder=run.derived_dir, run_path=run.path,
        calibration_id=known.calibration_id,
    )  # fmt: skip
    assert run_job(job)["error"] is None
    episode = Episode.open(job.path())
    box = streams.pose_track(episode, streams.object_pose_topics(episode)["box"])
    assert box.p_m[0] == pytest.approx(scene.Ts_base_object["box"][:3, 3])
    assert episode.derived is not None
    assert episode.derived.calibration_id == known.calibration_id
    assert json.dumps(job.settings()) != json.dumps(replace(job, calibration_id="0").settings())


def test_the_gripper_presses_as_the_task_is_set_unless_somebody_knows_better() -> None:
    toys, cube = load_task("sloth_into_basket"), load_task("cube_into_box")
    assert toys.grip_force_N == 9.0, "what holds a wooden cube crushes a toy"
    assert cube.grip_force_N is None
    assert for_task(ReplayConfig(), None, toys).physics.grip_force_N == 9.0
    assert for_task(ReplayConfig(), None, cube) == ReplayConfig()
    mine = ReplayConfig(physics=PhysicsConfig(grip_force_N=15.0))
    assert for_task(mine, None, toys) == mine
    found = calibration(identified={"grip_force_N": {"value": 7.5}})
    assert for_task(ReplayConfig(), found, toys).physics.grip_force_N == 7.5
