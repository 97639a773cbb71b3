"""``compare_run``: what the gate decided, which starts are pairs, and what a number rests on."""

from typing import Any

import pytest

from bridge.episode.provenance import hash_file
from evaluator.compare import Comparison, TrialRow, compare_run


def row_of(comparison: Comparison, name: str) -> TrialRow:
    return next(row for row in comparison.rows if row.episode == name)


def reasons(comparison: Comparison, name: str) -> str:
    return " | ".join(e.reason for e in comparison.exclusions if e.episode == name)


def test_starts_the_twin_localised_far_apart_are_not_paired(maker: Any) -> None:
    """The cell itself localises nothing: the poses are in the derived episodes."""
    for name, condition, x_m in (("a", "without_replanning", 0.4), ("b", "with_replanning", 0.45)):
        maker.trial(name, condition=condition)
        maker.localised(name, x_m)
    assert "50 mm apart, limit 30 mm" in reasons(compare_run(maker.run), "a")


def test_a_stale_localisation_says_nothing_of_a_start(maker: Any) -> None:
    for name, condition, x_m in (("a", "without_replanning", 0.4), ("b", "with_replanning", 0.45)):
        maker.trial(name, condition=condition)
        maker.localised(name, x_m, source_sha256="0" * 64)
    results = compare_run(maker.run).results()
    assert results.get("paired.mcnemar_p_mid.recorded").n == 1
    distance = results.get("paired.start_distance_max_m")
    assert distance.value is None
    assert "1 of 1 pairs were not localised" in distance.definition


def test_the_distance_of_paired_starts_is_reported(maker: Any) -> None:
    for start, x_m in (("s1", 0.41), ("s2", 0.42)):
        maker.trial(f"a{start}", start_id=start, localised_m=0.4)
        maker.trial(f"b{start}", start_id=start, localised_m=x_m, condition="with_replanning")
    results = compare_run(maker.run).results()
    assert results.get("paired.start_distance_mean_m").value == pytest.approx(0.015)
    assert results.get("paired.start_distance_max_m").value == pytest.approx(0.02)


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
    assert "Replays with --samples estimate it again with fresh seeds" in table.note


def test_plans_that_were_never_sent_are_counted_apart(six_trials: Any) -> None:
    never = compare_run(six_trials.run).results().get("plans.never_sent")
    assert (never.value, never.n) == (6.0, 12)


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
    assert provenance["episodes"]["episodes/a1.mcap"] == hash_file(
        six_trials.run.episodes_dir / "a1.mcap"
    )
    assert all(len(item["sha256"]) == 64 for item in provenance["derived"].values())


def test_a_start_used_twice_in_one_condition_is_not_paired(maker: Any) -> None:
    for name in ("a", "b"):
        maker.trial(name)
        maker.replay(name)
    maker.trial("c", condition="with_replanning")
    maker.replay("c")
    assert "has 2 without and 1 with" in reasons(compare_run(maker.run), "a")
