"""A motion that nobody planned, told: grips, stages, and the same path as with a plan."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.episode.executions import NO_PLAN
from bridge.episode.metadata import EpisodeInfo
from bridge.robots.robot import robot_of
from twin.replay.config import ReplayConfig
from twin.replay.execution import closed_mask, in_order, path_of_execution
from twin.replay.observed import find_grips, observed_plan, observed_stages
from twin.replay.result import ReplayResult
from twin.robot.model import load_robot

MS = 1_000_000


def widths_of(*knots: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Straight lines between (s, m), every 8 ms."""
    times_s = np.arange(0.0, knots[-1][0], 0.008)
    return (times_s * 1e9).astype(np.int64), np.interp(times_s, *np.array(knots).T)


def test_a_grip_is_from_closing_over_holding_to_opening() -> None:
    times_ns, width_m = widths_of(
        (0, 0.085), (2, 0.085), (2.5, 0.04), (6, 0.04), (6.5, 0.085), (8, 0.085)
    )
    ((closing, held, opening),) = find_grips(times_ns, width_m)
    assert closing * 1e-9 == pytest.approx(2.03, abs=0.03)
    assert held * 1e-9 == pytest.approx(2.48, abs=0.03)
    assert opening * 1e-9 == pytest.approx(6.03, abs=0.03)


def test_fingers_that_wait_half_closed_hold_only_when_they_stop_for_good() -> None:
    knots = (
        (0, 0.085),
        (1, 0.085),
        (1.2, 0.06),
        (3, 0.06),
        (3.2, 0.04),
        (6, 0.04),
        (6.2, 0.085),
        (7, 0.085),
    )
    ((_, held, _),) = find_grips(*widths_of(*knots))
    assert held * 1e-9 == pytest.approx(3.18, abs=0.03)


@given(st.lists(st.floats(0.0, 0.085), min_size=2, max_size=60))
def test_grips_follow_each_other_and_lie_within_the_recording(widths: list[float]) -> None:
    times_ns = np.arange(len(widths), dtype=np.int64) * 8 * MS
    grips = find_grips(times_ns, np.array(widths))
    flat = [instant for grip in grips for instant in grip]
    assert flat == sorted(flat)
    assert all(0 <= instant <= times_ns[-1] for instant in flat)
    drop = max((a - b for i, a in enumerate(widths) for b in widths[i:]), default=0.0)
    assert bool(grips) == (drop > 0.002)


TABLES = (
    {"id": "pick", "grasp": "a", "allowed_contacts": [["gripper", "a"]]},
    {"id": "carry", "carry": "a"},
    {"id": "place", "release": "a"},
    {"id": "pick_b", "grasp": "b"},
    {"id": "place_b", "release": "b"},
)


def tool_path(*stops: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Straight up and down: (s, height in m)."""
    times_s = np.arange(0.0, stops[-1][0] + 0.004, 0.01)
    p = np.zeros((len(times_s), 3))
    p[:, 2] = np.interp(times_s, *np.array(stops).T)
    return (times_s * 1e9).round().astype(np.int64), p


def test_stages_end_when_the_tool_leaves_with_what_was_done() -> None:
    times_ns, p = tool_path(
        (0, 0.3),
        (2, 0),
        (3, 0),
        (4, 0.3),
        (6, 0),
        (7, 0),
        (8, 0.3),
        (10, 0),
        (11, 0),
        (12, 0.3),
        (14, 0),
        (15, 0),
        (16, 0.3),
    )
    grips = [
        (int(a * 1e9), int(b * 1e9), int(c * 1e9))
        for a, b, c in ((2.2, 2.8, 6.5), (10.2, 10.8, 14.5))
    ]
    stages = observed_stages(TABLES, grips, times_ns, p)
    assert [stage.id for stage in stages] == ["pick", "carry", "place", "pick_b", "place_b"]
    assert stages[0].allowed_contacts == (("gripper", "a"),)
    ends = [stage.t_end_ns * 1e-9 for stage in stages]
    assert ends[0] == pytest.approx(3.18, abs=0.05), "5 cm above where it gripped"
    assert ends[2] == pytest.approx(7.18, abs=0.05), "5 cm from where it let go"
    assert ends[1] == pytest.approx((ends[0] + ends[2]) / 2, abs=0.02)
    assert ends[3] == pytest.approx(11.18, abs=0.05)
    assert ends[4] == pytest.approx(16.0, abs=0.02)
    assert [stage.t_start_ns for stage in stages[1:]] == [stage.t_end_ns for stage in stages[:-1]]


def test_without_a_grip_everything_belongs_to_the_stage_that_would_grasp() -> None:
    times_ns, p = tool_path((0, 0.3), (5, 0))
    stages = observed_stages(TABLES, [], times_ns, p)
    assert stages[0].t_end_ns == times_ns[-1]
    assert all(stage.t_start_ns == times_ns[-1] for stage in stages[1:])


def test_the_fingers_command_and_the_path_are_those_of_the_plan(
    script: SimpleNamespace, good: ReplayResult
) -> None:
    scene = script.scene()
    plan = script.plan(scene)
    track, widths = script.recorded_tracks(good, start_ns=10**18)
    robot = load_robot(scene.urdf)
    record = robot_of(scene.urdf)
    info = EpisodeInfo(id="t", kind="trial", task=scene.task.name, policy="act")
    seen = observed_plan(in_order(track, record, "p"), widths, robot, scene.task, info)
    assert (seen.id, seen.robot, seen.frame, seen.policy) == (
        NO_PLAN,
        plan.robot,
        plan.frame,
        "act",
    )
    assert [stage.id for stage in seen.stages] == [stage.id for stage in plan.stages]
    paths = [
        path_of_execution(track, widths, each, ReplayConfig(), record) for each in (plan, seen)
    ]
    np.testing.assert_array_equal(paths[0].joints_rad, paths[1].joints_rad)
    differs = np.abs(paths[0].width_m - paths[1].width_m) > 1e-9
    assert np.count_nonzero(differs) <= 2, "the command may be narrower a sample earlier or later"
    times = paths[0].width_times_ns
    assert closed_mask(times, widths.position[:, 0], seen).any()
