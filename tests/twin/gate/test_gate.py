"""The gate with fakes for eyes, localisation and replay: undecided is never yes."""

import json
import os
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bridge.episode.run import RunFolder
from bridge.errors import InvalidRecordError
from bridge.task.plan import Plan, Stage, Waypoint
from bridge.task.task_file import load_task
from bridge.task.verdict import Factor, Verdict
from bridge.terminal import Output, stop_signals
from bridge.wire.errors import WireConfigError
from twin.errors import TwinError
from twin.gate.config import GateConfig
from twin.gate.judge import Gate, PlanTooLargeError, no_verdict, robot_name
from twin.gate.service import GateError, run_gate, serve_gate, watch_cell

TASK = load_task("cube_into_box")
URDF = '<?xml version="1.0"?><robot xmlns:x="y" name="ur5_parallel_gripper"><link/></robot>'
PLAN = Plan(
    id="plan_1",
    planner="scripted",
    policy="scripted",
    condition="without_replanning",
    robot="ur5_parallel_gripper",
    frame="base_link",
    instruction="Put the red cube into the box.",
    task="cube_into_box",
    stages=(Stage(id="grasp", text="Grasp the cube."),),
    tau=(Waypoint(t_ns=0, p_m=(0.4, 0.0, 0.3), q_wxyz=(1.0, 0.0, 0.0, 0.0), g=0),),
)


@dataclass
class FakeEyes:
    description: str | None = URDF
    running: str | None = None
    heard: int = 1
    seen: list[Any] = field(default_factory=lambda: [SimpleNamespace(stamp_ns=1)])
    reasons: list[str] = field(default_factory=lambda: ["side: silent for 9.0 s"])

    def urdf(self) -> str | None:
        return self.description

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
    yes = Factor(value=True)
    return Verdict(
        plan_id=plan.id,
        trajectory="planned",
        mode="dynamic",
        ik=yes,
        clearance=yes,
        terminal=yes,
        engine="fake 1",
        seed=0,
    )


def gate_with(
    eyes: FakeEyes | None = None,
    localise: Callable[..., Any] = lambda *_: found(),
    replay: Callable[..., Verdict] = accept,
    now_ns: Callable[[], int] = lambda: 0,
    **settings: Any,
) -> Gate:
    config = GateConfig(**{"deadline_s": 5.0, "frame_wait_s": 0.0, **settings})
    return Gate(
        task=TASK,
        config=config,
        eyes=eyes or FakeEyes(),
        localise=localise,
        replay=replay,
        now_ns=now_ns,
    )


def test_the_verdict_is_the_replays_from_the_localised_poses() -> None:
    seen: dict[str, Any] = {}

    def replay(plan: Plan, poses: dict[str, Any], urdf: str, ends_s: float) -> Verdict:
        seen.update(plan=plan, poses=poses, urdf=urdf)
        return replace(accept(plan, poses, urdf), terminal=Factor(value=False, cause="inside"))

    verdict = gate_with(replay=replay).judge(PLAN.to_json())
    assert verdict.accepted is False
    assert verdict.first_failing == "terminal"
    assert seen["plan"] == PLAN
    assert sorted(seen["poses"]) == ["box", "cube"]
    assert seen["urdf"] == URDF


def test_a_task_with_soft_objects_is_replayed_like_any_other() -> None:
    task = load_task("sloth_into_basket")
    there = {
        name: SimpleNamespace(found=True, reason=None, T_base_object=np.eye(4))
        for name in task.objects
    }
    gate = Gate(
        task=task,
        config=GateConfig(deadline_s=5.0, frame_wait_s=0.0),
        eyes=FakeEyes(),
        localise=lambda *_: there,
        replay=accept,
        now_ns=lambda: 0,
    )
    assert gate.judge(replace(PLAN, task="sloth_into_basket").to_json()).accepted is True


def test_an_accepted_plan_is_accepted() -> None:
    assert gate_with().judge(PLAN.to_json()).accepted is True


def raising(error: Exception) -> Callable[..., Any]:
    def call(*_: Any) -> Any:
        raise error

    return call


@pytest.mark.parametrize(
    ("settings", "plan", "reason"),
    [
        ({"eyes": FakeEyes(seen=[])}, PLAN, "no usable frames: side: silent for 9.0 s"),
        ({"eyes": FakeEyes(description=None)}, PLAN, "no robot description"),
        ({"eyes": FakeEyes(running="plan_0")}, PLAN, "plan_0 is being executed"),
        (
            {"localise": lambda *_: found(cube="0 points")},
            PLAN,
            "not every object was found: cube (0 points)",
        ),
        ({"replay": raising(TwinError("no waypoints"))}, PLAN, "no waypoints"),
        ({}, replace(PLAN, frame="world"), "is given in frame 'world'"),
        ({}, replace(PLAN, robot="panda"), "for robot 'panda'; the cell's robot is 'ur5"),
        ({}, replace(PLAN, task="fold_towel"), "for task 'fold_towel'; this gate judges"),
    ],
)
def test_what_cannot_be_decided_is_null_with_a_reason(
    settings: dict[str, Any], plan: Plan, reason: str
) -> None:
    verdict = gate_with(**settings).judge(plan.to_json())
    assert verdict.accepted is None
    assert verdict.plan_id == plan.id
    assert reason in str(verdict.reason)
    assert Verdict.from_json(verdict.to_json()) == verdict


