"""The gate's scorecard clause by clause, out of what the verdicts' predicates said."""

from dataclasses import replace
from typing import Any

import pytest

from bridge.task.verdict import Factor, Verdict
from evaluator.compare.gate import clause_scorecard, gate_scorecard
from evaluator.compare.rows import TrialRow
from evaluator.report.views import view
from evaluator.run_reader.episodes import clauses_of

WITHOUT = "without_replanning"


def finding(kind: str, value: bool | None, thing: str = "cube", side: str = "replayed") -> Any:
    return {"side": side, "kind": kind, "object": thing, "value": value, "detail": ""}


def verdict(*findings: Any, clearance: bool | None = True, terminal: bool | None = True) -> Verdict:
    return Verdict(
        plan_id="p",
        trajectory="planned",
        mode="dynamic",
        ik=Factor(value=True),
        clearance=Factor(value=clearance),
        terminal=Factor(value=terminal),
        engine="test",
        seed=1,
        findings=findings,
    )


def row(number: int, recorded: bool | None, said: Verdict | None, **changes: Any) -> TrialRow:
    return TrialRow(
        episode=f"t{number}",
        task="cube_into_box",
        condition=WITHOUT,
        policy="scripted",
        start_id=None,
        cell="standin",
        stand_in=True,
        recorded=recorded,
        verdict=None if said is None else said.accepted,
        gate_clauses=clauses_of(said),
        **changes,
    )


def test_a_clause_says_no_when_one_object_fails_it_and_nothing_while_it_is_open() -> None:
    said = verdict(
        finding("inside", True, "cube"),
        finding("inside", False, "duck"),
        finding("settled", True, "cube"),
        finding("settled", None, "duck"),
        finding("inside", True, side="recorded"),
        terminal=False,
        clearance=None,
    )
    assert dict(clauses_of(said)) == {"ik": True, "terminal": False, "terminal.inside": False}
    assert clauses_of(None) == ()


def test_each_clause_is_judged_by_the_trials_in_which_it_was_decided() -> None:
    bad_inside = verdict(finding("inside", False), finding("settled", True), terminal=False)
    bad_both = verdict(finding("inside", False), finding("settled", False), terminal=False)
    good = verdict(finding("inside", True), finding("settled", True))
    collides = verdict(clearance=False, terminal=None)
    rows = [
        row(1, False, bad_inside),
        row(2, True, bad_inside),
        row(3, False, bad_both),
        row(4, True, good),
        row(5, False, good),
        row(6, False, collides),
        row(7, None, bad_both),  # nobody said how it ended: part of nothing
    ]
    measurements, tables = gate_scorecard(rows)
    by_id = {m.id: m for m in measurements}
    inside = by_id["gate.clause.verdict.terminal_inside.right"]
    assert (inside.k, inside.n) == (2, 3)
    assert inside.interval is not None
    assert inside.episodes == ("t1", "t2", "t3")
    refused = by_id["gate.clause.verdict.terminal_inside.refused"]
    assert (refused.k, refused.n) == (3, 5)  # in the sixth the simulation never got that far
    settled = by_id["gate.clause.verdict.terminal_settled.right"]
    assert (settled.k, settled.n) == (1, 1)
    clearance = by_id["gate.clause.verdict.clearance.right"]
    assert (clearance.k, clearance.n) == (1, 1)
    never = by_id["gate.clause.verdict.ik.right"]
    assert never.value is None
    assert "ik never said no" in str(never.reason_if_undefined)
    lines = {line[1]: line for line in next(t for t in tables if t.id == "gate_clauses").rows}
    assert lines["terminal.inside"][2:5] == (5, 3, 2)
    assert lines["terminal.inside"][8] == 1  # a good plan refused
    assert lines["terminal.inside"][-1] == 2  # two bad executions avoided for it
    assert lines["terminal.settled"][-1] is None
    assert lines["ik"][-1] is None
    shown = {line[1]: line for line in view(next(t for t in tables if t.id == "gate_clauses")).rows}
    assert str(shown["terminal.inside"][5]).startswith("2/3 = 67 % [")
    assert shown["terminal.settled"][-1] == "any"
    assert shown["ik"][-1] is None


def test_obeying_one_clause_costs_what_counting_says() -> None:
    bad = verdict(finding("inside", False), terminal=False)
    good = verdict(finding("inside", True))
    rows = [row(1, False, bad), row(2, True, bad), row(3, False, good), row(4, True, good)]
    _, tables = gate_scorecard(rows)
    costs = {r[0]: r[1:] for r in next(t for t in tables if t.id == "gate_clause_costs").rows}
    # One bad plan let through and one good one refused at prices 0.1, 0.5, 1; two bad in all.
    assert costs["terminal.inside"] == (0.275, 0.375, 0.5, 0.5)
    assert costs["ik"] == (0.5, 0.5, 0.5, 0.5)


def test_the_planned_replay_is_judged_apart_and_weights_count() -> None:
    planned = clauses_of(verdict(clearance=False, terminal=None))
    rows = [replace(row(1, False, None), clauses=planned, count=3, sim_planned=False)]
    measurements, tables = clause_scorecard(rows, [])
    right = next(m for m in measurements if m.id == "gate.clause.planned.clearance.right")
    assert (right.k, right.n) == (3, 3)
    assert [table.id for table in tables] == ["gate_clauses"]


def test_without_verdicts_there_is_nothing_to_judge() -> None:
    assert clause_scorecard([row(1, True, None)], []) == ([], ())


@pytest.mark.parametrize("condition", ["with_replanning"])
def test_verdicts_that_were_obeyed_price_nothing(condition: str) -> None:
    bad = verdict(finding("inside", False), terminal=False)
    _, tables = gate_scorecard([replace(row(1, False, bad), condition=condition)])
    assert tables == ()
