"""Peaks of commanded paths, loads and torques, against formulas of their own."""

from dataclasses import replace

import numpy as np
import pytest
from scripted_plans import pick_and_place, scene_of_test

from bridge.robots.default import ROBOT
from bridge.task.plan import Plan
from bridge.task.task_file import load_task
from twin.replay.motion import _derivative, held_of, motion_failures, payload_unknown
from twin.replay.path import JointPath, UnusablePlanError, check_usable
from twin.robot.loads import Load, Loads
from twin.robot.model import RobotModel, load_robot

HZ, SIZE_RAD = 7.0, 0.02


@pytest.fixture
def robot() -> RobotModel:
    return load_robot(ROBOT.urdf_text())


def path_of(robot: RobotModel, rows: np.ndarray, times_s: np.ndarray, **more: object) -> JointPath:
    joints = np.tile(robot.home_rad, (len(rows), 1))
    joints[:, 2] += rows
    return JointPath(
        times_ns=np.round(times_s * 1e9).astype(np.int64),
        joints_rad=joints,
        width_times_ns=np.array([0]),
        width_m=np.array([0.08]),
        first_close_ns=None,
        **more,  # type: ignore[arg-type]
    )


def shaking(robot: RobotModel, size_rad: float, kind: str, hz: float = HZ) -> JointPath:
    times = np.arange(0.0, 1.0, 0.01 * HZ / hz)
    wave = np.sin(np.pi * times / times[-1]) ** 2 * np.sin(2 * np.pi * hz * times)
    return path_of(robot, size_rad * wave, times, interpolation=kind)


@pytest.mark.parametrize("kind", ["linear", "cubic", "quintic"])
@pytest.mark.parametrize("hz", [2.0, 7.0, 25.0, 60.0])
def test_no_frequency_hides_its_acceleration(robot: RobotModel, kind: str, hz: float) -> None:
    """A sine of amplitude A has A w^2, at its envelope's middle; refused just beyond the limit."""
    for peak, refused in ((18.0, True), (12.0, False)):
        size = peak / (2 * np.pi * hz) ** 2
        causes = [f.cause for f in motion_failures(shaking(robot, size, kind, hz), robot)]
        assert ("joint_acceleration" in causes) is refused
    found = _derivative(shaking(robot, 0.001, kind, hz), 2)[1][:, 2].max()
    assert found == pytest.approx(0.001 * (2 * np.pi * hz) ** 2, rel=0.1)


@pytest.mark.parametrize("kind", ["cubic", "quintic"])
@pytest.mark.parametrize("order", [1, 2, 3])
def test_peaks_are_no_less_than_what_dense_sampling_sees(
    robot: RobotModel, kind: str, order: int
) -> None:
    rng = np.random.default_rng(order)
    times = np.cumsum(rng.uniform(0.03, 0.3, 12))
    path = path_of(robot, rng.normal(0, 0.1, 12), times - times[0], interpolation=kind)
    step = 1e-4 if order < 3 else 1e-3
    grid = np.arange(0, path.times_ns[-1] * 1e-9, step)
    rows = path.joints_at((grid * 1e9).round().astype(np.int64))[:, 2]
    sampled = np.abs(np.diff(rows, order)).max() / step**order
    peak = _derivative(path, order)[1][:, 2].max()
    assert 0.97 * sampled <= peak <= 1.1 * sampled


def test_a_path_that_starts_or_ends_at_speed_is_jerked_to_it(robot: RobotModel) -> None:
    times = np.arange(0, 0.5, 0.02)
    for rows in (1.35 * times, -1.35 * times, np.maximum(0, 1.35 * (times - 0.2))):
        (first, *_) = motion_failures(path_of(robot, rows, times), robot)
        assert first.cause == "joint_acceleration"
        assert "elbow_joint is accelerated at 67.50 rad/s^2" in first.detail
        assert "2.12 times as long there would do" in first.detail
        part = path_of(robot, rows, times, moving=True)
        assert bool(motion_failures(part, robot)) == (rows[1] == 0)


