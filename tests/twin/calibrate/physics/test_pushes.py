"""Imported recordings without a plan: replays of them, laws of pushes, friction found again."""

import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.streams import pose_track
from bridge.terminal import Output
from evaluator.compare import compare_run
from twin.calibrate.config import CalibrateConfig
from twin.calibrate.physics import push_fit
from twin.calibrate.physics.arm_motion import calibrate_physics
from twin.calibrate.physics.imported import ENGINE, replay_imported
from twin.calibrate.physics.push_fit import (
    calibrate_pushes,
    describe_pushes,
    frictions,
    least,
    load_push,
    resampled,
    split,
)
from twin.calibrate.physics.pushes import (
    UnusablePushError,
    described,
    hand_path,
    replay_push,
)
from twin.physics.config import PhysicsConfig
from twin.physics.push import PushWorld
from twin.replay.config import ReplayRunConfig
from twin.replay.runner import replay_run
from twin.replay.summary import describe_run
from twin.robot.hand import Hand
from twin.robot.model import RobotDescriptionError
from twin.scene.store.calibration import write_physics

sys.path.insert(0, str(Path(__file__).parent))

import pushed_boxes

GRAVITY_M_S2 = 9.81


@pytest.fixture
def run(tmp_path: Path) -> RunFolder:
    folder = RunFolder.create(tmp_path / "run")
    pushed_boxes.write_robot(folder)
    return folder


def hand_of(run: RunFolder) -> Hand:
    return Hand(run.path / "robot" / "hand.urdf", ("turn",), "hand")


@pytest.mark.parametrize(("speed_m_s", "friction"), [(0.4, 0.2), (0.6, 0.4)])
def test_a_box_slides_on_as_far_as_coulomb_says(speed_m_s: float, friction: float) -> None:
    plate = np.array([[x, y, z] for x in (-0.02, 0.0) for y in (-0.1, 0.1) for z in (0.01, 0.05)])
    size_m = np.array([0.08, 0.08, 0.06])
    T = np.eye(4)
    T[:3, 3] = [0.0401, 0.0, 0.03]
    still, moving = np.zeros(3), np.array([speed_m_s, 0.0, 0.0])
    config = frictions(friction, 0.5, PhysicsConfig())
    with PushWorld(
        config, hulls_m=[plate], size_m=size_m, mass_kg=0.1, T_world_box=T, table_height_m=0.0
    ) as world:
        p, q = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
        for _ in range(120):
            world.step(p, q, moving, still)
            p[0] += speed_m_s / config.rate_hz
        pushed = world.step(p, q, still, still)
        for _ in range(240):
            box = world.step(p, q, still, still)
    # Pushed by its back face, which stays at the plate.
    assert pushed[0] == pytest.approx(p[0] + 0.04, abs=0.005)
    # It leaves with the plate's speed: v^2 / (2 mu g), within 5 % and a step's way.
    free_m = speed_m_s**2 / (2 * friction * GRAVITY_M_S2)
    assert box[0] - pushed[0] == pytest.approx(free_m, abs=0.05 * free_m + 0.003)
    assert box[1:3] == pytest.approx([0.0, 0.03], abs=0.002)


def test_hulls_follow_the_angle_of_the_fingers(run: RunFolder) -> None:
    hand = hand_of(run)
    palm, finger = hand.hulls_m(0.0)
    assert np.ptp(palm, axis=0) == pytest.approx([pushed_boxes.PALM_M, 0.2, 0.04])
    assert finger[:, 2].max() == pytest.approx(0.2)
    bent_palm, bent = hand.hulls_m(0.7)
    np.testing.assert_allclose(bent_palm, palm)
    hinge = np.array([0.0, 0.0, 0.1])
    expected = (finger - hinge) @ pushed_boxes.turned_about_y(0.7).T + hinge
    np.testing.assert_allclose(bent, expected, atol=1e-9)


