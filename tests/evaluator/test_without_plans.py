"""Trials that nobody planned: labels count, and agreement is that of the executed side."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from joint_samples import at_positions

from bridge.episode import schema
from bridge.episode.executions import NO_PLAN
from bridge.episode.metadata import EpisodeInfo, Outcome
from bridge.episode.reader import Episode
from bridge.episode.writer import EpisodeWriter
from evaluator.compare import compare_run
from evaluator.compare.attribution import (
    ACTIONS,
    AGREE,
    UNKNOWN,
    WORLD,
    attributed,
    attribution_table,
)
from evaluator.report.wording import headlines

STEP_NS = 8_000_000


def moved(maker: Any, name: str, result: str) -> None:
    """A trial of joints that rest, turn by one radian and rest again."""
    info = EpisodeInfo(id=name, kind="trial", task="cube_into_box", policy="act")
    outcome = Outcome(result=result, k=int(result == "success"))
    turn = np.interp(np.arange(600), [200, 400], [0.0, 1.0])
    with EpisodeWriter(maker.run.episodes_dir / f"{name}.mcap") as writer:
        writer.describe(info, outcome=outcome)
        for number, angle in enumerate(turn.tolist()):
            stamp_ns = 10**18 + number * STEP_NS
            data = at_positions(stamp_ns, ("a",), np.array([angle])).to_cdr()
            writer.write(
                "/c/joint_states", data, type_name=schema.JOINT_STATE, log_time_ns=stamp_ns
            )


def test_agreement_is_that_of_what_was_executed_and_says_so(maker: Any) -> None:
    answers = {"t1": ("success", True), "t2": ("failure", True), "t3": ("failure", False)}
    for name, (result, accepted) in answers.items():
        moved(maker, name, result)
        maker.replay(name, plan_id=NO_PLAN, trajectory="executed", accepted=accepted)
    comparison = compare_run(maker.run)
    results = comparison.results()
    assert results.get("rate.recorded.cube_into_box.-.act").k == 1
    agreed = results.get("agreement.sim_executed.rate")
    assert (agreed.k, agreed.n) == (2, 3)
    assert results.get("agreement.sim_planned.rate").value is None
    assert "planned: 3 of 3 trials had no plan" in comparison.missing
    assert not [e for e in comparison.exclusions if "planned" in e.reason]
    named = {label: m.id for label, _, m in headlines(results)}
    assert named["Executed in twin and recorded outcome agree"] == "agreement.sim_executed.rate"
    assert not any("sim_planned" in name for name in named.values())
    row = comparison.rows[0]
    assert (row.plan_id, row.num_plans, row.num_plans_sent) == (NO_PLAN, 0, 0)
    assert not row.nothing_executed


def test_a_trial_in_which_nothing_moved_was_not_executed(maker: Any) -> None:
    moved(maker, "t1", "failure")
    with EpisodeWriter(maker.run.episodes_dir / "t2.mcap") as writer:
        writer.describe(EpisodeInfo(id="t2", kind="trial", task="cube_into_box"))
    plans = {row.episode: row.plan_id for row in compare_run(maker.run).rows}
    assert plans == {"t1": NO_PLAN, "t2": None}


def test_trials_with_plans_keep_their_headline(maker: Any) -> None:
    moved(maker, "t1", "success")
    maker.replay("t1", plan_id=NO_PLAN, trajectory="executed")
    maker.trial("t2")
    maker.replay("t2")
    results = compare_run(maker.run).results()
    assert results.get("agreement.sim_planned.rate").n == 1
    assert any(m.id == "agreement.sim_planned.rate" for _, _, m in headlines(results))


@pytest.mark.parametrize("field", ["started_ns", "ended_ns"])
def test_when_it_was_executed_follows_from_the_joints(maker: Any, field: str) -> None:
    from evaluator.run_reader.episodes import read_recorded

    moved(maker, "t1", "success")
    facts = read_recorded(maker.run, maker.run.episodes_dir / "t1.mcap")
    expected = 10**18 + {"started_ns": 200, "ended_ns": 400}[field] * STEP_NS
    assert abs(getattr(facts, field) - expected) <= 50_000_000


def rolled(maker: Any, name: str, success: bool) -> None:
    """A rollout of a trial's policy from its start."""
    told = {"policy": "act", "task": "cube_into_box", "start_id": name, "success": success}
    path = maker.replay(name, plan_id="rollout", trajectory="rollout", tag="r")
    derived = Episode.open(path).derived
    assert derived is not None
    derived = replace(derived, kind="rollout", settings={"rollout": told | {"number": 0}})
    with EpisodeWriter(path.with_name(f"{name}.rollout.act.mcap")) as writer:
        writer.describe(EpisodeInfo(id=f"{name}-rollout", kind="trial"), derived=derived)
    path.unlink()


def test_a_rollout_that_ends_otherwise_is_put_down_to_the_world_or_to_what_was_done(
    maker: Any,
) -> None:
    """The trial's motion in the twin decides, by its end alone: these replays touch the box."""
    cases = {
        # recorded, rolled out, whether the trial's motion does the task in the twin
        "t1": ("success", True, True, AGREE),
        "t2": ("failure", True, True, WORLD),
        "t3": ("success", False, True, ACTIONS),
        "t4": ("success", False, None, UNKNOWN),
    }
    for name, (result, success, does, _) in cases.items():
        moved(maker, name, result)
        rolled(maker, name, success)
        if does is not None:
            maker.replay(name, plan_id=NO_PLAN, trajectory="executed", accepted=False)
    comparison = compare_run(maker.run)
    assert {row.episode: attributed(row) for row in comparison.rows} == {
        name: case[-1] for name, case in cases.items()
    }
    (table,) = (table for table in comparison.tables if table.id == "attribution")
    assert table.rows[-1] == ("", "all", 4, 1, 1, 1, 1)
    assert attribution_table([replace(comparison.rows[0], plan_id="p")]) == ()
