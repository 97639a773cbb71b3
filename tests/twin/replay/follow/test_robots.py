"""Whichever robot a recording names: what cannot be judged says why in one sentence."""

import re
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from small_plans import plan_of, waypoint

from bridge.geometry import se3
from bridge.robots.default import ROBOT, ROBOT_NAME
from bridge.task.plan import Plan, Waypoint
from twin.replay.config import ReplayConfig
from twin.replay.motion import motion_failures
from twin.replay.path import UnusablePlanError, check_path, check_usable, path_of_plan
from twin.replay.verdict import replay_plan
from twin.robot.collision import RobotHulls, hulls_of
from twin.robot.model import RobotDescriptionError, RobotModel, load_robot

KINEMATIC = ReplayConfig(mode="kinematic")
HOME = np.array([0.2, -1.4, 1.6, -1.7, -1.5, 0.3])


def plan_through(Ts: np.ndarray, step_s: float = 0.04) -> Plan:
    tau = tuple(waypoint(index * step_s, T, 0.08) for index, T in enumerate(Ts))
    return plan_of("poses", robot=ROBOT_NAME, tau=tau)


def test_a_plan_for_another_robot_is_refused_with_both_names(script: SimpleNamespace) -> None:
    scene = script.scene()
    plan = replace(script.plan(scene), robot="panda")
    with pytest.raises(UnusablePlanError, match=rf"'panda'.*'{ROBOT_NAME}'"):
        replay_plan(plan, scene, KINEMATIC)


def changed(joint: str, before: str, after: str) -> str:
    """The usual description with one thing about one joint changed."""
    urdf = re.sub(
        rf'(<joint name="{joint}"(?:(?!</joint>).)*?){before}',
        rf"\g<1>{after}",
        ROBOT.urdf_text(),
        flags=re.DOTALL,
    )
    assert urdf != ROBOT.urdf_text()
    return urdf


@pytest.mark.parametrize(
    ("joint", "before", "after", "found"),
    [
        ("elbow_joint", 'type="revolute"', 'type="prismatic"', r"'elbow_joint', which slides"),
        (
            "gripper_left_finger_joint",
            'type="prismatic"',
            'type="revolute"',
            r"finger joint 'gripper_left_finger_joint', which does not slide",
        ),
        (
            "gripper_left_finger_joint",
            'type="prismatic"',
            'type="continuous"',
            r"finger joint 'gripper_left_finger_joint', which does not slide",
        ),
    ],
)
def test_joints_of_another_kind_are_refused_by_name(
    joint: str, before: str, after: str, found: str
) -> None:
    """Radians for metres, or metres for radians, would be replayed without a word."""
    with pytest.raises(RobotDescriptionError, match=found):
        RobotModel(changed(joint, before, after))


@pytest.mark.parametrize("origin", ['xyz="0 0 0.8" rpy="0 0 0"', 'xyz="0 0 0" rpy="0 0 3.14159"'])
def test_poses_count_from_the_base_wherever_the_root_is(origin: str) -> None:
    """On a pedestal, say: plans are given in the base, and kinematics and hulls must be too."""
    urdf = changed("world_joint", r"<origin[^>]*/>", f"<origin {origin}/>")
    robot, plain = RobotModel(urdf), load_robot(ROBOT.urdf_text())
    np.testing.assert_allclose(robot.T_base_tcp(HOME), plain.T_base_tcp(HOME), atol=1e-9)
    hulls, others = RobotHulls(robot), RobotHulls(plain)
    for each in (hulls, others):
        each.place(HOME, 0.03)
    np.testing.assert_allclose(hulls.rotations, others.rotations, atol=1e-9)
    np.testing.assert_allclose(hulls.translations, others.translations, atol=1e-9)
    for one, other in zip(hulls.hulls, others.hulls, strict=True):
        np.testing.assert_allclose(one.points_m, other.points_m, atol=1e-9)


@pytest.mark.parametrize("leader", ["world_joint", "endless"])
def test_a_joint_that_mimics_one_without_a_position_is_refused(leader: str) -> None:
    more = (
        '<link name="wheel"/><joint name="endless" type="continuous"><parent link="tool0"/>'
        '<child link="wheel"/><axis xyz="0 0 1"/></joint>'
        '<link name="flap"/><joint name="flap_joint" type="revolute"><parent link="tool0"/>'
        f'<child link="flap"/><axis xyz="0 0 1"/><mimic joint="{leader}"/>'
        '<limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>'
    )
    urdf = ROBOT.urdf_text().replace("</robot>", more)
    with pytest.raises(RobotDescriptionError, match=rf"'flap_joint' mimic '{leader}'.*is fixed or"):
        RobotModel(urdf)


