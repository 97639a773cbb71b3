"""What tests of whole runs share."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from bridge import process_pool
from bridge.episode import schema
from bridge.episode.cdr.messages import string_to_cdr
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.writer import EpisodeWriter
from bridge.task.task_file import load_task
from twin.replay.config import ReplayConfig
from twin.replay.job import ReplayJob
from twin.replay.scene import StartState

T0 = 1_700_000_000_000_000_000
QUICK = ReplayConfig(settle_after_s=0.3, settle_before_s=0.1)


@pytest.fixture
def jobs(tmp_path: Path, script: SimpleNamespace) -> list[ReplayJob]:
    """Plans that were never executed: two quick ones and one that is no plan to replay."""
    scene = script.scene()
    path = tmp_path / "trial_0001.mcap"
    plans = [script.plan(scene, plan_id=name, pace=4.0) for name in ("a", "b")]
    plans.append(replace(plans[0], id="broken", frame="world"))
    with EpisodeWriter(path) as writer:
        writer.describe(EpisodeInfo(id="trial_0001", kind="trial", task="cube_into_box"))
        writer.write(
            "/robot_description", string_to_cdr(scene.urdf), type_name=schema.STRING, log_time_ns=T0
        )
        for index, plan in enumerate(plans):
            writer.write(
                "/standin/plan", plan.to_json(), type_name=schema.PLAN, log_time_ns=T0 + index
            )
    derived = tmp_path / "derived"
    derived.mkdir()
    return [
        ReplayJob(
            episode_path=path,
            episode_sha256="0" * 64,
            plan_id=plan.id,
            plan_index=index,
            trajectory="planned",
            start_ns=T0,
            end_ns=None,
            task=load_task("cube_into_box"),
            start=StartState(Ts_base_object=scene.Ts_base_object),
            scene_hash=None,
            config=QUICK,
            folder=derived,
            duration_s=float(index),
        )
        for index, plan in enumerate(plans)
    ]


@pytest.fixture(autouse=True)
def one_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a test replaces is in this process: others start only where a test asks for them."""
    monkeypatch.setattr(process_pool, "default_size", lambda: 1)
