"""The gate as a service of a cell: what it answers, publishes and subscribes, and how it ends."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import pytest
from gate_fakes import PLAN, FakePerception, gate_with

from bridge.errors import InvalidRecordError
from bridge.task.verdict import Verdict
from bridge.terminal import Output
from twin.gate.config import GateConfig
from twin.gate.service import serve_gate, watch_cell


@dataclass
class FakeSession:
    published: list[tuple[str, bytes, int]] = field(default_factory=list)
    services: dict[str, Callable[[bytes], bytes]] = field(default_factory=dict)
    subscriptions: dict[str, Callable[[Any], None]] = field(default_factory=dict)

    def now_ns(self) -> int:
        return 7

    def publisher(self, topic: str, type_name: str) -> Any:
        def put(data: bytes, *, source_ns: int) -> None:
            self.published.append((topic, data, source_ns))

        return SimpleNamespace(put=put)

    def serve(self, key: str, handler: Callable[[bytes], bytes], *, side_by_side: int) -> None:
        self.services[key] = handler

    def subscribe(self, key: str, callback: Callable[[Any], None]) -> None:
        self.subscriptions[key] = callback


def test_the_service_answers_and_publishes_with_the_cells_own_time() -> None:
    session = FakeSession()
    serve_gate(session, gate_with(), FakePerception(), GateConfig(), Output(quiet=True))
    answer = session.services["standin/gate/verdict"](PLAN.to_json())
    assert Verdict.from_json(answer).accepted is True
    assert session.published == [("/standin/verdict", answer, 42)]


def test_an_id_from_the_network_does_not_move_the_cursor(
    capsys: pytest.CaptureFixture[str],
) -> None:
    session, plan = FakeSession(), replace(PLAN, id="plan\x1b[2J\x1b[31m")
    serve_gate(session, gate_with(), FakePerception(), GateConfig(), Output())
    session.services["standin/gate/verdict"](plan.to_json())
    said = capsys.readouterr().err
    assert "\x1b" not in said
    assert "plan?[2J?[31m: accepted" in said


def test_a_malformed_plan_is_not_published() -> None:
    session = FakeSession()
    serve_gate(session, gate_with(), FakePerception(), GateConfig(), Output(quiet=True))
    with pytest.raises(InvalidRecordError):
        session.services["standin/gate/verdict"](b"nonsense")
    assert session.published == []


def test_only_cameras_events_joints_and_transforms_are_subscribed() -> None:
    session, taken = FakeSession(), []
    watch_cell(session, "standin", lambda *item: taken.append(item))
    assert sorted(session.subscriptions) == [
        "robot_description",
        "standin/cam/**",
        "standin/event",
        "standin/joint_states",
        "tf",
        "tf_static",
    ]
    sample = SimpleNamespace(topic="/tf", data=b"x", received_ns=3, type_name="t")
    session.subscriptions["tf"](sample)
    assert taken == [("/tf", b"x", 3, "t")]
