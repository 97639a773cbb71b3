"""Who plans, who decides: planners on the wire, study arms, and what is kept from a planner."""

import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from standin_verdicts import verdict_on

from bridge.episode.metadata import study_arm_of
from bridge.errors import UsageError
from bridge.geometry import se3
from bridge.sources.standin import operator as operating
from bridge.sources.standin.cell import StandinCell
from bridge.sources.standin.decisions import BuiltInPlanner
from bridge.sources.standin.operator import Operator
from bridge.sources.standin.settings import SessionConfig
from bridge.task.find import chosen_task_file
from bridge.task.plan import Plan
from bridge.task.plan_request import PlanAnswer, PlanRequest
from bridge.task.verdict import Factor
from bridge.wire.errors import NoReplyError, RemoteError

FILE = chosen_task_file("cube_into_box")
ARMS = ("without", "with", "control")
Answer = Callable[[PlanRequest], bytes]


@pytest.fixture
def wire(make_session: Callable[..., Any], starts: dict[str, np.ndarray]) -> Callable[..., Any]:
    """A wire with a gate that sees the objects, and a planner, which may fall silent."""

    def make(accepted: bool | None = True, plan: Answer | None = None) -> Any:
        class Wire(make_session):  # type: ignore[misc]
            requests: list[PlanRequest]
            answers: list[bytes]

            def query(self, key: str, payload: bytes, *, timeout_s: float) -> bytes:
                if key == "standin/gate/localise":
                    asked = json.loads(payload)
                    assert asked == {"task": "cube_into_box", "task_sha256": FILE.sha256}
                    records = [
                        {
                            "schema_version": 1,
                            "stamp_ns": 5,
                            "object": name,
                            "found": True,
                            "T_base_object": se3.pose_record(T),
                            "method": "test",
                        }
                        for name, T in starts.items()
                    ]
                    return json.dumps({"found": True, "reason": None, "objects": records}).encode()
                if key == "standin/plan":
                    if plan is None:
                        raise NoReplyError(key=key, timeout_s=timeout_s)
                    self.requests.append(PlanRequest.from_json(payload))
                    self.answers.append(plan(self.requests[-1]))
                    return self.answers[-1]
                return bytes(super().query(key, payload, timeout_s=timeout_s))

        terminal = Factor(value=accepted, cause="slipped", bodies=("cube",))
        session = Wire(gate=lambda plan: verdict_on(plan, terminal))
        session.requests, session.answers = [], []
        return session

    return make


@pytest.fixture
def played(
    make_cell: Callable[..., StandinCell], monkeypatch: pytest.MonkeyPatch
) -> Callable[..., Operator]:
    """One session's trials; what would be executed is noted instead of moved."""

    def play(session: Any, **settings: Any) -> Operator:
        session.executed = []
        monkeypatch.setattr(
            operating, "execute_plan", lambda _, plan: session.executed.append(plan)
        )
        values = {"seed": 9000, "trials": 1, "rate_hz": 0.0, "scan": False, "planner": "wire"}
        config = SessionConfig(**{**values, **settings})
        operator = Operator(make_cell(session), session, config, task_file=FILE)
        operator.trials()
        return operator

    return play


@pytest.fixture
def scripted(make_session: Callable[..., Any], make_cell: Callable[..., StandinCell]) -> Answer:
    """A planner on the wire that plans as the built-in one does."""
    planner = BuiltInPlanner(make_cell(make_session()), "as told")

    def answer(request: PlanRequest) -> bytes:
        found = planner.ask(request)
        assert found.plan is not None
        return PlanAnswer(plan=replace(found.plan, policy=request.policy)).to_json()

    return answer


def outcome(operator: Operator) -> tuple[str, str]:
    ((_, found),) = operator.results
    return found.result, found.detail or ""