def test_numbers_no_plan_can_mean_are_refused_in_a_sentence() -> None:
    """JSON has no largest integer, and a quaternion too long to be squared has no direction."""
    robot = load_robot(ROBOT.urdf_text())
    plan = plan_through(robot.Ts_base_tcp(np.stack([HOME, HOME + 0.1])))
    first, second = plan.tau

    def with_second(**changes: Any) -> Plan:
        waypoint = Waypoint.__new__(Waypoint)  # as JSON makes it: integers where floats belong
        for name, value in {**vars(second), **changes}.items():
            object.__setattr__(waypoint, name, value)
        return replace(plan, tau=(first, waypoint))

    check_usable(plan, robot)
    for changes, found in (
        ({"t_ns": 10**30}, r"lasts 1\d* s"),
        ({"width_m": 85.0}, r"gripper widths from 0\.080 to 85\.000.*in metres"),
        ({"width_m": -0.04}, r"gripper widths from -0\.040 to"),
        ({"q_wxyz": (1e200, 0.0, 0.0, 0.0)}, "quaternions that are none"),
        ({"p_m": (1e300, 0.0, 0.2)}, "out of this world"),
        ({"p_m": (float("nan"), 0.0, 0.2)}, "not finite"),
        ({"p_m": (10**400, 0.0, 0.2)}, "numbers that are too large"),
        ({"width_m": 10**400}, "numbers that are too large"),
        ({"width_m": 10**25}, r"gripper widths from 0\.080 to 1\d*\.0"),
        ({"joints_rad": (0.0, 0.0, 0.0, 0.0, 0.0, 10**400)}, "numbers that are too large"),
    ):
        with pytest.raises(UnusablePlanError, match=found):
            check_usable(with_second(**changes), robot)
    check_usable(with_second(joints_rad=(0.0, 0.0, 0.0, 0.0, 0.0, 10**25)), robot)


@pytest.mark.parametrize(
    ("before", "after", "found"),
    [
        ('<box size="0.01 0.01 0.01"/>', '<box size="0.01 0 0.01"/>', "a box of size 0.01 0 0.01"),
        ('<joint name="ee_fixed_joint"', '<joint name=""', "has a joint without a name"),
        ('<link name="ee_link">', "<link>", "has a link without a name"),
        ('<link name="ee_link">', '<link name="tool0">', "more than one link named tool0"),
    ],
)
def test_descriptions_that_would_end_the_process_are_refused(
    before: str, after: str, found: str
) -> None:
    """PyBullet and coal do not raise: they take every other replay with them."""
    urdf = re.sub(r" +/>", "/>", ROBOT.urdf_text())
    assert before in urdf
    with pytest.raises(RobotDescriptionError, match=found):
        RobotHulls(RobotModel(urdf.replace(before, after)))


def test_straight_motion_through_a_wrist_singularity_is_a_named_jump() -> None:
    """The tool passes just beside the pose where its axis is along the fourth: the wrist flips."""
    robot = load_robot(ROBOT.urdf_text())
    start = HOME.copy()
    start[4] = -0.35
    end = HOME.copy()
    end[[3, 4, 5]] += [0.0, 0.35 - HOME[4], 0.0]
    T_start, T_end = robot.T_base_tcp(start), robot.T_base_tcp(end)
    # Turn the way a little, so that the straight line misses the singular pose.
    T_end[:3, :3] = T_end[:3, :3] @ se3.rotation_from_vector(np.array([0.02, 0.0, 0.0]))
    Ts = np.stack([T_start, T_end])
    plan = plan_through(Ts, step_s=0.4)
    path, failures, unreachable = path_of_plan(plan, robot)
    assert unreachable is None
    failures += [*check_path(path, robot, hulls_of(robot)), *motion_failures(path, robot)]
    causes = {failure.cause for failure in failures}
    assert causes & {"joint_jump", "joint_speed"}
    for failure in failures:
        assert failure.detail
        assert 0 <= failure.t_ns <= plan.tau[-1].t_ns


def test_every_failure_along_a_path_names_its_first_instant() -> None:
    """Limit, jump and self-collision, each put in on purpose at a known time."""
    from twin.replay.path import JointPath

    robot = load_robot(ROBOT.urdf_text())
    hulls = hulls_of(robot)
    times = np.arange(0, 2_000_000_001, 40_000_000, dtype=np.int64)

    def checked(joints: np.ndarray) -> dict[str, tuple[int, tuple[str, ...]]]:
        path = JointPath(
            times_ns=times,
            joints_rad=joints,
            width_times_ns=times[:1],
            width_m=np.array([0.08]),
            first_close_ns=None,
        )
        found = check_path(path, robot, hulls)
        return {failure.cause: (failure.t_ns, failure.bodies) for failure in found}

    still = np.tile(HOME, (len(times), 1))
    assert checked(still) == {}
    jump = still.copy()
    jump[20:, 1] += 0.5
    assert checked(jump)["joint_jump"] == (times[19], ("shoulder_lift_joint",))
    limit = still.copy()
    limit[:, 2] = np.linspace(3.0, 3.3, len(times))
    first = int(np.argmax(limit[:, 2] > robot.upper_rad[2] + 1e-3))
    assert checked(limit)["joint_limit"] == (times[first], ("elbow_joint",))
    fold = still.copy()
    fold[:, 2] = np.linspace(1.6, 3.0, len(times))
    t_ns, bodies = checked(fold)["self_collision"]
    index = int(np.searchsorted(times, t_ns))
    hulls.place(fold[index], 0.08)
    assert hulls.self_distance()[0] <= 0
    hulls.place(fold[index - 1], 0.08)
    assert hulls.self_distance()[0] > 0
    assert len(bodies) == 2