def test_a_mesh_that_is_missing_is_named(run: RunFolder) -> None:
    (run.path / "robot" / "meshes" / "palm.stl").unlink()
    with pytest.raises(RobotDescriptionError, match=r"palm\.stl"):
        hand_of(run)
    with pytest.raises(RobotDescriptionError, match="Import the data set again"):
        Hand(run.path / "none.urdf", ("turn",), "hand")


def test_unknown_joints_and_links_are_listed(run: RunFolder) -> None:
    urdf = run.path / "robot" / "hand.urdf"
    with pytest.raises(RobotDescriptionError, match=r"lacks the joints twist.*turn, bend"):
        Hand(urdf, ("twist",), "hand")
    with pytest.raises(RobotDescriptionError, match=r"lacks 'paw'.*root, hand, finger"):
        Hand(urdf, ("turn",), "paw")


def load(run: RunFolder, name: str = "push_0001") -> Any:
    return load_push(run.path.resolve(), name)


def test_the_marker_is_where_it_was_at_the_start(run: RunFolder) -> None:
    pushed_boxes.write_recording(run, "push_0001", 0.3)
    push = load(run)
    np.testing.assert_allclose(push.T_hand_tool[:3, 3], pushed_boxes.MARKER_M, atol=1e-9)
    stamps, Ts = hand_path(push, "executed", 240, described(push))
    t_s, x = pushed_boxes.hand_x_m(0.3)
    # Smoothing by 20 ms rounds the corners of the way and nothing else.
    np.testing.assert_allclose(Ts[:, 0, 3], np.interp(stamps * 1e-9, t_s, x), atol=0.003)
    np.testing.assert_allclose(Ts[:, 1:3, 3], [[0.0, 0.03]] * len(Ts), atol=1e-9)
    _, planned = hand_path(push, "planned", 240, described(push))
    np.testing.assert_allclose(planned[:, :3, :3], [np.eye(3)] * len(planned), atol=1e-12)
    np.testing.assert_allclose(planned[:, :3, 3], [[-0.3, 0.0, 0.03]] * len(planned), atol=1e-12)


def test_what_cannot_be_replayed_is_refused(run: RunFolder) -> None:
    pushed_boxes.write_recording(run, "push_0001", 0.3, box=False)
    with pytest.raises(UnusablePushError, match="no poses of 'cube'"):
        load(run)
    pushed_boxes.write_recording(run, "other", 0.3, motion=None)
    assert load(run, "other") is None


def record_with(run: RunFolder, surface: float, hand: float, count: int = 6) -> None:
    """Recordings whose boxes end where the twin puts them at these frictions."""
    for index in range(count):
        name, speed = f"push_{2 * index + 1:04d}", 0.3 + 0.04 * index
        pushed_boxes.write_recording(run, name, speed)
        push = load(run, name)
        result = replay_push(push, "executed", frictions(surface, hand, PhysicsConfig()))
        pushed_boxes.write_recording(run, name, speed, box_end_x_m=result.Ts_world_box[-1, 0, 3])
    load_push.cache_clear()