def test_a_cell_not_heard_for_long_is_not_judged_from_memory_however_often_one_asks() -> None:
    gate = gate_with(now_ns=lambda: 100_000_000_000)
    for _ in range(3):
        verdict = gate.judge(PLAN.to_json())
        assert verdict.accepted is None
        assert "nothing has arrived from the cell for 100 s" in str(verdict.reason)


def test_a_cell_that_stands_still_while_it_waits_for_a_verdict_is_not_silent() -> None:
    """Each verdict takes 60 s, the cell asks again 1 s later: 1 s of silence, then 2."""
    clock = iter([1_000_000_000, 61_000_000_000, 62_000_000_000, 122_000_000_000, 200_000_000_000])
    gate = gate_with(FakeEyes(heard=0), now_ns=lambda: next(clock))
    assert gate.judge(PLAN.to_json()).accepted is True
    assert gate.judge(PLAN.to_json()).accepted is True
    assert "for 80 s" in str(gate.judge(PLAN.to_json()).reason)


def test_a_bug_in_the_replay_is_null_and_not_silence(capsys: pytest.CaptureFixture[str]) -> None:
    verdict = gate_with(replay=raising(ZeroDivisionError("oops"))).judge(PLAN.to_json())
    assert verdict.accepted is None
    assert verdict.reason == "internal error: ZeroDivisionError: oops"
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.parametrize("payload", [b"", b"{", b"[]", b"\xff\xfe", b'{"schema_version": 1}'])
def test_a_malformed_plan_is_an_error_with_the_sentence(payload: bytes) -> None:
    with pytest.raises(InvalidRecordError, match="plan is invalid"):
        gate_with().judge(payload)


def test_a_plan_of_a_newer_version_is_an_error() -> None:
    record = json.loads(PLAN.to_json())
    record["schema_version"] = 99
    with pytest.raises(InvalidRecordError, match="newer"):
        gate_with().judge(json.dumps(record).encode())


def test_a_payload_that_is_too_large_is_not_even_read() -> None:
    """A hundred megabytes of JSON would keep all other answers waiting while they are parsed."""
    payload = b" " * (100 * 10**6)
    started = time.monotonic()
    with pytest.raises(PlanTooLargeError, match=r"100 MB is not read as a plan; at most 32 MB are"):
        gate_with().judge(payload)
    assert time.monotonic() - started < 0.5


def test_reading_a_plan_counts_towards_its_deadline(monkeypatch: pytest.MonkeyPatch) -> None:
    def slowly(payload: bytes) -> Plan:
        time.sleep(0.3)
        return PLAN

    monkeypatch.setattr(Plan, "from_json", staticmethod(slowly))
    verdict = gate_with(deadline_s=0.2).judge(b"a plan")
    assert verdict.accepted is None
    assert "at the deadline of 0.2 s" in str(verdict.reason)


def test_a_replay_past_the_deadline_is_null_and_the_next_plan_waits_for_its_turn() -> None:
    go_on = threading.Event()

    def slow(plan: Plan, poses: dict[str, Any], urdf: str, ends_s: float) -> Verdict:
        go_on.wait(5)
        return accept(plan, poses, urdf)

    gate = gate_with(replay=slow, deadline_s=0.05)
    started = time.monotonic()
    late = gate.judge(PLAN.to_json())
    assert time.monotonic() - started < 2.0
    assert late.accepted is None
    assert "not done at the deadline of 0.05 s" in str(late.reason)
    next_one = gate.judge(PLAN.to_json())
    assert next_one.accepted is None
    assert "an earlier plan was still being judged" in str(next_one.reason)
    go_on.set()


def test_more_plans_than_may_wait_are_turned_away_at_once() -> None:
    inside, go_on = threading.Semaphore(0), threading.Event()

    def slow(plan: Plan, poses: dict[str, Any], urdf: str, ends_s: float) -> Verdict:
        inside.release()
        go_on.wait(5)
        return accept(plan, poses, urdf)

    gate = gate_with(replay=slow, waiting=1)
    answers: list[Verdict] = []
    threads = [
        threading.Thread(target=lambda: answers.append(gate.judge(PLAN.to_json())))
        for _ in range(2)
    ]
    threads[0].start()
    assert inside.acquire(timeout=5)
    threads[1].start()
    while gate._inside < 2:
        threading.Event().wait(0.005)
    turned_away = gate.judge(PLAN.to_json())
    assert turned_away.accepted is None
    assert "ask later" in str(turned_away.reason)
    go_on.set()
    for thread in threads:
        thread.join(5)
    assert [verdict.accepted for verdict in answers] == [True, True]


