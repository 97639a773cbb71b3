"""A planner that shares the gate's perception: plans from its record, or says why it has none."""

import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from bridge.geometry import se3
from bridge.sources.standin.cell import CellConfig, StandinCell
from bridge.sources.standin.cell_file import CellFile, draw_hidden
from bridge.sources.standin.gate_sight import GateSight
from bridge.sources.standin.operator import Operator
from bridge.sources.standin.settings import SessionConfig
from bridge.sources.standin.streams import Streams
from bridge.task.plan import Plan
from bridge.task.task_file import Task, load_task
from bridge.wire.errors import NoReplyError

SEED = 9_000_000


@pytest.fixture(scope="module")
def push() -> Task:
    return load_task("push_cube_to_mark")


def record(object_id: str, T: np.ndarray | None) -> dict[str, Any]:
    return {
        "schema_version": 1,
        "stamp_ns": 5,
        "object": object_id,
        "found": T is not None,
        "T_base_object": None if T is None else se3.pose_record(T),
        "covariance": None,
        "symmetry": "cube",
        "confidence": 1.0 if T is not None else 0.0,
        "method": "test",
        "reason": None if T is not None else "behind the arm",
    }


def answer(found: bool | None, reason: str | None = None, *objects: dict[str, Any]) -> bytes:
    reply = {"schema_version": 1, "stamp_ns": 5, "found": found, "reason": reason}
    return json.dumps({**reply, "objects": list(objects)}).encode()


def session_with(make_session: Callable[..., Any], reply: bytes | None) -> Any:
    """A wire whose gate answers where the objects are, or does not."""

    class Sees(make_session):  # type: ignore[misc]
        def query(self, key: str, payload: bytes, *, timeout_s: float) -> bytes:
            if key == "lab/gate/localise":
                self.asked.append(json.loads(payload)["task"])
                if reply is None:
                    raise NoReplyError(key=key, timeout_s=timeout_s)
                return reply
            return bytes(super().query(key, payload, timeout_s=timeout_s))

    return Sees()


def trial(lab: CellFile, task: Task, session: Any, **settings: Any) -> Any:
    """One trial without replanning, and the plans it published."""
    cell = StandinCell(
        lab,
        task,
        replace(draw_hidden(lab, SEED, task), latency_s=0.0),
        Streams(session, "lab"),
        config=CellConfig(rate_hz=0.0),
        seed=SEED,
        start_ns=0,
    )
    values = {"trials": 1, "conditions": ("without_replanning",), "scan": False, **settings}
    operator = Operator(cell, session, SessionConfig(cell="lab", seed=9000, **values))
    operator.trials()
    return operator.results[0][1], [Plan.from_json(item.data) for item in session.of("/lab/plan")]


@pytest.mark.usefixtures("unchecked")
def test_the_plan_is_made_from_the_gates_record_and_nothing_else(
    lab: CellFile, push: Task, make_session: Callable[..., Any]
) -> None:
    """The gate is 100 mm wrong here: so is the plan, and its cube stays where it is."""
    told = push.draw_start(np.random.default_rng(SEED))["cube"]
    told[0, 3] += 0.10
    session = session_with(make_session, answer(True, None, record("cube", told)))
    outcome, (plan,) = trial(lab, push, session)
    assert session.asked == ["push_cube_to_mark"]
    assert plan.grounding_source == "gst localisation v1 of the gate"
    assert plan.keypoints_m[0] == pytest.approx(told[:3, 3])
    assert outcome.result == "failure"
    assert "moved 0 mm" in outcome.detail


@pytest.mark.parametrize("reply", [None, b"nonsense", answer(None, "no usable frames")])
def test_without_a_look_the_trial_is_void(
    lab: CellFile, push: Task, make_session: Callable[..., Any], reply: bytes | None
) -> None:
    outcome, plans = trial(lab, push, session_with(make_session, reply))
    assert plans == []
    assert outcome.result == "unknown"
    assert "nothing executed, no localisation (" in outcome.detail


def test_an_object_that_is_not_found_is_a_failure_to_plan(
    lab: CellFile, push: Task, make_session: Callable[..., Any]
) -> None:
    reply = answer(False, "cube: behind the arm", record("cube", None))
    outcome, plans = trial(lab, push, session_with(make_session, reply))
    assert plans == []
    assert outcome.result == "failure"
    assert "nothing executed, object not found: cube: behind the arm" in outcome.detail


def test_what_the_gate_may_answer_is_read_with_three_values(push: Task) -> None:
    T = push.draw_start(np.random.default_rng(SEED))["cube"]
    good = GateSight.from_json(answer(True, None, record("cube", T)), push)
    assert se3.pose_from_record(good.records[0]["T_base_object"]) == pytest.approx(T)
    broken = [
        b"",
        b"[]",
        b"{}",
        answer(True, None),
        answer(True, None, record("mug", T)),
        answer(True, None, record("cube", None)),
        answer(True, None, record("cube", T)).replace(b'"p_m": [', b'"p_m": [1e999, '),
    ]
    for data in broken:
        assert GateSight.from_json(data, push).found is None, data
    assert GateSight.from_json(answer(False, "x"), push).found is False
