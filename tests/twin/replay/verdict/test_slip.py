"""Holds of a plan: what moves in the hand slipped, what goes along is held."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from jaxtyping import Float

from bridge.geometry import se3
from bridge.task.plan import Plan
from bridge.task.verdict import Factor
from twin.gate.gate import no_verdict
from twin.replay.config import ReplayConfig
from twin.replay.path import JointPath
from twin.replay.result import ReplayResult
from twin.replay.slip import GraspedObject, grasped_objects, slips, unless_slipped
from twin.replay.verdict import replay_joints, replay_plan

RATE_HZ = 60
LIMIT_M = 0.01
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


def carried(
    script: SimpleNamespace,
    slide_m: Float[np.ndarray, " num_steps"] | None = None,
    turn_rad: float = 0.0,
) -> tuple[Plan, ReplayResult]:
    """The hand lifts the cube at constant speed, turning; the cube goes along, or slides down."""
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
    if slide_m is not None:
        cube[:, 2, 3] -= slide_m
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


def sliding(seconds: tuple[float, float], far_m: float, script: SimpleNamespace) -> np.ndarray:
    steps = len(carried(script)[1].stamps_ns)
    return np.interp(np.arange(steps) / RATE_HZ, seconds, (0.0, far_m))


def hold_of(plan: Plan, result: ReplayResult) -> GraspedObject:
    (hold,) = grasped_objects(plan, path_of(plan), result)
    return hold


def test_what_goes_along_with_the_hand_is_held_however_it_turns(script: SimpleNamespace) -> None:
    hold = hold_of(*carried(script, turn_rad=1.0))
    assert hold.object_id == "cube"
    assert hold.moved_m.max() < 1e-9
    assert slips([hold], 1e-6) == []


def test_a_hold_begins_when_the_hand_leaves_and_ends_when_it_is_told_to_open(
    script: SimpleNamespace,
) -> None:
    hold = hold_of(*carried(script))
    assert hold.stamps_ns[0] * 1e-9 == pytest.approx(LEAVES_S, abs=0.05)
    assert hold.stamps_ns[-1] * 1e-9 == pytest.approx(OPENS_S, abs=0.02)


def test_what_slides_in_the_hand_slipped_from_the_instant_it_is_beyond_the_limit(
    script: SimpleNamespace,
) -> None:
    plan, result = carried(script, sliding((2.0, 4.0), 0.02, script))
    (failure,) = slips([hold_of(plan, result)], LIMIT_M)
    assert (failure.cause, failure.bodies) == ("slipped", ("cube",))
    assert failure.t_ns * 1e-9 == pytest.approx(3.0, abs=0.03)
    assert "cube moves by 20 mm in the hand that carries it; up to 10 mm" in failure.detail
    assert slips([hold_of(plan, result)], 0.03) == []


def test_what_slides_before_the_hand_leaves_or_after_it_opened_did_not_slip(
    script: SimpleNamespace,
) -> None:
    for seconds in ((CLOSES_S, LEAVES_S), (OPENS_S, OPENS_S + 0.3)):
        hold = hold_of(*carried(script, sliding(seconds, 0.05, script)))
        assert hold.moved_m.max() < 0.002, seconds


def test_a_gripper_that_acts_later_holds_longer(script: SimpleNamespace) -> None:
    plan, result = carried(script)
    (late,) = grasped_objects(plan, path_of(plan).with_late_gripper(0.2), result)
    assert late.stamps_ns[-1] * 1e-9 == pytest.approx(OPENS_S + 0.2, abs=0.02)


def test_a_grasp_that_misses_is_no_hold(script: SimpleNamespace) -> None:
    plan, result = carried(script)
    nothing = {"cube": np.zeros(len(result.stamps_ns), dtype=bool)}
    assert grasped_objects(plan, path_of(plan), replace(result, finger_contact=nothing)) == []


def test_what_is_touched_beside_the_object_that_is_grasped_is_no_hold(
    script: SimpleNamespace,
) -> None:
    plan, result = carried(script)
    stages = tuple(replace(stage, grasp=stage.grasp and "duck") for stage in plan.stages)
    assert grasped_objects(replace(plan, stages=stages), path_of(plan), result) == []


def test_a_hand_that_never_leaves_carries_nothing(script: SimpleNamespace) -> None:
    plan, result = carried(script)
    still = np.repeat(result.Ts_base_tcp[:1], len(result.stamps_ns), axis=0)
    assert grasped_objects(plan, path_of(plan), replace(result, Ts_base_tcp=still)) == []


def test_a_slip_takes_a_yes_and_an_open_answer_away_and_leaves_a_no_as_it_is(
    script: SimpleNamespace,
) -> None:
    failures = slips([hold_of(*carried(script, sliding((2.0, 4.0), 0.02, script)))], LIMIT_M)
    for value in (True, None):
        assert unless_slipped(Factor(value=value), failures).cause == "slipped"
        assert unless_slipped(Factor(value=value), []) == Factor(value=value)
    no = Factor(value=False, cause="inside")
    assert unless_slipped(no, failures) is no


@pytest.mark.slow
def test_what_is_planned_is_refused_for_a_slip_and_what_was_executed_is_not(
    script: SimpleNamespace, good: ReplayResult
) -> None:
    scene = script.scene()
    plan = script.plan(scene)
    strict = ReplayConfig(max_slip_m=1e-6)
    planned = replay_plan(plan, scene, strict).verdict
    assert good.verdict.accepted is True
    assert (planned.accepted, planned.terminal.cause) == (False, "slipped")
    assert planned.findings == good.verdict.findings
    track, widths = script.recorded_tracks(good)
    executed = replay_joints(track, widths, scene, strict, plan=plan).verdict
    assert executed.terminal.value is True
