"""The tables at the end of a replay: counts, planned and executed against recorded, divergence."""

from typing import Any

from verdicts import verdict_of

from bridge.task.verdict import Verdict
from twin.replay.job import predicates_hold
from twin.replay.summary import against_recorded, count_verdicts, describe_run


def row(episode: str, trajectory: str, accepted: bool | None, **more: Any) -> dict[str, Any]:
    return {
        "episode": episode, "plan": "p", "trajectory": trajectory, "mode": "dynamic",
        "executed": True, "task": "t", "accepted": accepted, "predicates": None, "error": None,
        "reason": "r", "skipped": False,
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
    told = against_recorded(ROWS, LABELS)
    return {"rows": ROWS, "counts": count_verdicts(ROWS), "against_recorded": told}


def test_the_text_holds_the_tables_and_where_things_part() -> None:
    text = describe_run(summary())
    assert "planned dynamic, never executed" in text
    assert "b p: 2.34 s: only as planned in the twin (perception), lag 60 ms" in text
    assert "a p: nowhere, lag 50 ms" in text
    told = "planned in twin 1 of 2, executed in twin 2 of 2, executed as seen 1 of 1"
    assert f"t, as the operator's labels say: {told}" in text


def test_what_was_never_executed_labelled_or_decided_is_held_against_nothing() -> None:
    unlabelled = {"a": "success", "b": "unknown"}
    assert against_recorded(ROWS, unlabelled) == {
        "t": {
            "planned in twin": {"k": 1, "n": 1},
            "executed in twin": {"k": 1, "n": 1},
            "executed as seen": {"k": 1, "n": 1},
        }
    }
    open_rows = [{**each, "accepted": None, "predicates": None} for each in ROWS]
    assert against_recorded(open_rows, LABELS) == {}


def test_every_answer_that_is_no_yes_is_listed_with_its_reason_once() -> None:
    rows = [
        row("a", "planned", None, reason="undecided: cube (hidden)"),
        row("a", "executed", None, mode="kinematic", reason="undecided: no physics"),
        row("b", "planned", False, reason="ik: unreachable"),
        row("c", "planned", None, reason="NaN", error="NaN"),
    ]
    text = describe_run({**summary(), "rows": rows, "counts": count_verdicts(rows)})
    assert "undecided:\n  a p planned dynamic: cube (hidden)\n" in text
    assert "rejected:\n  b p planned dynamic: ik: unreachable\n" in text
    assert "not evaluated:\n  c p planned dynamic: NaN" in text
    assert "no physics" not in text, "said of every kinematic replay"


def seen(*findings: tuple[str, bool | None]) -> Verdict:
    """What a recording says of each predicate."""
    said = tuple({"kind": kind, "value": value} for kind, value in findings)
    return verdict_of(ik=None, clearance=None, terminal=None, mode="kinematic", findings=said)


def test_what_nobody_found_was_not_seen_to_succeed() -> None:
    contacts = ("allowed_contacts", True)
    assert predicates_hold(seen(("inside", True), ("settled", None), contacts)) is True
    assert predicates_hold(seen(("inside", None), ("settled", None), contacts)) is None
    assert predicates_hold(seen(("inside", True), ("inside", None), contacts)) is None
    assert predicates_hold(seen(("inside", False), ("inside", None), contacts)) is False
    assert predicates_hold(seen(("settled", None))) is None
    assert predicates_hold(seen()) is None
