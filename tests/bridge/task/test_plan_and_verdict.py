"""Plans, requests for them, and verdicts: round trips, refusals, and the three-valued product."""

import hashlib
import json
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from small_plans import plan_of
from verdicts import verdict_of

from bridge.errors import InvalidRecordError
from bridge.geometry import se3
from bridge.task.plan import Plan, Ranking, Stage, SteeredBy, Waypoint
from bridge.task.plan_request import PlanAnswer, PlanRequest, Refusal
from bridge.task.verdict import Factor

number = st.floats(-2, 2, allow_nan=False)
waypoints = st.builds(
    Waypoint,
    t_ns=st.integers(0, 10**12),
    p_m=st.tuples(number, number, number),
    q_wxyz=st.tuples(number, number, number, number),
    g=st.sampled_from([0, 1]),
    width_m=st.none() | st.floats(0, 0.085),
    joints_rad=st.none() | st.tuples(*[number] * 6),
)


def plan(**changes: object) -> Plan:
    fields: dict[str, object] = {
        "id": "p1",
        "planner": "scripted",
        "policy": "scripted",
        "condition": "with_replanning",
        "robot": "ur5",
        "frame": "base_link",
        "instruction": "Put the cube into the box.",
        "stages": (
            Stage(id="grasp", text="Grasp.", allowed_contacts=(("gripper", "cube"),), t_end_ns=10),
            Stage(id="place", text="Place.", t_start_ns=10, t_end_ns=20),
        ),
        "tau": (Waypoint(t_ns=0, p_m=(0.0, 0.0, 0.1), q_wxyz=(1.0, 0.0, 0.0, 0.0), g=0),),
    }
    fields.update(changes)
    return Plan(**fields)  # type: ignore[arg-type]


@given(st.lists(waypoints, min_size=1, max_size=4))
def test_a_plan_survives_the_round_trip(tau: list[Waypoint]) -> None:
    original = plan(tau=tuple(tau))
    assert Plan.from_json(original.to_json()) == original


@pytest.mark.parametrize("key", ["robot", "p_m", "t_ns"])
def test_a_plan_that_says_a_thing_twice_is_refused_with_its_name(key: str) -> None:
    text = plan().to_json().decode()
    for twice in (f'"{key}":1,"{key}":', f'"{key}":1,"{key}":2,"{key}":'):
        with pytest.raises(InvalidRecordError, match=f"'{key}' is there twice"):
            Plan.from_json(text.replace(f'"{key}":', twice, 1).encode())


def test_what_plans_had_not_from_the_beginning_is_written_only_where_it_says_something() -> None:
    old = json.loads(plan().to_json())
    later = {"task_sha256", "scene_hash", "candidate", "steered_by", "study_arm"}
    assert not later & set(old)
    digest = hashlib.sha256(plan().to_json()).hexdigest()
    assert (
        digest == "7fcd81beb0179381843e84d7424ba2e1325c448725e79ade890c82a34c22df7f"
    )  # of what was written before there were such fields
    new = plan(
        task_sha256="0" * 64,
        scene_hash="abc",
        candidate=Ranking(rank=1, cost=0.25, seed=7),
        steered_by=SteeredBy(clause="terminal.inside", bodies=("cube", "box")),
        study_arm="control",
    )
    record = json.loads(new.to_json())
    assert later <= set(record)
    assert Plan.from_json(new.to_json()) == new
    record["study_arm"] = "right"
    with pytest.raises(InvalidRecordError, match="study_arm"):
        Plan.from_json(json.dumps(record).encode())


def test_a_plan_without_waypoints_is_refused() -> None:
    with pytest.raises(InvalidRecordError, match="tau"):
        plan(tau=()).to_json()


def test_a_newer_plan_version_is_refused_and_says_so() -> None:
    record = json.loads(plan().to_json())
    record["schema_version"] = 2
    with pytest.raises(InvalidRecordError, match="newer"):
        Plan.from_json(json.dumps(record).encode())


@pytest.mark.parametrize("data", [b"", b"[]", b"nonsense", b"\xff\xfe"])
def test_what_is_no_json_object_is_refused(data: bytes) -> None:
    with pytest.raises(InvalidRecordError, match=r"not (JSON|a JSON object)"):
        Plan.from_json(data)


def test_a_wrong_gripper_command_is_named_by_its_place() -> None:
    record = json.loads(plan().to_json())
    record["tau"][0]["g"] = 2
    with pytest.raises(InvalidRecordError, match="tau/0/g"):
        Plan.from_json(json.dumps(record).encode())


def test_the_stage_of_an_instant_is_found() -> None:
    stages = [plan().stage_at(t) for t in (0, 9, 10, 19, 50)]
    assert [stage.id if stage else None for stage in stages] == [
        "grasp",
        "grasp",
        "place",
        "place",
        "place",
    ]


POSE = se3.pose_record(
    se3.transform_from(np.array([0.92, 0, 0, 0.39]), np.array([0.5, -0.15, 0.02]))
)
PLAN = plan_of(
    "plan_0",
    policy="nominal",
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
