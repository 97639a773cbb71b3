"""A changed replay differs from the nominal one in what was asked for, and in nothing else."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from bridge.episode import schema
from bridge.episode.cdr.messages import string_to_cdr
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.writer import EpisodeWriter
from bridge.errors import UsageError
from bridge.task.task_file import load_task
from twin.replay.config import ChangeConfig, ReplayConfig
from twin.replay.job import ReplayJob
from twin.replay.run_job import run_job
from twin.replay.scene import StartState
from twin.replay.what_if import WhatIf, changed, replay_changed

T0 = 1_700_000_000_000_000_000


@pytest.fixture
def job(tmp_path: Path, script: SimpleNamespace) -> ReplayJob:
    """A plan that works, never executed."""
    scene = script.scene()
    path = tmp_path / "trial_0001.mcap"
    plan = script.plan(scene)
    with EpisodeWriter(path) as writer:
        writer.describe(EpisodeInfo(id="trial_0001", kind="trial", task="cube_into_box"))
        urdf = string_to_cdr(scene.urdf)
        writer.write("/robot_description", urdf, type_name=schema.STRING, log_time_ns=T0)
        writer.write("/standin/plan", plan.to_json(), type_name=schema.PLAN, log_time_ns=T0)
    return ReplayJob(
        episode_path=path,
        episode_sha256="0" * 64,
        plan_id=plan.id,
        plan_index=0,
        trajectory="planned",
        start_ns=T0,
        end_ns=None,
        task=load_task("cube_into_box"),
        start=StartState(Ts_base_object=scene.Ts_base_object),
        scene_hash=None,
        config=ReplayConfig(),
        folder=tmp_path,
    )


def test_nothing_else_is_changed(job: ReplayJob) -> None:
    assert changed(job, ChangeConfig()).settings() == job.settings()
    heavy = changed(job, ChangeConfig(mass=3.0))
    models, before = heavy.task.objects, job.task.objects
    assert models["cube"].mass_kg == pytest.approx(3 * before["cube"].mass_kg)
    assert models["box"] == before["box"]
    assert replace(heavy, task=job.task).settings() == job.settings()
    loose = changed(job, ChangeConfig(friction=0.5, grip_force=2.0, grip_delay_s=0.2)).config
    nominal = job.config
    assert loose.physics.object_friction == pytest.approx(nominal.physics.object_friction / 2)
    assert loose.physics.grip_force_N == pytest.approx(2 * nominal.physics.grip_force_N)
    assert loose.grip_delay_s == pytest.approx(nominal.grip_delay_s + 0.2)
    shifted = changed(job, ChangeConfig(x_m=0.01, y_m=-0.02, turn_rad=np.pi / 2)).start
    T, T_before = (each.Ts_base_object["cube"] for each in (shifted, job.start))
    np.testing.assert_allclose(T[:3, 3] - T_before[:3, 3], [0.01, -0.02, 0.0], atol=1e-12)
    np.testing.assert_allclose(T[:3, 0], [-T_before[1, 0], T_before[0, 0], T_before[2, 0]])
    box, box_before = (each.Ts_base_object["box"] for each in (shifted, job.start))
    np.testing.assert_array_equal(box, box_before)
    with pytest.raises(UsageError, match="no object 'box' can be moved"):
        changed(job, ChangeConfig(object="box"))


def test_a_cube_beside_the_fingers_is_not_put_into_the_box(job: ReplayJob) -> None:
    assert run_job(job)["accepted"] is True
    row = run_job(changed(job, ChangeConfig(x_m=0.06)))
    assert row["accepted"] is False
    assert row["file"] != job.path().name
    assert (job.folder / row["file"]).is_file()


def test_a_plan_that_is_not_there_is_refused(job: ReplayJob, tmp_path: Path) -> None:
    run = tmp_path / "run"
    (run / "episodes").mkdir(parents=True)
    job.episode_path.rename(run / "episodes" / job.episode_path.name)
    asked = WhatIf(
        run_path=run,
        episode_id="trial_0001",
        plan_id="another",
        change=ChangeConfig(),
        folder=run / "results" / "what_if",
    )
    with pytest.raises(UsageError, match="trial_0001 has no plan 'another'"):
        replay_changed(asked)
