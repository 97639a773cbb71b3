"""The gate says where the objects are: three values, bounded, and the same eyes as its verdicts."""

import json
import threading
from typing import Any

import numpy as np
import pytest
from gate_fakes import TASK, FakePerception, FakeSession, gate_with, raising

from bridge.sources.standin.gate_sight import GateSight
from bridge.task.record import parse_record
from bridge.terminal import Output
from twin.errors import TwinError
from twin.gate.config import GateConfig
from twin.gate.gate import Gate
from twin.gate.service import GateError, serve_localisation
from twin.scene.localise.result import LocalisedObject, missing


def localised(**lost: str) -> dict[str, LocalisedObject]:
    """Every object of the fakes' task at the origin, but for those that are lost."""
    return {
        name: missing(model, 1, lost[name], {})
        if name in lost
        else LocalisedObject(
            object_id=name,
            T_base_object=np.eye(4),
            covariance=None,
            confidence=1.0,
            method="test",
            reason=None,
            stamp_ns=1,
        )
        for name, model in TASK.objects.items()
    }


def sees(**lost: str) -> Gate:
    return gate_with(localise=lambda *_: localised(**lost))


def test_what_was_found_is_true_false_or_undecided() -> None:
    everything = sees().localise("cube_into_box")
    assert (everything.found, everything.reason) == (True, None)
    assert {item["object"] for item in everything.records()} == set(TASK.objects)
    lost = sees(cube="hidden by the arm").localise("")
    assert lost.found is False
    assert "cube" in (lost.reason or "")
    assert "hidden by the arm" in (lost.reason or "")
    assert len(lost.records()) == len(TASK.objects)


@pytest.mark.parametrize(
    ("gate", "task", "words"),
    [
        (sees(), "sloth_into_basket", "this gate judges 'cube_into_box'"),
        (gate_with(FakePerception(running="plan_7")), "", "plan_7 is being executed"),
        (gate_with(FakePerception(seen=[])), "", "no usable frames"),
        (gate_with(now_ns=lambda: 10**12), "", "nothing has arrived from the cell for 1000 s"),
        (gate_with(localise=raising(TwinError("it hung"))), "", "it hung"),
    ],
)
def test_nobody_could_look(gate: Gate, task: str, words: str) -> None:
    located = gate.localise(task)
    assert located.found is None
    assert words in (located.reason or "")
    assert located.records() == []


def test_a_look_waits_no_longer_than_the_deadline_for_a_plan_that_is_judged() -> None:
    judging, done = threading.Event(), threading.Event()

    def slowly(*_: Any) -> dict[str, LocalisedObject]:
        judging.set()
        assert done.wait(20.0)
        return localised()

    gate = gate_with(localise=slowly, deadline_s=0.2)
    first = threading.Thread(target=gate.localise, args=("",))
    first.start()
    assert judging.wait(20.0)
    assert "up to --deadline" in (gate.localise("").reason or "")
    done.set()
    first.join()
    assert gate.localise("").found is True


def test_the_answer_is_what_is_published_and_what_a_planner_reads() -> None:
    wire = FakeSession()
    serve_localisation(wire, sees(), FakePerception(), GateConfig(cell="lab"), Output(quiet=True))
    answer = wire.services["lab/gate/localise"](b'{"task": "cube_into_box"}')
    records = json.loads(answer)["objects"]
    assert {(topic, stamp_ns) for topic, _, stamp_ns in wire.published} == {
        ("/lab/localisation", 42)
    }
    published = [data for _, data, _ in wire.published]
    assert [dict(parse_record(data, name="localisation")) for data in published] == records
    assert GateSight.from_json(answer, TASK).found is True


@pytest.mark.parametrize("payload", [b"[1]", b"no json", b"\xff", b"[" * 100_000])
def test_another_question_is_refused(payload: bytes) -> None:
    wire = FakeSession()
    serve_localisation(wire, sees(), FakePerception(), GateConfig(), Output(quiet=True))
    with pytest.raises(GateError, match="is JSON"):
        wire.services["standin/gate/localise"](payload)
    assert wire.published == []