def test_a_limit_of_jerk_is_kept_where_the_robot_file_has_one(
    robot: RobotModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = shaking(robot, 0.002, "cubic")  # 0.002 w^3 = 170
    assert motion_failures(path, robot) == []
    for limit, refused in ((150.0, True), (250.0, False)):
        monkeypatch.setattr(robot, "record", replace(robot.record, jerk_rad_s3=(limit,) * 6))
        assert [f.cause for f in motion_failures(path, robot)] == ["joint_jerk"] * refused


def test_what_is_held_adds_its_weight_times_the_lever(robot: RobotModel) -> None:
    path = path_of(robot, np.zeros(2), np.array([0.0, 1.0]))
    held = [Load(name="cube", mass_kg=3.0, start_ns=0, end_ns=10**9)]
    rest = np.zeros((1, 6))
    args = (np.zeros(1), path.joints_rad[:1], rest, rest)
    bare, loaded = (Loads(robot, item).along(*args)["torques"][0] for item in ([], held))
    skeleton = robot.skeleton_m(path.joints_rad[0])
    lever = np.linalg.norm((skeleton[-1] - skeleton[2])[:2])  # the elbow's axis is level
    assert abs(loaded[1] - bare[1]) == pytest.approx(3.0 * 9.81 * lever, rel=0.01)


def test_more_than_the_arm_may_carry_is_refused_with_how_much(robot: RobotModel) -> None:
    scene = scene_of_test()
    plan, task = pick_and_place(scene), load_task("cube_into_box")
    heavy = replace(task.objects["cube"], mass_kg=6.0)
    loaded = replace(task, objects={**task.objects, "cube": heavy})
    path = path_of(robot, np.zeros(2), np.array([0.0, 1.0]))
    for each in (plan, replace(plan, stages=())):
        held = held_of(each, loaded)
        assert [(item.name, item.mass_kg) for item in held] == [("cube", 6.0)]
        (found,) = motion_failures(path, robot, held)
        assert found.cause == "over_payload"
        assert "cube weighs 6 kg, 1.00 kg more than the 5 kg" in found.detail
        assert motion_failures(path, robot, held_of(each, task)) == []
    open_ = replace(plan, tau=tuple(replace(w, g=0) for w in plan.tau))
    assert held_of(open_, loaded) == []


def test_an_unknown_payload_is_no_yes(robot: RobotModel, monkeypatch: pytest.MonkeyPatch) -> None:
    held = held_of(pick_and_place(scene_of_test()), load_task("cube_into_box"))
    assert payload_unknown(robot, held) is None
    monkeypatch.setattr(robot, "record", replace(robot.record, payload_kg=None))
    assert "set payload_kg" in str(payload_unknown(robot, held))
    assert payload_unknown(robot, []) is None


@pytest.mark.parametrize(
    ("setting", "limit", "words"),
    [
        ("elbow_speed_m_s", 0.06, "the elbow moves at"),
        ("momentum_kg_m_s", 3.5, "a momentum of"),
        ("power_W", 9.9, "the motors give"),
        ("stop_time_s", 0.001, "the arm needs for a stop"),
    ],
)
def test_a_stop_that_the_safety_settings_predict_is_named(
    robot: RobotModel, monkeypatch: pytest.MonkeyPatch, setting: str, limit: float, words: str
) -> None:
    times = np.linspace(0, 1, 51)
    path = path_of(robot, np.zeros(51), times)
    path.joints_rad[:, 1] -= 0.4 * (10 * times**3 - 15 * times**4 + 6 * times**5)
    assert motion_failures(path, robot) == []
    monkeypatch.setattr(robot, "record", replace(robot.record, **{setting: limit}))
    (found,) = motion_failures(path, robot)
    assert words in found.detail
    assert f"the limit is {limit:g}" in found.detail


@pytest.mark.parametrize(
    ("first", "by_s", "words"),
    [(0, 1.7e9, "begins at 1700000000 s"), (1, 60.0, None), (0, 60.0, "begins at 60 s")],
)
def test_a_plan_that_waits_is_refused_by_name(
    robot: RobotModel, first: int, by_s: float, words: str | None
) -> None:
    plan = pick_and_place(scene_of_test())
    tau = (plan.tau[0], replace(plan.tau[0], t_ns=1), *plan.tau[1:])
    moved = [replace(w, t_ns=w.t_ns + round(by_s * 1e9)) for w in tau[first + 1 :]]
    late: Plan = replace(plan, tau=(*tau[: first + 1], *moved) if first else tuple(moved))
    check_usable(plan, robot)
    if words is None:
        late = replace(
            late, tau=(late.tau[0], replace(late.tau[1], t_ns=round(by_s * 1e9)), *moved)
        )
        words = "waits 60 s before it moves"
    with pytest.raises(UnusablePlanError, match=words):
        check_usable(late, robot)