def test_a_planner_on_the_wire_is_asked_and_its_accepted_plan_is_executed(
    wire: Callable[..., Any], played: Callable[..., Operator], scripted: Answer
) -> None:
    session = wire(plan=scripted)
    operator = played(session, conditions=("with_replanning",), policy="nominal")
    (request,), (plan,) = session.requests, session.executed
    assert (request.policy, request.seed, request.round) == ("nominal", 9_000_000, 0)
    assert plan.id == "trial_0001.plan_0"
    assert (plan.condition, plan.study_arm, plan.task_sha256) == (
        "with_replanning",
        "",
        FILE.sha256,
    )
    assert operator.results[0][0].policy == "nominal"
    assert [Plan.from_json(item.data) for item in session.of("/plan")] == [plan]


def test_a_refusal_goes_back_to_the_planner_with_the_plan_it_is_about(
    wire: Callable[..., Any], played: Callable[..., Operator], scripted: Answer
) -> None:
    session = wire(accepted=False, plan=scripted)
    played(session, conditions=("with_replanning",), rounds=3)
    assert session.executed == []
    assert [len(request.refused) for request in session.requests] == [0, 1, 2]
    assert [each.plan.id for each in session.requests[2].refused] == session.asked[:2]
    assert all(each.verdict.accepted is False for each in session.requests[2].refused)


def stale(answer: Answer) -> Answer:
    def shifted(request: PlanRequest) -> bytes:
        record = json.loads(answer(request))
        record["entities"]["cube"]["p_m"][0] += 0.02
        return json.dumps(record).encode()

    return shifted


@pytest.mark.parametrize(
    ("bad", "words", "result"),
    [
        (lambda good: None, "no planner answers on standin/plan: nobody answered", "unknown"),
        (lambda good: lambda request: b"nonsense", "with a plan or a reason", "unknown"),
        (stale, "another scene: it has cube 20.000 mm", "failure"),
        (
            lambda good: lambda request: PlanAnswer(reason="out of reach").to_json(),
            "found no plan: out of reach",
            "failure",
        ),
    ],
)
def test_without_a_fitting_plan_nothing_moves_and_the_cell_says_so(
    wire: Callable[..., Any],
    played: Callable[..., Operator],
    scripted: Answer,
    bad: Callable[[Answer], Answer | None],
    words: str,
    result: str,
) -> None:
    session = wire(plan=bad(scripted))
    operator = played(session, conditions=("without_replanning",))
    assert session.executed == []
    assert session.of("/plan") == []
    found, detail = outcome(operator)
    assert found == result
    assert words in detail
    assert any(words in event["text"] for event in session.events() if event["type"] == "note")


def test_a_planner_that_dies_between_two_rounds_stops_the_trial(
    wire: Callable[..., Any], played: Callable[..., Operator], scripted: Answer
) -> None:
    def once(request: PlanRequest) -> bytes:
        if request.round:
            raise RemoteError("gone")
        return scripted(request)

    session = wire(accepted=False, plan=once)
    found, detail = outcome(played(session, conditions=("with_replanning",)))
    assert (session.executed, found) == ([], "unknown")
    assert "no planner answers on standin/plan: gone" in detail


def test_the_first_candidate_of_every_study_arm_is_the_same_to_the_byte(
    wire: Callable[..., Any], played: Callable[..., Operator], scripted: Answer
) -> None:
    """The same localisation record is asked about in each arm, so the answers are one file."""
    session = wire(plan=scripted)
    played(session, study_arms=ARMS, coin=1.0)
    assert len(session.answers) == 3
    assert len(set(session.answers)) == 1
    plans = [Plan.from_json(item.data) for item in session.of("/plan")]
    assert {plan.study_arm for plan in plans} == set(ARMS)
    told = dict.fromkeys(("id", "study_arm", "condition"), "x")
    bare = {
        json.dumps({**json.loads(item.data), **told}, sort_keys=True)
        for item in session.of("/plan")
    }
    assert len(bare) == 1


