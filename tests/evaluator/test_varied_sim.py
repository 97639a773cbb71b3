"""Sim estimated again: varied replays of the plans sent, with draws the gate did not use."""

from dataclasses import replace
from typing import Any

import pytest

from bridge.task.verdict import Factor, Verdict
from evaluator.compare import compare_run
from evaluator.compare.success import varied_sim
from evaluator.run_reader.episodes import summarise_verdict


def test_sim_is_estimated_again_beside_the_replay_that_chose_the_plan(maker: Any) -> None:
    shares = {"a": (8, 8), "b": (3, 8), "c": (4, 8), "d": (0, 8)}
    for name, varied in shares.items():
        condition = "without_replanning" if name == "d" else "with_replanning"
        maker.trial(name, condition=condition)
        maker.replay(name, accepted=name != "d", varied=varied)
    results = compare_run(maker.run).results()
    task = compare_run(maker.run).rows[0].task
    again = results.get(f"rate.sim_varied.{task}.with_replanning.scripted")
    assert again.value == pytest.approx((8 + 3 + 4) / 24)
    assert (again.n, again.counted, again.episodes) == (3, "trial", ("a", "b", "c"))
    assert again.interval is None
    assert "no counts" in str(again.reason_without_interval)
    gap = results.get(f"bias.selection.{task}.with_replanning.scripted")
    assert (gap.unit, gap.value) == ("pp", pytest.approx(100 * (1 - 15 / 24)))
    without = results.get(f"bias.selection.{task}.without_replanning.scripted")
    assert without.value == pytest.approx(0.0)


def test_the_shares_a_gate_drew_are_not_those_of_fresh_seeds(maker: Any) -> None:
    """The probability in a verdict before motion was there when the plan was chosen."""
    maker.trial("a", gate=True)
    maker.replay("a")
    (row,) = compare_run(maker.run).rows
    assert varied_sim([replace(row, p_success=0.9)]) == []


def test_a_nominal_replay_without_a_decision_leaves_only_the_difference_undefined(
    maker: Any,
) -> None:
    maker.trial("a")
    maker.replay("a", accepted=None, varied=(2, 4))
    again, gap = varied_sim(compare_run(maker.run).rows)
    assert again.value == pytest.approx(0.5)
    assert gap.value is None
    assert "was decided" in str(gap.reason_if_undefined)


def test_varied_replays_beside_a_plain_one_are_found(maker: Any) -> None:
    """``replay`` and later ``replay --samples`` leave two files of one plan."""
    maker.trial("a")
    maker.replay("a", tag="a")
    maker.replay("a", tag="b", varied=(1, 4))
    again, _ = varied_sim(compare_run(maker.run).rows)
    assert (again.value, again.n) == (0.25, 1)


def test_how_far_answers_are_trusted_does_not_change_how_many_succeed() -> None:
    """After ``calibrate --posterior`` the stated probability is less than the share."""
    yes = Factor(value=True)
    verdict = Verdict(
        plan_id="p",
        trajectory="planned",
        mode="dynamic",
        ik=yes,
        clearance=yes,
        terminal=yes,
        engine="fake",
        seed=0,
        p_success={"value": 0.6, "low": 0.3, "high": 0.8, "k": 6, "n": 8},
    )
    summary = summarise_verdict(verdict)
    assert (summary.p_success, summary.varied_share) == (0.6, 0.75)
    assert summarise_verdict(replace(verdict, p_success=None)).varied_share is None
