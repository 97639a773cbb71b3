"""What a cell asks its planner: round trips, refusals, and answers that do not fit the question."""

import json
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from verdicts import verdict_of

from bridge.errors import InvalidRecordError
from bridge.geometry import se3
from bridge.task.plan import Plan, Stage, Waypoint
from bridge.task.plan_request import PlanAnswer, PlanRequest, Refusal
from bridge.task.verdict import Factor

POSE = se3.pose_record(
    se3.transform_from(np.array([0.92, 0, 0, 0.39]), np.array([0.5, -0.15, 0.02]))
)
PLAN = Plan(
    id="plan_0",
    planner="test",
    policy="nominal",
    condition="without_replanning",
    robot="ur5",
    frame="base_link",
    instruction="Put the cube into the box.",
    task="cube_into_box",
    task_sha256="a" * 64,
    stages=(Stage(id="grasp", text="Grasp."),),
    tau=(
        Waypoint(
            t_ns=0, p_m=(0.0, 0.0, 0.1), q_wxyz=(1.0, 0.0, 0.0, 0.0), g=0, joints_rad=(0.0, 0.1)
        ),
    ),
    entities={"cube": POSE},
    joint_names=("one", "two"),
)
NO = verdict_of(
    "plan_0",
    terminal=Factor(value=False, cause="inside", bodies=("cube", "box")),
    grasps=({"object": "cube", "held": False},),
)
REQUEST = PlanRequest(
    task="cube_into_box",
    task_sha256="a" * 64,
    policy="nominal",
    start_id="cube_into_box/7",
    seed=7,
    round=1,
    robot="ur5",
    joint_names=("one", "two"),
    joints_rad=(0.0, 0.1),
    objects=(
        {
            "schema_version": 1,
            "stamp_ns": 5,
            "object": "cube",
            "found": True,
            "T_base_object": POSE,
            "covariance": None,
            "method": "test",
        },
    ),
    stamp_ns=5,
    refused=(Refusal(plan=PLAN, verdict=NO),),
)


def test_a_request_survives_the_round_trip_with_what_was_refused() -> None:
    assert PlanRequest.from_json(REQUEST.to_json()) == REQUEST
    assert PlanRequest.from_json(REQUEST.to_json()).to_json() == REQUEST.to_json()


def test_a_request_does_not_say_in_which_study_arm_it_is() -> None:
    """So the first candidate cannot depend on it."""
    record = json.loads(REQUEST.to_json())
    assert not {"study_arm", "condition", "plan_id", "trial"} & record.keys()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("task_sha256", "abc"),
        ("round", -1),
        ("objects", [{"object": "cube", "found": False}]),
        ("refused", [{"plan": {}}]),
    ],
)
def test_what_is_no_request_is_refused(name: str, value: object) -> None:
    record = {**json.loads(REQUEST.to_json()), name: value}
    with pytest.raises(InvalidRecordError, match=name):
        PlanRequest.from_json(json.dumps(record).encode())


def test_an_answer_is_a_plan_or_a_reason() -> None:
    assert PlanAnswer.from_json(PlanAnswer(plan=PLAN).to_json()).plan == PLAN
    none = PlanAnswer.from_json(PlanAnswer(reason="out of reach").to_json())
    assert (none.plan, none.reason, none.heard) == (None, "out of reach", True)
    for data in (b"", b"[]", b"{}", b'{"reason": "x"}'):
        with pytest.raises(InvalidRecordError):
            PlanAnswer.from_json(data)


def moved(plan: Plan, shift_m: float) -> Plan:
    x, y, z = POSE["p_m"]
    return replace(plan, entities={"cube": {**POSE, "p_m": [x + shift_m, y, z]}})


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda plan: plan, ""),
        (lambda plan: moved(plan, 1e-9), ""),
        (lambda plan: moved(plan, 1e-4), "another scene: it has cube 0.100 mm"),
        (lambda plan: replace(plan, entities={}), "does not say where it has cube"),
        (lambda plan: replace(plan, entities={"cube": "here"}), "cannot be read"),
        (lambda plan: replace(plan, task="other"), "for task 'other'"),
        (lambda plan: replace(plan, task_sha256="b" * 64), "sha256 bbbbbbbbbbbb"),
        (lambda plan: replace(plan, robot="panda"), "for robot 'panda'"),
        (lambda plan: replace(plan, policy="loose"), "by policy 'loose'"),
        (
            lambda plan: replace(plan, tau=(replace(plan.tau[0], joints_rad=None),)),
            "waypoints without joints",
        ),
    ],
)
def test_a_plan_that_is_no_answer_says_why(change: Callable[[Plan], Plan], words: str) -> None:
    found = REQUEST.why_unfit(change(PLAN))
    assert words in found if words else found == ""
