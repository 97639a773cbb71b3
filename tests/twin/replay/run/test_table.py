"""The tables at the end of a replay: counts, planned and executed against recorded, divergence."""

from typing import Any

from bridge.task.verdict import Factor, Verdict
from twin.replay.job_row import predicates_hold
from twin.replay.summary import (
    EXECUTED,
    PLANNED,
    SEEN,
    against_recorded,
    count_verdicts,
    cross_table,
    describe_run,
    executions_of,
)


def row(episode: str, trajectory: str, accepted: bool | None, **more: Any) -> dict[str, Any]:
    return {
        "episode": episode, "plan": "p", "trajectory": trajectory, "mode": "dynamic",
        "executed": True, "accepted": accepted, "error": None, "reason": "r", "skipped": False,
        **more,
    }  # fmt: skip


APART = {
    "first": {"first_t_ns": 2_340_000_000, "detail": "only as planned in the twin", "attribution":
              "perception"},
    "lag_s": 0.06,
}  # fmt: skip
ROWS = [
    row("a", "planned", True),
    row("a", "executed", True, divergence={"first": None, "lag_s": 0.05}),
    row("a", "executed", None, mode="kinematic", predicates=True),
    row("b", "planned", True),
    row("b", "executed", False, divergence=APART),
    row("c", "planned", False, executed=False),
]
LABELS = {"a": "success", "b": "failure", "c": "unknown"}


def summary() -> dict[str, Any]:
    return {"rows": ROWS, "counts": count_verdicts(ROWS), "executions": executions_of(ROWS, LABELS)}


def test_an_executed_plan_has_one_line_with_every_side() -> None:
    first, second = executions_of(ROWS, LABELS)
    assert (first["recorded"], first["recorded_predicates"]) == ("success", True)
    assert (first["planned"], first["executed"], first["divergence"]) == (True, True, None)
    assert (second["planned"], second["executed"]) == (True, False)
    assert second["divergence"]["attribution"] == "perception"


def test_a_plan_that_was_never_executed_is_in_no_cross_table() -> None:
    table = cross_table(executions_of(ROWS, LABELS))
    assert table[PLANNED]["accepted"] == {"success": 1, "failure": 1, "unknown": 0}
    assert table[EXECUTED]["rejected"] == {"success": 0, "failure": 1, "unknown": 0}
    assert sum(sum(cells.values()) for cells in table[PLANNED].values()) == 2


def test_the_text_holds_the_tables_and_where_things_part() -> None:
    text = describe_run(summary())
    assert "planned dynamic, never executed" in text
    assert "b p: 2.34 s: only as planned in the twin (perception), lag 60 ms" in text
    assert "a p: nowhere, lag 50 ms" in text


def test_what_was_seen_is_held_against_the_label_too() -> None:
    tables = against_recorded(executions_of(ROWS, LABELS))
    assert list(tables) == [""], "rows of one task"
    assert tables[""]["counts"][SEEN]["accepted"] == {"success": 1, "failure": 0, "unknown": 0}
    assert tables[""]["agreement"] == {
        PLANNED: {"k": 1, "n": 2},
        EXECUTED: {"k": 2, "n": 2},
        SEEN: {"k": 1, "n": 1},
    }


def test_every_answer_that_is_no_yes_is_listed_with_its_reason_once() -> None:
    rows = [
        row("a", "planned", None, reason="undecided: cube (hidden)"),
        row("a", "executed", None, mode="kinematic", reason="undecided: no physics"),
        row("b", "planned", False, reason="ik: unreachable"),
        row("c", "planned", None, reason="not evaluated: NaN", error="not evaluated: NaN"),
    ]
    text = describe_run({**summary(), "rows": rows, "counts": count_verdicts(rows)})
    assert "undecided:\n  a p planned dynamic: cube (hidden)\n" in text
    assert "rejected:\n  b p planned dynamic: ik: unreachable\n" in text
    assert "not evaluated:\n  c p planned dynamic: NaN" in text
    assert "no physics" not in text, "said of every kinematic replay"


def seen(*findings: tuple[str, bool | None]) -> Verdict:
    """What a recording says of each predicate."""
    nothing = Factor(value=None)
    return Verdict(
        plan_id="p", trajectory="executed", mode="kinematic", ik=nothing, clearance=nothing,
        terminal=nothing, engine="e", seed=0,
        findings=tuple({"kind": kind, "value": value} for kind, value in findings),
    )  # fmt: skip


def test_what_nobody_found_was_not_seen_to_succeed() -> None:
    contacts = ("allowed_contacts", True)
    assert predicates_hold(seen(("inside", True), ("settled", None), contacts)) is True
    assert predicates_hold(seen(("inside", None), ("settled", None), contacts)) is None
    assert predicates_hold(seen(("inside", True), ("inside", None), contacts)) is None
    assert predicates_hold(seen(("inside", False), ("inside", None), contacts)) is False
    assert predicates_hold(seen(("settled", None))) is None
    assert predicates_hold(seen()) is None
