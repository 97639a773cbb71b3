"""``compare_run``: what the gate decided, which starts are pairs, and what a number rests on."""

from typing import Any

import pytest

from bridge.episode.provenance import hash_file
from evaluator.compare import Comparison, TrialRow, compare_run


def row_of(comparison: Comparison, name: str) -> TrialRow:
    return next(row for row in comparison.rows if row.episode == name)


def reasons(comparison: Comparison, name: str) -> str:
    return " | ".join(e.reason for e in comparison.exclusions if e.episode == name)


def test_a_verdict_made_before_motion_counts_although_it_arrived_late(maker: Any) -> None:
    """Gate and cell are two connections: the cell's stamp decides, not the order of arrival."""
    maker.trial("t1", late_gate=False, late_gate_made_ns=9_900_000_000)
    assert row_of(compare_run(maker.run), "t1").verdict is False


def test_a_plan_refused_but_executed_anyway_is_named_as_such(maker: Any) -> None:
    """Without replanning the gate was asked and not obeyed; with it, only its yes was sent."""
    for name, condition, recorded, said in (
        ("a", "without_replanning", "success", False),
        ("b", "without_replanning", "failure", False),
        ("c", "without_replanning", "success", True),
        ("d", "with_replanning", "failure", True),
    ):
        maker.trial(name, condition=condition, recorded=recorded, gate=said)
    comparison = compare_run(maker.run)
    results = comparison.results()
    npv = results.get("agreement.verdict.npv")
    assert (npv.k, npv.n) == (1, 2)
    assert (results.get("agreement.verdict.ppv").k, results.get("agreement.verdict.ppv").n) == (
        1,
        2,
    )
    unheeded = results.get("agreement.verdict_unheeded.ppv")
    assert (unheeded.k, unheeded.n) == (1, 1)
    assert "not obeyed" in unheeded.definition
    table = next(table for table in comparison.tables if table.id == "confusion")
    counts = {row[0]: row[1:] for row in table.rows}
    assert counts["verdict before motion"] == (1, 1, 1, 1, 4)
    assert counts["verdict, not obeyed (without replanning)"] == (1, 0, 1, 1, 3)
    assert counts["verdict, obeyed (with replanning)"] == (0, 1, 0, 0, 1)
    assert "executed anyway" in table.note


def test_the_success_table_says_that_the_twin_selected_the_accepted_plans(six_trials: Any) -> None:
    table = next(t for t in compare_run(six_trials.run).tables if t.id == "success")
    assert "the twin selected the accepted plans" in table.note


def test_the_largest_tool_error_is_not_lost_between_samples(maker: Any) -> None:
    maker.trial("t1", num_poses=900)
    maker.replay("t1", num_poses=900, astray=301)
    largest = compare_run(maker.run).results().get("motion.planned.path_max_m")
    assert largest.value == pytest.approx(1.0)


def test_a_pose_that_is_not_a_number_leaves_the_tool_error_undefined(maker: Any) -> None:
    maker.trial("t1")
    maker.replay("t1", offset_m=float("nan"))
    results = compare_run(maker.run).results()
    error = results.get("motion.planned.position_mean_m")
    assert error.value is None
    assert "not finite" in str(error.reason_if_undefined)
    assert results.get("agreement.sim_planned.rate").k == 1


def test_every_input_file_is_named_with_its_hash(six_trials: Any) -> None:
    provenance = compare_run(six_trials.run).provenance
    assert provenance["folder"] == str(six_trials.run.path)
    assert provenance["episodes"]["episodes/a1.mcap"] == hash_file(
        six_trials.run.episodes_dir / "a1.mcap"
    )
    assert all(len(item["sha256"]) == 64 for item in provenance["derived"].values())