@pytest.fixture
def small_grid(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three frictions of the table, two of the hand, one angle."""
    monkeypatch.setattr(push_fit, "FINGERS_RAD", np.array([0.0]))
    monkeypatch.setattr(push_fit, "SURFACE", np.array([0.15, 0.3, 0.6]))
    monkeypatch.setattr(push_fit, "HAND", np.array([0.2, 0.6]))


@pytest.mark.usefixtures("small_grid")
def test_friction_of_made_recordings_is_found_again(run: RunFolder) -> None:
    record_with(run, 0.3, 0.6)
    output = Output(quiet=True)
    record, calibration_id = calibrate_pushes(run, CalibrateConfig(physics=True, workers=1), output)
    found = record["parameters"]["surface_pair_friction"]
    assert (found["value"], found["low"], found["high"]) == (0.3, 0.3, 0.3)
    assert found["identified"]
    held = record["held_out"]
    assert record["fitted_to"] == ["push_0001", "push_0005", "push_0009"]
    assert held["episodes"] == ["push_0003", "push_0007", "push_0011"]
    assert held["calibrated"]["end_point_error_median_m"] < 1e-3
    assert held["nominal"]["end_point_error_median_m"] > 5e-3
    assert record["promoted"]
    own = PhysicsConfig().object_friction
    assert record["identified"]["surface_friction"]["value"] == pytest.approx(0.3 / own)
    text = describe_pushes(record, calibration_id)
    assert re.search(r"held out, calibrated: end points off by 0\.\d mm \(median of 3", text)


@pytest.mark.usefixtures("small_grid")
def test_too_few_pushes_are_refused(run: RunFolder) -> None:
    for index in range(4):
        pushed_boxes.write_recording(run, f"push_{index}", 0.3)
    with pytest.raises(UnusablePushError, match=r"4 pushes .* at least 6"):
        calibrate_pushes(run, CalibrateConfig(physics=True, workers=1), Output(quiet=True))


def test_every_other_run_is_held_out() -> None:
    assert split(["r_31", "r_01", "r_07", "r_05"]) == (["r_01", "r_07"], ["r_05", "r_31"])


def test_the_least_error_is_found_again_on_resamples() -> None:
    rng = np.random.default_rng(3)
    grid = 0.01 + 0.001 * rng.random((6, 2, 4, 3))
    grid[:, 1, 2, 0] = 0.002
    assert least(grid, range(6)) == (1, 2, 0)
    assert (resampled(grid) == (1, 2, 0)).all()
    grid[:3, 0, 0, 0] = (
        0.0  # best for three runs, bad for the others: best where only these are drawn
    )
    share = (resampled(grid) == (0, 0, 0)).all(axis=1).mean()
    assert share == pytest.approx(2**-6, abs=0.012)


def test_a_recording_of_another_kind_has_no_motion(run: RunFolder) -> None:
    path = pushed_boxes.write_recording(run, "push_0001", 0.3, motion=None)
    assert load(run) is None
    assert Episode.open(path).info.kind == "imported"


QUIET = Output(quiet=True)
TOOL = "/lab/tcp/pose"


@pytest.fixture
def pushed(run: RunFolder) -> RunFolder:
    """Two pushes of the made robot, and one recording without a script."""
    load_push.cache_clear()
    pushed_boxes.write_recording(run, "push_0001", 0.3, box_end_x_m=0.1)
    pushed_boxes.write_recording(run, "push_0003", 0.4, box_end_x_m=0.1)
    pushed_boxes.write_recording(run, "other", 0.4, motion=None)
    return run


def replay(run: RunFolder, force: bool = False) -> dict[str, Any]:
    config = ReplayRunConfig(force=force, workers=1)
    return replay_run(run, config, QUIET, replay_imported(run, config, QUIET))


def test_each_trajectory_becomes_an_episode_that_says_what_it_is(pushed: RunFolder) -> None:
    summary = replay(pushed)
    rows = summary["imported"]
    assert [(row["episode"], row["trajectory"]) for row in rows] == [
        (name, trajectory)
        for name in ("push_0001", "push_0003")
        for trajectory in ("executed", "planned")
    ]
    assert summary["skipped_episodes"] == {}
    assert "executed (measured tool): 2 replays" in describe_run(summary)
    executed = Episode.open(Path(rows[0]["path"]))
    derived = executed.derived
    recorded = Episode.open(pushed.episodes_dir / "push_0001.mcap")
    assert derived is not None
    assert (derived.source_episode, derived.source_sha256) == ("push_0001", recorded.sha256())
    assert (derived.engine, derived.trajectory, derived.plan_id) == (ENGINE, "executed", None)
    assert derived.settings["fitted_to"] == []
    tool, box = (
        pose_track(executed, topic) for topic in ("/lab/tcp/pose", "/lab/object/cube/pose")
    )
    measured = pose_track(recorded, "/lab/tcp/pose")
    assert tool.p_m == pytest.approx(measured.at(tool.stamps_ns).p_m, abs=0.003)
    # The palm's face ends 0.02 m before the hand's origin, at 0 m; the box is pushed on from there.
    assert 0.06 <= box.p_m[-1, 0] < 0.12
    # Nothing moves by the schedule of the made arm, so neither does the box.
    planned = pose_track(Episode.open(Path(rows[1]["path"])), "/lab/object/cube/pose")
    assert planned.p_m[-1] == pytest.approx([0.0, 0.0, 0.03], abs=1e-6)


def test_a_second_replay_keeps_what_is_there(pushed: RunFolder) -> None:
    first = {row["path"]: Path(row["path"]).read_bytes() for row in replay(pushed)["imported"]}
    again = replay(pushed)["imported"]
    assert all(row["skipped"] for row in again)
    forced = replay(pushed, force=True)["imported"]
    assert not any(row["skipped"] for row in forced)
    assert {row["path"]: Path(row["path"]).read_bytes() for row in forced} == first


def test_a_calibration_by_pushes_is_used_and_its_runs_do_not_count(pushed: RunFolder) -> None:
    replay(pushed)
    own = PhysicsConfig().object_friction
    record = {
        "promoted": True,
        "identified": {"surface_friction": {"value": 0.3 / own}},
        "parameters": {"finger_rad": {"value": 0.1}},
        "fitted_to": ["push_0001"],
        "id": "x",
    }
    write_physics(pushed, record)
    rows = replay(pushed)["imported"]
    settings = Episode.open(Path(rows[0]["path"])).derived.settings
    expected = frictions(0.3, own, PhysicsConfig())
    assert settings["physics"]["surface_friction"] == pytest.approx(expected.surface_friction)
    assert settings["finger_rad"] == 0.1
    comparison = compare_run(pushed)
    found = comparison.results().get(
        f"body.push.{ENGINE}_executed_calibrated.cube.end_point_median_m"
    )
    assert found.n == 1
    nominal = comparison.results().get(f"body.push.{ENGINE}_executed.cube.end_point_median_m")
    assert nominal.n == 2
    assert [e.episode for e in comparison.exclusions if "fitted" in e.reason] == ["push_0001"] * 2


def test_planned_replays_follow_the_arm_as_it_was_seen_to_move(run: RunFolder) -> None:
    for number in range(1, 5):
        pushed_boxes.write_turning(run, f"turn_{number}", number)
    nominal = [Path(row["path"]) for row in replay(run)["imported"]]
    record, words = calibrate_physics(run, CalibrateConfig(physics=True), QUIET)
    assert record["motion"]["delay_s"]["push"] == pytest.approx(pushed_boxes.DELAY_S, abs=0.02)
    assert "physics" not in record
    assert "physics: 0 pushes" in words
    assert re.search(r"zero of turn .* not determined: only together with (base|tool)", words)
    rows = replay(run)["imported"]
    for row, before in zip(rows, nominal, strict=True):
        recorded = pose_track(Episode.open(run.episodes_dir / f"{row['episode']}.mcap"), TOOL)
        ends = [
            float(np.linalg.norm(pose_track(Episode.open(path), TOOL).p_m[-1] - recorded.p_m[-1]))
            for path in (before, Path(row["path"]))
        ]
        assert ends[0] > 0.004  # though its tool is laid over the recorded one at the start
        assert ends[1] < 0.0015
    derived = Episode.open(Path(rows[1]["path"])).derived
    assert derived.settings["fitted_to"] == ["turn_1", "turn_3"]
    assert derived.calibration_id == record["calibration_id"]


def test_a_robot_that_is_gone_is_named_and_the_rest_goes_on(pushed: RunFolder) -> None:
    (pushed.path / "robot" / "hand.urdf").unlink()
    summary = replay(pushed)
    assert summary["imported"] == []
    assert set(summary["skipped_episodes"]) == {"push_0001", "push_0003"}
    assert "Import the data set again" in summary["skipped_episodes"]["push_0001"]
