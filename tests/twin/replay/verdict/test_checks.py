"""What a plan must keep beside I(tau): start, task, limits, grasps, and what goes with the hand."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from bridge.geometry import se3
from bridge.robots.default import ARM_JOINTS, ROBOT
from bridge.task.plan import Plan, Stage
from bridge.task.verdict import Factor, Verdict
from twin.gate.gate import no_verdict
from twin.replay.checks import limited_to_task, stops_of_arm, task_failures
from twin.replay.config import ReplayConfig
from twin.replay.grasps import grasps_seen
from twin.replay.motion import motion_failures
from twin.replay.path import JointPath
from twin.replay.result import ReplayResult, States
from twin.replay.verdict import REFUSED_BEFORE, replay_plan
from twin.robot.model import load_robot


@pytest.fixture(scope="module")
def dense(script: SimpleNamespace) -> Plan:
    """The plan that works, with joints at every waypoint."""
    scene = script.scene()
    return script.with_joints(script.plan(scene), scene)


def start_of(plan: Plan) -> np.ndarray:
    return np.array(plan.tau[0].joints_rad)


def judged(script: SimpleNamespace, plan: Plan, start_rad: np.ndarray | None = None) -> Verdict:
    scene = replace(script.scene(), start_rad=start_rad)
    return replay_plan(plan, scene, ReplayConfig(), refuse_early=True).verdict


def test_a_plan_that_starts_where_the_robot_is_keeps_its_yes(
    script: SimpleNamespace, dense: Plan
) -> None:
    verdict = judged(script, dense, start_of(dense) + 0.003)
    assert verdict.accepted is True
    assert {name: item.value for name, item in verdict.checks.items()} == {
        "start": True,
        "task": True,
        "limits": True,
    }


@pytest.mark.parametrize(
    ("joint", "turn_rad", "said"),
    [(0, 0.1, "0.100 rad (shoulder_pan_joint)"), (5, -0.06, "0.060 rad (wrist_3_joint)")],
)
def test_a_plan_that_starts_elsewhere_is_refused_with_both_numbers(
    script: SimpleNamespace, dense: Plan, joint: int, turn_rad: float, said: str
) -> None:
    where = start_of(dense)
    where[joint] += turn_rad
    verdict = judged(script, dense, where)
    assert verdict.accepted is False
    assert verdict.first_failing == "start"
    start = verdict.checks["start"]
    assert (start.cause, start.bodies) == ("start_elsewhere", (ARM_JOINTS[joint],))
    assert said in str(verdict.reason)
    assert "the limits are 10 mm and 0.05 rad" in str(verdict.reason)
    assert verdict.terminal.value is None
    assert Verdict.from_json(verdict.to_json()) == verdict


def test_a_plan_without_joints_goes_on_from_where_the_arm_is(script: SimpleNamespace) -> None:
    """Of the eight postures of its first pose the arm is in one: that one is replayed."""
    scene = script.scene()
    plan = script.plan(scene)
    robot = load_robot(scene.urdf)
    usual = replay_plan(plan, scene, ReplayConfig(mode="kinematic")).joints_rad[0]
    turned = usual + np.array([0, 0, 0, 0, 0, 2 * np.pi]) * (-1 if usual[5] > 0 else 1)
    assert robot.T_base_tcp(turned) == pytest.approx(robot.T_base_tcp(usual), abs=1e-9)
    found = replay_plan(plan, replace(scene, start_rad=turned), ReplayConfig(mode="kinematic"))
    assert found.joints_rad[0] == pytest.approx(turned, abs=1e-3)
    assert found.verdict.checks["start"].value is True


def with_stage(plan: Plan, index: int, **changes: object) -> Plan:
    stages = list(plan.stages)
    stages[index] = replace(stages[index], **changes)
    return replace(plan, stages=tuple(stages))


def test_a_plan_may_not_allow_more_contacts_than_its_task(script: SimpleNamespace) -> None:
    """Pressing the tool 20 mm into the table used to be accepted where the plan said it may."""
    scene = script.scene()
    pressing = script.plan(scene, grasp_offset_m=(0.0, 0.0, -0.021))
    for index, stage in enumerate(pressing.stages):
        pairs = (*stage.allowed_contacts, ("table", "gripper"))
        pressing = with_stage(pressing, index, allowed_contacts=pairs)
    verdict = judged(script, pressing)
    assert verdict.accepted is False
    assert verdict.first_failing == "task"
    assert "the plan lets table touch gripper in stage 'grasp'" in str(verdict.reason)
    whole = replay_plan(pressing, scene, ReplayConfig()).verdict
    assert whole.clearance.value is False
    assert whole.clearance.bodies[1] == "table"
    assert whole.checks["limits"].cause == "contact_force"


def test_a_plan_may_allow_fewer_contacts_and_name_pairs_either_way_round(
    script: SimpleNamespace,
) -> None:
    plan = script.plan(script.scene())
    task = script.scene().task
    pairs = tuple((b, a) for a, b in plan.stages[0].allowed_contacts)
    assert task_failures(with_stage(plan, 0, allowed_contacts=pairs), task) == []
    assert task_failures(with_stage(plan, 0, allowed_contacts=()), task) == []


@pytest.mark.parametrize(
    ("index", "changes", "cause"),
    [
        (1, {"id": "throw"}, "unknown_stage"),
        (1, {"id": "grasp"}, "repeated_stage"),
        (1, {"t_start_ns": -1}, "stage_times"),
        (1, {"t_end_ns": 0}, "stage_times"),
        (1, {"t_start_ns": 0}, "stage_order"),
        (0, {"allowed_contacts": (("gripper", "box"),)}, "contact_not_allowed"),
        (1, {"allowed_contacts": (("gripper", "table"),)}, "contact_not_allowed"),
        (1, {"allowed_contacts": (("wrist_3_link", "box"),)}, "contact_not_allowed"),
        (1, {"allowed_contacts": (("cube", "cube"),)}, "contact_not_allowed"),
    ],
)
def test_what_stages_ask_beyond_their_task_is_named(
    script: SimpleNamespace, index: int, changes: dict[str, object], cause: str
) -> None:
    plan = with_stage(script.plan(script.scene()), index, **changes)
    assert cause in [item.cause for item in task_failures(plan, script.scene().task)]


def test_stages_out_of_turn_do_not_bring_their_contacts(script: SimpleNamespace) -> None:
    """The last stage alone, from the beginning, would let the gripper lean on the box."""
    plan = script.plan(script.scene())
    alone = replace(plan, stages=(replace(plan.stages[1], t_start_ns=0),))
    (failure,) = task_failures(alone, script.scene().task)
    assert failure.cause == "stage_order"
    assert "before the gripper has closed in 'grasp'" in failure.detail


def test_success_and_contacts_are_the_tasks_whatever_the_plan_says(
    script: SimpleNamespace, good: ReplayResult
) -> None:
    plan = script.plan(script.scene())
    wishes = ({"kind": "inside", "object": "cube", "container": "table"},)
    boasting = with_stage(plan, 1, terminal=wishes, release="box", grasp="table")
    assert replay_plan(boasting, script.scene(), ReplayConfig()).verdict == good.verdict
    kept = limited_to_task(
        with_stage(boasting, 0, allowed_contacts=(("gripper", "table"), ("cube", "table"))),
        script.scene().task,
    )
    assert kept.stages[0].allowed_contacts == (("cube", "table"),)
    assert (kept.stages[1].grasp, kept.stages[1].release) == (None, "cube")
    stranger = replace(plan, stages=(Stage(id="x", text="", allowed_contacts=(("a", "b"),)),))
    assert limited_to_task(stranger, script.scene().task).stages[0].allowed_contacts == ()


def path_with(joints_rad: list[float], step_s: float) -> JointPath:
    """The elbow goes through these angles, the other joints stand still."""
    rows = np.tile([0.0, -1.5, 0.0, -1.5, -1.57, 0.0], (len(joints_rad), 1))
    rows[:, 2] = 1.5 + np.array(joints_rad)
    return JointPath(
        times_ns=(np.arange(len(joints_rad)) * step_s * 1e9).astype(np.int64),
        joints_rad=rows,
        width_times_ns=np.array([0]),
        width_m=np.array([0.08]),
        first_close_ns=None,
    )


@pytest.mark.parametrize(
    ("joints_rad", "step_s", "causes"),
    [
        ([0.0, 0.02, 0.06, 0.1, 0.12], 0.1, []),
        # A jump within a millisecond, which a coarse grid takes for a short move.
        ([0.0, 0.0, 0.08, 0.08], 0.001, ["joint_speed", "tool_speed"]),
        # 1.5 rad/s there and back again within 0.1 s.
        ([0.0, 0.15, 0.0, 0.15, 0.0], 0.1, ["joint_acceleration"]),
        ([0.0, np.nan, 0.0], 0.1, ["joint_speed", "joint_acceleration"]),
    ],
)
def test_a_path_faster_than_the_robot_is_refused(
    joints_rad: list[float], step_s: float, causes: list[str]
) -> None:
    robot = load_robot(ROBOT.urdf_text())
    found = [item.cause for item in motion_failures(path_with(joints_rad, step_s), robot)]
    assert set(causes) <= set(found)
    assert bool(found) == bool(causes)


def test_a_robot_that_would_stop_by_itself_is_not_told_to_go_on() -> None:
    path = path_with([0.0, 0.0], 1.0)
    states = States(
        stamps_ns=np.array([0, 10**9]),
        joints_rad=path.joints_rad + np.array([[0.0] * 6, [0, 0, 0.11, 0, 0, 0]]),
        width_m=np.zeros(2),
        Ts_base_object={},
        finger_contact={},
        arm_force_N=np.array([149.0, 151.0]),
    )
    off_rad = states.joints_rad - path.joints_rad
    force_N, record = states.arm_force_N, ROBOT
    tracking, force = stops_of_arm(states.stamps_ns, off_rad, force_N, record)
    assert (tracking.cause, tracking.bodies, tracking.t_ns) == (
        "tracking_error",
        ("elbow_joint",),
        10**9,
    )
    assert force.cause == "contact_force"
    assert "151 N, the limit is 150 N" in force.detail
    assert stops_of_arm(states.stamps_ns, 0 * off_rad, force_N, record) == [force]
    knocked = states.stamps_ns // 50  # it lasts 20 ms
    assert stops_of_arm(knocked, 0 * off_rad, force_N, record) == []


def test_early_refusal_and_whole_replay_agree_on_plans_that_physics_need_not_see(
    script: SimpleNamespace,
) -> None:
    scene = script.scene()
    for plan in (
        script.plan(scene, pace=12.0),
        script.plan(scene, grasp_offset_m=(0.0, 0.0, 0.9)),
        script.plan(scene, grasp_offset_m=(0.0, 0.0, -0.03)),
    ):
        early = replay_plan(plan, scene, ReplayConfig(), refuse_early=True).verdict
        whole = replay_plan(plan, scene, ReplayConfig()).verdict
        assert (early.accepted, whole.accepted) == (False, False)
        assert early.terminal == Factor(value=None, detail=REFUSED_BEFORE)
        assert early.clearance.value is not True


def test_a_check_of_a_newer_version_that_says_no_stays_a_no(good: ReplayResult) -> None:
    later = replace(good.verdict, checks={"weather": Factor(value=False, cause="rain")})
    read = Verdict.from_json(later.to_json())
    assert read.accepted is False
    assert read.first_failing == "weather"


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
