"""Grasps of a plan: what was touched, and what goes along with the hand."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from bridge.geometry import se3
from bridge.task.plan import Plan
from twin.gate.gate import no_verdict
from twin.replay.grasps import grasps_seen
from twin.replay.path import JointPath
from twin.replay.result import ReplayResult

RATE_HZ = 60
CLOSES_S, LEAVES_S, OPENS_S = 1.1, 1.6, 4.2
"""Of the scripted plan: told to close, begins to lift, told to open."""


def path_of(plan: Plan) -> JointPath:
    return JointPath(
        times_ns=plan.times_ns(),
        joints_rad=np.zeros((len(plan.tau), 6)),
        width_times_ns=plan.times_ns(),
        width_m=np.array([waypoint.width_m or 0.0 for waypoint in plan.tau]),
        first_close_ns=round(CLOSES_S * 1e9),
    )


def carried(script: SimpleNamespace, turn_rad: float = 0.0) -> tuple[Plan, ReplayResult]:
    """The hand lifts the cube at constant speed, turning; the cube goes along."""
    scene = script.scene()
    plan = script.plan(scene)
    steps = round(plan.tau[-1].t_ns * 1e-9 * RATE_HZ) + 1
    t_s = np.arange(steps) / RATE_HZ
    lifted = np.clip(t_s - LEAVES_S, 0.0, 2.0)
    tool = np.tile(np.eye(4), (steps, 1, 1))
    for index, share in enumerate(lifted):
        tool[index, :3, :3] = se3.rotation_from_vector(np.array([0.0, 0.0, turn_rad * share]))
    tool[:, 2, 3] = 0.02 + 0.1 * lifted
    cube = tool @ se3.transform_from(np.array([1.0, 0, 0, 0]), np.array([0.03, 0.0, 0.0]))
    touched = (t_s > CLOSES_S) & (t_s < OPENS_S)
    result = ReplayResult(
        verdict=no_verdict(plan, ""),
        stamps_ns=(t_s * 1e9).round().astype(np.int64),
        joints_rad=np.zeros((steps, 6)),
        width_m=np.zeros(steps),
        Ts_base_tcp=tool,
        Ts_base_object={"cube": cube},
        finger_contact={"cube": touched},
        clearance_m=np.zeros(steps),
        contacts=[],
    )
    return plan, result


def seen(plan: Plan, path: JointPath, result: ReplayResult) -> tuple[dict[str, object], ...]:
    return grasps_seen(plan, path, result, result.Ts_base_tcp)


def held(plan: Plan, result: ReplayResult, path: JointPath | None = None) -> bool:
    (grasp,) = seen(plan, path_of(plan) if path is None else path, result)
    assert grasp["object"] == "cube"
    return bool(grasp["held"])


def test_what_goes_along_with_the_hand_is_held_however_it_turns(script: SimpleNamespace) -> None:
    plan, result = carried(script, turn_rad=1.0)
    (grasp,) = seen(plan, path_of(plan), result)
    assert grasp["held"] is True
    assert grasp["T_base_object"] == se3.pose_record(result.Ts_base_object["cube"][-1])


def test_what_is_let_go_before_the_hand_leaves_is_not_held(
    script: SimpleNamespace,
) -> None:
    plan, result = carried(script)
    before = result.stamps_ns < (LEAVES_S - 0.1) * 1e9
    brief = {"cube": result.finger_contact["cube"] & before}
    (grasp,) = seen(plan, path_of(plan), replace(result, finger_contact=brief))
    assert grasp["held"] is False


def test_a_gripper_that_acts_after_the_hand_left_is_looked_at_from_then_on(
    script: SimpleNamespace,
) -> None:
    plan, result = carried(script)
    late = path_of(plan).with_late_gripper(OPENS_S - CLOSES_S + 0.1)
    assert not held(plan, result, late), "the fingers have left the cube when it closes"


def test_what_is_touched_beside_the_object_that_is_grasped_is_no_grasp(
    script: SimpleNamespace,
) -> None:
    plan, result = carried(script)
    stages = tuple(replace(stage, grasp=stage.grasp and "duck") for stage in plan.stages)
    assert seen(replace(plan, stages=stages), path_of(plan), result) == ()


def test_a_hand_that_never_leaves_carries_nothing(script: SimpleNamespace) -> None:
    plan, result = carried(script)
    still = np.repeat(result.Ts_base_tcp[:1], len(result.stamps_ns), axis=0)
    touched = {"cube": np.ones(len(result.stamps_ns), dtype=bool)}
    assert not held(plan, replace(result, Ts_base_tcp=still, finger_contact=touched))
