"""Fakes for perception, localisation and replay, and a gate between them."""

from collections.abc import Callable
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
from small_plans import plan_of
from verdicts import verdict_of

from bridge.robots.default import ARM_JOINTS
from bridge.task.find import chosen_task_file
from bridge.task.plan import Plan
from bridge.task.verdict import Verdict
from twin.gate.config import GateConfig
from twin.gate.gate import Gate, JudgedTasks

TASK_FILE = chosen_task_file("cube_into_box")
TASK = TASK_FILE.task()
URDF = '<?xml version="1.0"?><robot xmlns:x="y" name="ur5_parallel_gripper"><link/></robot>'
PLAN = plan_of("plan_1", robot="ur5_parallel_gripper", task="cube_into_box")
JUDGED = JudgedTasks(only=TASK_FILE)
HOME = SimpleNamespace(names=ARM_JOINTS, position=np.zeros(6), stamp_ns=42, received_ns=1)


@dataclass
class FakePerception:
    description: str | None = URDF
    running: str | None = None
    heard: int = 1
    arm: Any = field(default_factory=lambda: HOME)
    seen: list[Any] = field(default_factory=lambda: [SimpleNamespace(stamp_ns=1)])
    reasons: list[str] = field(default_factory=lambda: ["side: silent for 9.0 s"])

    def urdf(self) -> str | None:
        return self.description

    def joints(self) -> Any:
        return self.arm and (self.arm, self.arm.received_ns)

    def executing(self) -> str | None:
        return self.running

    def newest_ns(self) -> int:
        return 42

    def heard_ns(self) -> int:
        return self.heard

    def frames(self, **_: Any) -> Any:
        return SimpleNamespace(frames=self.seen, reasons=self.reasons)


def found(**missing: str) -> dict[str, Any]:
    return {
        name: SimpleNamespace(
            found=name not in missing, reason=missing.get(name), T_base_object=np.eye(4)
        )
        for name in TASK.objects
    }


def accept(plan: Plan, *_: Any) -> Verdict:
    return verdict_of(plan.id, engine="fake 1")


def gate_with(
    perception: FakePerception | None = None,
    localise: Callable[..., Any] = lambda *_: found(),
    replay: Callable[..., Verdict] = accept,
    now_ns: Callable[[], int] = lambda: 0,
    tasks: JudgedTasks = JUDGED,
    judged_in: Callable[[], dict[str, str | None]] = dict,
    **settings: Any,
) -> Gate:
    config = GateConfig(**{"deadline_s": 5.0, "frame_wait_s": 0.0, **settings})
    return Gate(
        tasks=tasks,
        config=config,
        perception=perception or FakePerception(),
        localise=localise,
        replay=replay,
        now_ns=now_ns,
        judged_in=judged_in,
    )


def raising(error: Exception) -> Callable[..., Any]:
    def call(*_: Any) -> Any:
        raise error

    return call


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

    def serve(self, key: str, handler: Callable[[bytes], bytes], *, side_by_side: int = 1) -> None:
        self.services[key] = handler

    def follow(self, topic: str, callback: Callable[[Any], None]) -> None:
        self.subscriptions[topic] = callback
