"""What a calibration says of localised poses and of masses is applied wherever replays begin."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bridge.episode import schema, streams
from bridge.episode.cdr.messages import string_to_cdr
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter
from bridge.geometry import se3
from bridge.task.task_file import load_task
from twin.physics.config import PhysicsConfig
from twin.replay.config import MASS_LOG, ReplayConfig
from twin.replay.job import ReplayJob
from twin.replay.monte_carlo import draw_variation, sample_rng
from twin.replay.rebuilt_scene import (
    Correction,
    calibrated,
    correction_of,
    for_task,
    read_rebuilt_scene,
)
from twin.replay.run_job import run_job
from twin.replay.scene import StartState
from twin.scene.shape.sdf import SdfGrid
from twin.scene.shape.static import StaticSdf
from twin.scene.store.calibration import Calibration, read_calibration, write_physics

T0 = 1_700_000_000_000_000_000
BIAS = {
    "bias_x_m": {"value": 0.006, "low": 0.005, "high": 0.007},
    "bias_y_m": {"value": -0.004, "low": -0.005, "high": -0.003},
    "bias_yaw_rad": {"value": 0.02, "low": 0.01, "high": 0.03},
}
MASSES = {"mass_scale": {"value": 1.5, "low": 1.2, "high": 1.8}}


def calibration(**physics: Any) -> Calibration:
    return Calibration(record={"calibration_id": "12345678", "physics": physics}, cameras={})


def with_calibration(run: RunFolder, **physics: Any) -> Calibration:
    """As the command writes it."""
    write_physics(run, {"promoted": True, "identified": {}, "id": "x", **physics})
    found = read_calibration(run)
    assert found is not None
    return found


def test_a_pose_is_shifted_across_the_table_and_turned_where_it_stands() -> None:
    correction = correction_of(calibration(pose_bias=BIAS))
    T = se3.transform_from(np.array([0.9, 0.3, -0.2, 0.1]), np.array([0.5, 0.1, 0.07]))
    moved = correction.poses({"cube": T})["cube"]
    assert moved[:3, 3] - T[:3, 3] == pytest.approx([0.006, -0.004, 0.0])
    turn = moved[:3, :3] @ T[:3, :3].T
    assert turn @ [0.0, 0.0, 1.0] == pytest.approx([0.0, 0.0, 1.0])
    assert np.arctan2(turn[1, 0], turn[0, 0]) == pytest.approx(0.02)


def test_what_was_not_identified_moves_nothing_by_a_single_bit() -> None:
    T = se3.transform_from(np.array([0.9, 0.3, -0.2, 0.1]), np.array([0.5, -0.0, 0.07]))
    task = load_task("cube_into_box")
    unread = [None, calibration(), calibration(pose_bias={"bias_x_m": "far"}, masses=3)]
    broken = calibration(pose_bias={"bias_x_m": {"value": np.nan, "low": 0.0, "high": 1.0}})
    for known in (*unread, broken):
        correction = correction_of(known)
        assert correction == Correction()
        assert correction.poses({"cube": T})["cube"].tobytes() == T.tobytes()
        assert correction.task(task) is task
        covariance = np.diag(np.arange(6.0))
        assert np.array_equal(correction.covariances({"cube": covariance})["cube"], covariance)


def test_rigid_things_that_move_are_weighed_and_others_are_not() -> None:
    correction = correction_of(calibration(masses=MASSES))
    for name in ("cube_into_box", "sloth_into_basket"):
        task = load_task(name)
        for key, model in correction.task(task).objects.items():
            before = task.objects[key].mass_kg
            rigid = model.soft is None and not model.fixed
            assert model.mass_kg == pytest.approx(1.5 * before if rigid else before)


def test_samples_are_drawn_around_what_was_found_and_as_widely_as_it_leaves_open(
    tmp_path: Path, script: SimpleNamespace
) -> None:
    run = RunFolder.create(tmp_path / "run")
    known = with_calibration(run, pose_bias=BIAS, masses=MASSES)
    seen = script.scene()
    sure = {name: np.zeros((6, 6)) for name in seen.Ts_base_object}
    place = read_rebuilt_scene(run, seen.task)
    scene = place.scene(seen.task, seen.urdf, seen.Ts_base_object, covariances=sure)
    config = calibrated(ReplayConfig(), known, seen.task)
    draws = [draw_variation(sample_rng(0, "s", k), scene, config) for k in range(150)]
    shift = np.array([d.Ts_base_object["cube"][:3, 3] for d in draws])
    shift -= seen.Ts_base_object["cube"][:3, 3]
    assert shift[:, :2].mean(axis=0) == pytest.approx([0.006, -0.004], abs=1e-4)
    assert shift[:, :2].std(axis=0) == pytest.approx([0.001 / 1.96] * 2, rel=0.15)
    masses = np.log([draw.objects["cube"].mass_kg for draw in draws])
    assert masses.mean() == pytest.approx(np.log(0.05 * 1.5), abs=0.03)
    assert masses.std() == pytest.approx(np.log(1.8 / 1.2) / 2 / 1.96, rel=0.15)
    assert config.variation.mass_spread(soft=True) == MASS_LOG
    assert "masses of rigid objects" not in draws[0].to_record(config)["physics"]


def test_what_was_seen_afterwards_is_corrected_as_what_was_seen_before() -> None:
    correction = correction_of(calibration(pose_bias=BIAS))
    seen = StartState(Ts_base_object={"cube": np.eye(4)}, reasons={"box": "hidden"}, seen_ns=7)
    found = correction.state(seen)
    assert found.Ts_base_object["cube"][:2, 3] == pytest.approx([0.006, -0.004])
    assert (dict(found.reasons), found.seen_ns) == ({"box": "hidden"}, 7)


def test_a_replay_puts_the_box_where_the_calibration_says(
    tmp_path: Path, script: SimpleNamespace
) -> None:
    run, scene = RunFolder.create(tmp_path / "run"), script.scene()
    known = with_calibration(run, pose_bias=BIAS)
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
    shift = box.p_m[0] - scene.Ts_base_object["box"][:3, 3]
    assert shift == pytest.approx([0.006, -0.004, 0.0], abs=1e-9)
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


def test_distances_are_found_where_the_robot_finds_them(tmp_path: Path) -> None:
    run, rng = RunFolder.create(tmp_path / "run"), np.random.default_rng(0)
    grid = SdfGrid(
        values_m=rng.normal(size=(6, 7, 8)).astype(np.float32), origin_m=np.zeros(3), voxel_m=0.01
    )
    seen = StaticSdf(
        conservative=grid, observed=grid, state=np.zeros((6, 7, 8), dtype=np.uint8),
        truncation_m=0.03, table_z_m=0.0,
    )  # fmt: skip
    run.scene_dir.mkdir(exist_ok=True)
    seen.save(run.scene_dir / "sdf.npz")
    record = {"schema_version": 1, "key": "k", "scene_hash": "abc", "background": {},
              "sources": [], "views": []}  # fmt: skip
    (run.scene_dir / "scene.json").write_text(json.dumps(record))
    task, points = load_task("cube_into_box"), rng.uniform(0.0, 0.05, (50, 3))
    plain = read_rebuilt_scene(run, task).static_sdf
    with_calibration(run, pose_bias=BIAS)
    moved = read_rebuilt_scene(run, task).static_sdf
    assert plain is not None
    assert moved is not None
    for name in ("conservative", "observed"):
        before, after = getattr(plain, name), getattr(moved, name)
        found = after.distance(points + np.array([0.006, -0.004, 0.0]))
        np.testing.assert_allclose(found, before.distance(points), atol=1e-9)
    assert read_rebuilt_scene(run, task).static_sdf is moved, (
        "what is derived from it is remembered"
    )
    assert moved.table_z_m == 0.0
