"""Recorded finger distances become commands that press, and laws of the path they go along."""

from types import SimpleNamespace

import numpy as np
import pytest

from bridge.episode.streams import JointTrack
from bridge.robots.default import ARM_JOINTS, ROBOT
from twin.replay.config import ReplayConfig
from twin.replay.execution import (
    check_covers,
    check_length,
    closed_mask,
    cut_track,
    path_of_execution,
    stages_as_executed,
)
from twin.replay.path import MAX_JOINT_STEP_RAD, JointPath, UnusablePlanError, jumps
from twin.robot.model import RobotModel, load_robot

OPEN_M, HELD_M = 0.085, 0.040


def recorded_grasp(lag_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Open, close onto a 40 mm cube at 1.1 s, open at 4.2 s (the scripted plan at pace 2)."""
    t = np.arange(0.0, 5.5, 0.008)
    knots = [0.0, 1.1 + lag_s, 1.4 + lag_s, 4.2 + lag_s, 4.5 + lag_s, 6.0]
    width = np.interp(t, knots, [OPEN_M, OPEN_M, HELD_M, HELD_M, OPEN_M, OPEN_M])
    noise = np.random.default_rng(0).normal(0, 2e-4, len(t))
    return (t * 1e9).astype(np.int64), width + noise


@pytest.mark.parametrize("lag_s", [0.0, 0.3, 0.8])
def test_the_grasp_is_found_also_when_it_comes_late(script: SimpleNamespace, lag_s: float) -> None:
    times, width = recorded_grasp(lag_s)
    closed = closed_mask(times, width, script.plan(script.scene()))
    found = times[closed] * 1e-9
    assert found[0] == pytest.approx(1.4 + lag_s, abs=0.03)
    assert found[-1] == pytest.approx(4.2 + lag_s, abs=0.03)
    assert np.all(np.diff(np.flatnonzero(closed)) == 1)


def still_arm(times: np.ndarray) -> JointTrack:
    return JointTrack(names=ARM_JOINTS, stamps_ns=times, position=np.zeros((len(times), 6)))


def gripper(times: np.ndarray, width: np.ndarray) -> JointTrack:
    return JointTrack(names=("gripper_width",), stamps_ns=times, position=width[:, None])


def test_the_command_presses_only_while_something_is_held(script: SimpleNamespace) -> None:
    times, width = recorded_grasp(0.2)
    plan, track = script.plan(script.scene()), still_arm(times)
    path = path_of_execution(track, gripper(times, width), plan, ReplayConfig(), ROBOT)
    at = {t: float(path.width_at(np.array([round(t * 1e9)]))[0]) for t in (0.5, 3.0, 5.2)}
    assert at[0.5] == pytest.approx(OPEN_M, abs=1e-3)
    assert at[3.0] == pytest.approx(HELD_M - 0.01, abs=1e-3)
    assert at[5.2] == pytest.approx(OPEN_M, abs=1e-3)
    assert path.first_close_ns is not None
    assert path.first_close_ns * 1e-9 == pytest.approx(1.3, abs=0.05)


def test_stamps_count_from_the_first_one_and_repeats_are_dropped(script: SimpleNamespace) -> None:
    times, width = recorded_grasp(0.0)
    stamps = np.concatenate([times, times[-1:]]) + 1_700_000_000_000_000_000
    width = np.append(width, width[-1])
    plan, track = script.plan(script.scene()), still_arm(stamps)
    path = path_of_execution(track, gripper(stamps, width), plan, ReplayConfig(), ROBOT)
    assert path.times_ns[0] == 0
    assert np.all(np.diff(path.times_ns) > 0)
    assert path.end_ns() == times[-1]


def test_stages_take_the_times_the_recording_gives_them(script: SimpleNamespace) -> None:
    plan = script.plan(script.scene())
    start = 1_000_000_000_000
    events = [
        {"type": "stage_started", "plan_id": plan.id, "stage_id": "place", "stamp_ns": start + 7},
        {"type": "stage_ended", "plan_id": plan.id, "stage_id": "grasp", "stamp_ns": start + 6},
        {"type": "stage_started", "plan_id": "other", "stage_id": "grasp", "stamp_ns": start + 99},
        {"type": "mark", "plan_id": plan.id, "stamp_ns": start},
    ]
    grasp, place = stages_as_executed(plan, events, start)
    assert (grasp.t_start_ns, grasp.t_end_ns) == (0, 6)
    assert (place.t_start_ns, place.t_end_ns) == (7, plan.stages[1].t_end_ns)
    assert stages_as_executed(plan, [], start) == plan.stages


def test_joints_that_were_not_recorded_are_not_made_up(script: SimpleNamespace) -> None:
    times, width = recorded_grasp(0.0)
    plan = script.plan(script.scene())
    track = still_arm(times[(times < 2_000_000_000) | (times > 3_000_000_000)])
    with pytest.raises(UnusablePlanError, match=r"for 1\.0 s from 2\.0 s on"):
        path_of_execution(track, gripper(times, width), plan, ReplayConfig(), ROBOT)


def test_a_recording_that_stops_early_or_starts_late_is_refused(script: SimpleNamespace) -> None:
    stamps = np.arange(2_000_000_000, 4_000_000_000, 8_000_000)
    track, plan = still_arm(stamps), script.plan(script.scene())
    cut = cut_track(track, 2_000_000_000, 5_000_000_000)
    check_covers(cut, "joints", 4_400_000_000, plan.id)
    with pytest.raises(UnusablePlanError, match=r"no joints were recorded for 1\.0 s at its end"):
        check_covers(cut, "joints", 5_000_000_000, plan.id)
    late = cut_track(track, 1_000_000_000, 3_000_000_000)
    with pytest.raises(UnusablePlanError, match=r"for 1\.0 s from 0\.0 s on"):
        path_of_execution(late, late, plan, ReplayConfig(), ROBOT)


@pytest.mark.parametrize(
    ("what", "factor", "shift"),
    [("radians, 0 when open", -9.4, 0.8), ("millimetres", 1000.0, 0.0), ("per cent", 1176.0, 0.0)],
)
def test_widths_that_are_no_distances_in_metres_are_refused(
    script: SimpleNamespace, what: str, factor: float, shift: float
) -> None:
    """They would be cut off at the fingers' limits and replayed as a gripper that does nothing."""
    times, width = recorded_grasp(0.0)
    widths = JointTrack(
        names=("finger_joint",), stamps_ns=times, position=factor * width[:, None] + shift
    )
    plan = script.plan(script.scene())
    with pytest.raises(
        UnusablePlanError, match=r"gripper widths from -?\d.* in metres, 0 to 0\.085"
    ):
        path_of_execution(still_arm(times), widths, plan, ReplayConfig(), ROBOT)


def test_of_several_joints_of_a_gripper_the_one_with_the_name_counts(
    script: SimpleNamespace,
) -> None:
    times, width = recorded_grasp(0.0)
    both = np.stack([np.zeros(len(width)), width], axis=1)
    plan = script.plan(script.scene())

    def path(*names: str) -> JointPath:
        widths = JointTrack(names=names, stamps_ns=times, position=both)
        return path_of_execution(
            still_arm(times), widths, plan, ReplayConfig(mode="kinematic"), ROBOT
        )

    assert np.array_equal(path("current", "gripper_width").width_m, width)
    with pytest.raises(UnusablePlanError, match=r"several joints of the gripper: left, right"):
        path("left", "right")


def test_a_joint_that_is_not_the_arms_may_say_nothing(script: SimpleNamespace) -> None:
    """Drivers send NaN for joints without an encoder, in whatever order they like."""
    times, width = recorded_grasp(0.0)
    names = ("wheel", *reversed(ARM_JOINTS))
    position = np.tile(np.arange(7.0), (len(times), 1)) / 10
    position[:, 0] = np.nan
    track = JointTrack(names=names, stamps_ns=times, position=position)
    plan = script.plan(script.scene())
    path = path_of_execution(track, gripper(times, width), plan, ReplayConfig(), ROBOT)
    assert path.joints_rad[0] == pytest.approx([0.6, 0.5, 0.4, 0.3, 0.2, 0.1])


def test_an_execution_of_hours_is_refused_before_it_takes_hours(script: SimpleNamespace) -> None:
    plan = script.plan(script.scene())
    check_length(600_000_000_000, plan.id)
    with pytest.raises(UnusablePlanError, match=r"was executed for 7200 s\. At most 600 s"):
        check_length(7_200_000_000_000, plan.id)


def test_a_grasp_of_something_soft_begins_where_the_fingers_stop_though_they_creep_on(
    script: SimpleNamespace,
) -> None:
    """57 mm at the touch, 45 mm a second later, as a plush toy was recorded."""
    t = np.arange(0.0, 5.5, 0.008)
    knots = [0.0, 1.2, 1.39, 2.4, 4.2, 4.5, 6.0]
    width = np.interp(t, knots, [OPEN_M, OPEN_M, 0.057, 0.047, 0.045, OPEN_M, OPEN_M])
    width += np.random.default_rng(0).normal(0, 2e-4, len(t))
    closed = closed_mask((t * 1e9).astype(np.int64), width, script.plan(script.scene()))
    found = t[closed]
    assert found[0] == pytest.approx(1.4, abs=0.05)
    assert found[-1] == pytest.approx(4.2, abs=0.05)


STEP_NS = 8_000_000


@pytest.fixture(scope="module")
def robot() -> RobotModel:
    return load_robot(ROBOT.urdf_text())


def path_with(steps_rad: dict[tuple[int, int], float], count: int = 20) -> np.ndarray:
    """Joints that stand still but for steps at (interval, joint)."""
    moves = np.zeros((count, len(ARM_JOINTS)))
    for (index, joint), size in steps_rad.items():
        moves[index, joint] = size
    return np.cumsum(moves, axis=0)


def test_of_several_jumps_the_first_is_named(robot: RobotModel) -> None:
    far = 2 * MAX_JOINT_STEP_RAD
    joints = path_with({(5, 4): far, (9, 1): -far, (14, 0): far})
    times = np.arange(len(joints), dtype=np.int64) * STEP_NS
    (failure,) = jumps(times, joints, robot)
    assert failure.t_ns == 4 * STEP_NS, "the instant before it jumps"
    assert failure.bodies == (ARM_JOINTS[4],)


def test_a_width_holds_from_its_own_instant_until_the_next_one() -> None:
    times = np.array([0, 100, 200], dtype=np.int64)
    path = JointPath(
        times_ns=times,
        joints_rad=np.zeros((3, 6)),
        width_times_ns=times,
        width_m=np.array([0.08, 0.02, 0.05]),
        first_close_ns=100,
    )
    asked = np.array([-1, 0, 99, 100, 199, 200, 300], dtype=np.int64)
    np.testing.assert_array_equal(path.width_at(asked), [0.08, 0.08, 0.08, 0.02, 0.02, 0.05, 0.05])


def test_a_cut_track_begins_and_ends_with_the_interval() -> None:
    """A sample at the very end belongs to it; one at the very start is there once."""
    stamps = np.arange(6, dtype=np.int64) * 10
    position = np.arange(6.0)[:, None] * np.ones((1, 6))
    track = JointTrack(names=ARM_JOINTS, stamps_ns=stamps, position=position)
    cut = cut_track(track, 10, 40)
    np.testing.assert_array_equal(cut.stamps_ns, [10, 20, 30, 40])
    np.testing.assert_array_equal(cut.position[:, 0], [1.0, 2.0, 3.0, 4.0])
    between = cut_track(track, 15, 39)
    np.testing.assert_array_equal(between.stamps_ns, [15, 20, 30])
    np.testing.assert_allclose(between.position[:, 0], [1.5, 2.0, 3.0])
