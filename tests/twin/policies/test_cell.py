"""Between two targets the cell is the physics of a replay; beyond a limit it stops, by name."""

from dataclasses import replace

import numpy as np
import pytest
from scripted_plans import pick_and_place, with_joints

from bridge.episode.metadata import EpisodeInfo
from bridge.robots import robot as robots
from twin.policies.cell import TwinCell
from twin.policies.errors import StoppedError
from twin.policies.starts import Start
from twin.replay.config import ReplayConfig
from twin.replay.path import path_of_plan
from twin.replay.verdict import replay_plan
from twin.robot.model import load_robot

INFO = EpisodeInfo(id="e", kind="trial", task="cube_into_box")


def test_targets_of_a_plan_give_the_states_of_its_replay(
    start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a smooth one: at the rate of the physics nothing rounds the corners of straight lines."""
    scene = start.scene
    robot = load_robot(scene.urdf)
    monkeypatch.setattr(robot, "record", replace(robot.record, interpolation="cubic"))
    plan = with_joints(pick_and_place(scene, pace=0.8), scene)
    expected = replay_plan(plan, scene, ReplayConfig())
    assert expected.verdict.accepted is True
    path, _, _ = path_of_plan(plan, load_robot(scene.urdf))
    rate = start.config.physics.rate_hz
    steps = np.arange(np.ceil(path.end_ns() * 1e-9 * rate) + 1)
    stamps = (steps * 1e9 / rate).round().astype(np.int64)
    joints, widths = path.joints_at(stamps), path.width_at(stamps)
    cell = TwinCell(replace(start, joints_rad=joints[0], width_m=float(widths[0])))
    try:
        for target, width in zip(joints[1:], widths[:-1], strict=True):
            cell.go(target, float(width), 1 / rate)
        cell.rest(start.config.settle_after_s)
        assert cell.succeeds()
        result, told = cell.judged(INFO)
    finally:
        cell.close()
    count = min(len(result.stamps_ns), len(expected.stamps_ns))
    assert count > 300
    np.testing.assert_allclose(result.joints_rad[:count], expected.joints_rad[:count], atol=1e-9)
    cube, wanted = result.Ts_base_object["cube"], expected.Ts_base_object["cube"]
    np.testing.assert_allclose(cube[:count], wanted[:count], atol=1e-9)
    assert result.verdict.accepted is True
    assert result.verdict.trajectory == "rollout"
    assert [stage.id for stage in told.stages] == [stage.id for stage in plan.stages]


@pytest.mark.parametrize(
    ("change", "width_m", "period_s", "words"),
    [
        ({1: 9.0}, 0.05, 10.0, r"limits: shoulder_lift_joint is at .* beyond its limits"),
        ({2: 0.5}, 0.05, 0.1, r"limits: elbow_joint moves at 5.00 rad/s.*1.59 times as long"),
        ({0: np.nan}, 0.05, 0.1, "target: 6 joints and a width"),
        ({}, np.inf, 0.1, "target: 6 joints and a width"),
    ],
)
def test_a_target_beyond_a_limit_is_refused_and_moves_nothing(
    start: Start, change: dict[int, float], width_m: float, period_s: float, words: str
) -> None:
    cell = TwinCell(start)
    try:
        before, t_ns = cell.posture()[0], cell.t_ns
        target = cell.target_rad.copy()
        for joint, by in change.items():
            target[joint] += by
        with pytest.raises(StoppedError, match=words):
            cell.go(target, width_m, period_s)
        assert cell.t_ns == t_ns
        np.testing.assert_array_equal(cell.posture()[0], before)
    finally:
        cell.close()


def test_the_arm_stops_by_itself_at_the_force_of_its_robot_file(
    start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Straight down into the table, until 150 N."""
    robot = load_robot(start.scene.urdf)
    monkeypatch.setattr(robot, "record", replace(robot.record, contact_force_N=150.0))
    assert isinstance(robot.record, robots.Robot)
    cell = TwinCell(start)
    try:
        with pytest.raises(StoppedError, match=r"contact_force: .* \d+ N, the limit is 150 N"):
            press(cell)
    finally:
        cell.close()


@pytest.mark.parametrize(("knock_s", "stops"), [(0.03, False), (0.05, True)])
def test_a_knock_does_not_stop_the_arm(
    start: Start, monkeypatch: pytest.MonkeyPatch, knock_s: float, stops: bool
) -> None:
    """As in the stand-in cell, in the middle of a period of the policy."""
    robot = load_robot(start.scene.urdf)
    monkeypatch.setattr(robot, "record", replace(robot.record, contact_force_N=150.0))
    cell = TwinCell(start)
    forces = iter([0.0] * 6 + [200.0] * round(knock_s * 240) + [0.0] * 30)
    monkeypatch.setattr(cell._world, "arm_force_N", lambda: next(forces))
    monkeypatch.setattr(cell._samples, "take", lambda *_: True)
    try:
        if stops:
            with pytest.raises(StoppedError, match="pressed with 200 N"):
                cell.hold(0.1)
            np.testing.assert_allclose(cell.target_rad, cell.posture()[0], atol=1e-12)
        else:
            cell.hold(0.1)
    finally:
        cell.close()


def press(cell: TwinCell) -> None:
    for _ in range(60):
        cell.go(cell.target_rad + np.array([0, 0.03, 0, 0, 0, 0]), 0.0, 0.1)