def test_no_two_replays_ever_run_side_by_side() -> None:
    """Robot models are shared and keep scratch memory; late replays go on and hold the turn."""
    counting, running, most, done = threading.Lock(), 0, 0, 0

    def slow(plan: Plan, poses: dict[str, Any], urdf: str, ends_s: float) -> Verdict:
        nonlocal running, most, done
        with counting:
            running += 1
            most = max(most, running)
        time.sleep(0.06)
        with counting:
            running -= 1
            done += 1
        return accept(plan, poses, urdf)

    gate = gate_with(replay=slow, deadline_s=0.04, waiting=8)
    threads = [threading.Thread(target=gate.judge, args=(PLAN.to_json(),)) for _ in range(8)]
    for thread in threads:
        thread.start()
        time.sleep(0.02)
    for thread in threads:
        thread.join(5)
    assert gate._turn.acquire(timeout=5)
    assert done >= 2
    assert most == 1


def test_a_thread_that_cannot_be_started_does_not_block_the_next_plan(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    gate = gate_with()
    with monkeypatch.context() as patched:
        patched.setattr(threading.Thread, "start", raising(RuntimeError("can't start new thread")))
        refused = gate.judge(PLAN.to_json())
    assert refused.accepted is None
    assert "no thread" in str(refused.reason)
    assert gate.judge(PLAN.to_json()).accepted is True


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
    serve_gate(session, gate_with(), FakeEyes(), GateConfig(), Output(quiet=True))
    answer = session.services["standin/gate/verdict"](PLAN.to_json())
    assert Verdict.from_json(answer).accepted is True
    assert session.published == [("/standin/verdict", answer, 42)]


def test_an_id_from_the_network_does_not_move_the_cursor(
    capsys: pytest.CaptureFixture[str],
) -> None:
    session, plan = FakeSession(), replace(PLAN, id="plan\x1b[2J\x1b[31m")
    serve_gate(session, gate_with(), FakeEyes(), GateConfig(), Output())
    session.services["standin/gate/verdict"](plan.to_json())
    said = capsys.readouterr().err
    assert "\x1b" not in said
    assert "plan?[2J?[31m: accepted" in said


def test_a_malformed_plan_is_not_published() -> None:
    session = FakeSession()
    serve_gate(session, gate_with(), FakeEyes(), GateConfig(), Output(quiet=True))
    with pytest.raises(InvalidRecordError):
        session.services["standin/gate/verdict"](b"nonsense")
    assert session.published == []


def test_only_cameras_events_and_transforms_are_subscribed() -> None:
    session, taken = FakeSession(), []
    watch_cell(session, "standin", lambda *item: taken.append(item))
    assert sorted(session.subscriptions) == [
        "robot_description",
        "standin/cam/**",
        "standin/event",
        "tf",
        "tf_static",
    ]
    sample = SimpleNamespace(topic="/tf", data=b"x", received_ns=3, type_name="t")
    session.subscriptions["tf"](sample)
    assert taken == [("/tf", b"x", 3, "t")]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_stop_signals_set_the_event_and_give_the_handlers_back(number: int) -> None:
    before = signal.getsignal(number)
    with stop_signals() as stopped:
        os.kill(os.getpid(), number)
        assert stopped.wait(2)
    assert signal.getsignal(number) is before


def test_a_cell_name_that_is_no_name_is_refused(tmp_path: Any) -> None:
    with pytest.raises(GateError, match="not usable"):
        run_gate(tmp_path, GateConfig(cell="**"), Output(quiet=True))


@pytest.mark.parametrize(
    ("urdf", "name"), [(URDF, "ur5_parallel_gripper"), ("<robot name='a b'/>", "a b"), ("", "")]
)
def test_the_robot_name_is_read_from_the_urdf(urdf: str, name: str) -> None:
    assert robot_name(urdf) == name


def test_no_verdict_is_never_a_yes() -> None:
    verdict = no_verdict(PLAN, "because")
    assert verdict.accepted is None
    assert verdict.reason == "because"


def test_a_zenoh_configuration_is_used(tmp_path: Any) -> None:
    run = RunFolder.create(tmp_path / "run")
    config = GateConfig(zenoh_config=tmp_path / "missing.json5")
    with pytest.raises(WireConfigError, match=r"missing\.json5 cannot be read"):
        run_gate(run.path, config, Output(quiet=True))
