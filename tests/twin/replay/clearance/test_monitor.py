"""Clearance against shapes whose distance can be worked out by hand."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
from scripted_plans import joints_over

from twin.replay.clearance.monitor import ClearanceMonitor, active_stage
from twin.replay.config import ReplayConfig
from twin.replay.scene import ReplayScene
from twin.robot.collision import hulls_of
from twin.robot.model import load_robot

WIDTH_M = 0.08


def monitor_of(script: SimpleNamespace, scene: ReplayScene, **stage: object) -> ClearanceMonitor:
    plan = script.plan(scene)
    stages = tuple(replace(item, **stage) for item in plan.stages)
    hulls = hulls_of(load_robot(scene.urdf))
    return ClearanceMonitor(scene, replace(plan, stages=stages), hulls, ReplayConfig())


def test_the_distance_to_the_table_is_the_height_of_the_tips(script: SimpleNamespace) -> None:
    scene = script.scene()
    monitor = monitor_of(script, scene)
    for height in (0.035, 0.02, 0.0):  # higher up, the upper arm is the closest: 30 mm
        joints = joints_over(scene, 0.62, -0.1, height)
        assert monitor.measure(0, joints, WIDTH_M, {}) == pytest.approx(height - 0.01, abs=1e-6)


def test_the_smallest_clearance_is_kept_with_when_and_between_what(script: SimpleNamespace) -> None:
    scene = script.scene()
    monitor = monitor_of(script, scene)
    assert monitor.nearest() is None
    heights = {0: 0.035, 1: 0.02, 2: 0.03}
    found = [
        monitor.measure(t_ns, joints_over(scene, 0.62, -0.1, height), WIDTH_M, {})
        for t_ns, height in heights.items()
    ]
    nearest = monitor.nearest() or {}
    assert (nearest["t_ns"], nearest["distance_m"]) == (1, min(found))
    assert nearest["bodies"][1] == "table"


def test_the_margin_decides_between_close_and_too_close(script: SimpleNamespace) -> None:
    scene = script.scene()
    for tips_m, causes in ((0.0025, []), (0.0015, ["too_close"]), (-0.001, ["collision"])):
        monitor = monitor_of(script, scene)
        monitor.measure(0, joints_over(scene, 0.62, -0.1, 0.01 + tips_m), WIDTH_M, {})
        assert [failure.cause for failure in monitor.failures] == causes


def test_the_first_failure_keeps_its_time_and_both_bodies(script: SimpleNamespace) -> None:
    scene = script.scene()
    monitor = monitor_of(script, scene)
    for t_ns, height in ((0, 0.1), (1, 0.005), (2, 0.0)):
        monitor.measure(t_ns, joints_over(scene, 0.62, -0.1, height), WIDTH_M, {})
    collision = next(f for f in monitor.failures if f.cause == "collision")
    assert collision.t_ns == 1
    assert collision.bodies[1] == "table"
    contact = next(c for c in monitor.contacts() if c.bodies[0] == collision.bodies[0])
    assert (contact.start_ns, contact.end_ns, contact.allowed) == (1, 2, False)
    assert contact.min_distance_m == pytest.approx(-0.01, abs=1e-6)


def test_an_allowed_contact_neither_fails_nor_lowers_the_clearance(script: SimpleNamespace) -> None:
    scene = script.scene()
    joints = joints_over(scene, 0.62, -0.1, 0.009)
    allowed = monitor_of(script, scene, allowed_contacts=(("gripper", "table"),))
    assert allowed.measure(0, joints, WIDTH_M, {}) > 0.02
    assert not allowed.failures
    assert allowed.contacts()[0].allowed


def test_an_allowed_contact_is_no_leave_to_go_through(script: SimpleNamespace) -> None:
    scene = script.scene()
    joints = joints_over(scene, 0.62, -0.1, -0.01)
    monitor = monitor_of(script, scene, allowed_contacts=(("gripper", "table"),))
    monitor.measure(0, joints, WIDTH_M, {})
    assert [failure.cause for failure in monitor.failures] == ["deep_contact"]


def test_an_object_at_rest_where_it_started_is_nobodys_collision(script: SimpleNamespace) -> None:
    """The cube lies on the table; only once it was moved does its table contact count."""
    scene = script.scene()
    joints = joints_over(scene, 0.4, 0.0, 0.3)
    monitor = monitor_of(script, scene, allowed_contacts=())
    start = scene.Ts_base_object["cube"]
    monitor.measure(0, joints, WIDTH_M, {"cube": start})
    assert not monitor.failures
    pushed = start.copy()
    pushed[0, 3] += 0.05
    monitor.measure(1, joints, WIDTH_M, {"cube": pushed})
    assert [failure.bodies for failure in monitor.failures] == [("cube", "table")]


def test_the_stage_that_has_begun_last_is_active(script: SimpleNamespace) -> None:
    stages = script.plan(script.scene()).stages
    end = stages[0].t_end_ns
    assert active_stage(stages, 0) is stages[0]
    assert active_stage(stages, end - 1) is stages[0]
    assert active_stage(stages, end) is stages[1]
    assert active_stage(stages, 10**12) is stages[1]
    assert active_stage((), 0) is None


def test_a_higher_table_is_closer_by_its_height(script: SimpleNamespace) -> None:
    scene = replace(script.scene(), table_height_m=0.015)
    joints = joints_over(scene, 0.62, -0.1, 0.03)
    assert monitor_of(script, scene).measure(0, joints, WIDTH_M, {}) == pytest.approx(
        0.005, abs=1e-6
    )
