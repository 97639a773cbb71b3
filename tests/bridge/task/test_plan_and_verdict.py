"""Plans and verdicts: round trips, refusals, and the three-valued product."""

import hashlib
import json

import pytest
from hypothesis import given
from hypothesis import strategies as st
from verdicts import verdict_of

from bridge.errors import InvalidRecordError
from bridge.task.plan import Plan, Ranking, Stage, SteeredBy, Waypoint
from bridge.task.verdict import Factor, Verdict

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


def verdict(ik: bool | None, clearance: bool | None, terminal: bool | None) -> Verdict:
    close = Factor(value=clearance, first_t_ns=5, bodies=("wrist", "table"))
    return verdict_of("p1", ik=ik, clearance=close, terminal=terminal, engine="pybullet")


values = st.sampled_from([True, False, None])


@given(values, values, values)
def test_acceptance_is_the_three_valued_product(
    ik: bool | None, clearance: bool | None, terminal: bool | None
) -> None:
    factors = (ik, clearance, terminal)
    accepted = verdict(*factors).accepted
    if False in factors:
        assert accepted is False
    elif None in factors:
        assert accepted is None
    else:
        assert accepted is True


@given(values, values, values)
def test_a_verdict_survives_the_round_trip(
    ik: bool | None, clearance: bool | None, terminal: bool | None
) -> None:
    original = verdict(ik, clearance, terminal)
    assert Verdict.from_json(original.to_json()) == original


def test_the_first_failing_factor_is_named_in_order() -> None:
    assert verdict(True, False, False).first_failing == "clearance"
    assert verdict(True, None, True).first_failing is None