def test_the_gate_is_asked_in_every_arm_and_obeyed_in_one(
    wire: Callable[..., Any], played: Callable[..., Operator], scripted: Answer
) -> None:
    session = wire(accepted=False, plan=scripted)
    operator = played(session, study_arms=ARMS, coin=0.0, rounds=2)
    by_arm = {info.study_arm: (info, found) for info, found in operator.results}
    executed = {plan.study_arm for plan in session.executed}
    assert executed == {"without"}  # with: all refused; control: the coin never says yes
    rounds = {"without": 1, "with": 2, "control": 2}
    for arm, count in rounds.items():
        mine = [each for each in session.asked if each.startswith(by_arm[arm][0].id)]
        assert len(mine) == count
    assert by_arm["control"][0].condition == "without_replanning"
    assert study_arm_of(by_arm["control"][0].tags) == "control"
    assert [found.result for _, found in by_arm.values()] == ["failure"] * 3
    assert "the coin said no to 2 plans" in (by_arm["control"][1].detail or "")
    control = [r for r in session.requests if r.round == 1 and not r.refused]
    assert len(control) == 1  # nobody looks at verdicts there, so nothing steers


def test_in_a_study_what_is_not_executed_is_a_failure_of_its_arm(
    wire: Callable[..., Any], played: Callable[..., Operator], scripted: Answer
) -> None:
    silent = played(wire(plan=None), study_arms=ARMS, coin=0.5)
    assert [found.result for _, found in silent.results] == ["failure"] * 3
    open_ = played(wire(accepted=None, plan=scripted), study_arms=("with",))
    assert outcome(open_)[0] == "failure"
    assert "nothing executed, no verdict" in outcome(open_)[1]


def test_order_resets_and_coins_follow_from_the_seed_and_differ(
    wire: Callable[..., Any], make_cell: Callable[..., StandinCell], scripted: Answer
) -> None:
    session = wire(plan=scripted)
    config = SessionConfig(
        seed=9000, trials=40, scan=False, planner="wire", study_arms=ARMS, coin=0.4
    )
    operator = Operator(make_cell(session), session, config, task_file=FILE)
    orders = [
        tuple(t.study_arm for _, t in operator._wanted()[3 * k : 3 * k + 3]) for k in range(40)
    ]
    assert all(sorted(order) == sorted(ARMS) for order in orders)
    assert len(set(orders)) == 6  # every order comes up in forty starts
    places = [operator.start_poses(9_000_000, arm)["cube"][:2, 3] for arm in ARMS]
    assert len({tuple(place) for place in places}) == 3


def test_only_missing_trials_of_a_study_are_recorded_again(
    wire: Callable[..., Any], make_cell: Callable[..., StandinCell]
) -> None:
    session = wire()
    there = {
        "start_id": "cube_into_box/9000000",
        "condition": "without_replanning",
        "id": "trial_1",
    }
    session.there = [
        {**there, "policy": "nominal", "tags": ["study_arm:control"]},
        {**there, "policy": "single", "tags": ["study_arm:without"]},
    ]
    config = SessionConfig(
        seed=9000, scan=False, trials=1, planner="wire", study_arms=ARMS, coin=0.4, missing=True
    )
    operator = Operator(make_cell(session), session, config, task_file=FILE)
    assert {t.study_arm for _, t in operator._wanted()} == {"without", "with"}


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"planner": "somebody"}, "There are: built_in, wire"),
        ({"study_arms": ("both",)}, "There are: without, with, control"),
        ({"study_arms": ("control",)}, "needs --coin"),
        ({"coin": 1.5}, "coin"),
    ],
)
def test_settings_of_a_study_are_refused_with_what_there_is(
    settings: dict[str, Any], words: str
) -> None:
    with pytest.raises(UsageError, match=words):
        SessionConfig(**settings)


def test_the_built_in_planner_has_one_policy(
    make_session: Callable[..., Any], make_cell: Callable[..., StandinCell]
) -> None:
    session = make_session()
    with pytest.raises(UsageError, match="--planner wire"):
        Operator(make_cell(session), session, SessionConfig(policy="nominal"), task_file=FILE)
