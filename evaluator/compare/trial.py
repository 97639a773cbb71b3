"""Lay one recorded trial beside its replays: the row everything else is computed from."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from bridge.episode.catalogue_query import UNLABELLED
from bridge.episode.executions import NO_PLAN
from bridge.episode.metadata import NOTHING_EXECUTED, ROLLOUT, Outcome, treatment_of
from bridge.exchange.trials_csv import MOST_IN_TRIAL
from bridge.task.verdict import SAME_ENGINE, is_same_engine
from evaluator.compare.rows import TrialRow
from evaluator.result import Exclusion
from evaluator.run_reader.episodes import (
    DerivedFile,
    DerivedIndex,
    RecordedFacts,
    Replay,
    RunFile,
    positions_at_start,
    rollout_of,
)

TRAJECTORIES = ("planned", "executed")
CELLS_ENGINE = "cell's own engine"
"""A forecast that needs no twin of the cell's physics: the engine that moved the stand-in cell."""


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One recorded trial with the files that were made from it."""

    file: RunFile
    row: TrialRow
    lacking: tuple[str, ...] = ()
    """Why parts of the row are unknown."""
    impossible_count: str = ""
    """What is wrong with the label's count of objects or sub-tasks, which is then unknown."""
    replays: dict[str, DerivedFile] = field(default_factory=dict)
    """The dynamic replays of the plan sent, planned and executed, as far as there are any."""
    localised: DerivedFile | None = None

    @property
    def exclusions(self) -> list[Exclusion]:
        """What is left out of the agreement, and of rates in other units."""
        name = self.row.episode
        found = [Exclusion(episode=name, scope="agreement", reason=why) for why in self.lacking]
        if self.impossible_count:
            scope = f"rates counted in {self.row.unit}s"
            found.append(Exclusion(episode=name, scope=scope, reason=self.impossible_count))
        return found


def lay_out(file: RunFile, facts: RecordedFacts, index: DerivedIndex) -> Trial:
    """Find what was made from a recorded trial, build its row, and say what it lacks."""
    made_from = {"source": facts.info.id, "source_sha256": file.sha256}
    lacking = _unlabelled(facts.outcome)
    gate = facts.verdict
    if gate is not None and is_same_engine(gate.engine, stand_in=facts.info.stand_in):
        lacking += [f"the gate's verdict does not count: made in {gate.engine}, the {SAME_ENGINE}"]
        facts = replace(facts, verdict=None)
    found = dict.fromkeys(TRAJECTORIES, Replay())
    cells_engine: bool | None = None
    rolled = index.rollout(facts.info) if facts.plan_id in (None, NO_PLAN) else None
    if facts.plan_id is None and rolled is None:
        lacking.append("no execution_started event: no plan was sent")
    elif facts.plan_id is not None:
        asked = TRAJECTORIES if facts.plan_id != NO_PLAN else ("executed",)
        sent = {**made_from, "plan_id": facts.plan_id}
        found |= {name: index.replay(**sent, trajectory=name) for name in asked}
        if rolled is None:
            lacking += [replay.reason for replay in found.values() if replay.reason is not None]
            cells_engine = index.answer_of_cells_engine(**sent)
    localised = index.localised(**made_from)
    if localised is not None and localised.facts.broken:
        lacking.append(f"{localised.path.name}: {localised.facts.broken}")
    replays = {name: replay.file for name, replay in found.items() if replay.file is not None}
    row = _row(file, facts, found, localised, replays)
    if rolled is not None:
        row = _with_rollout(row, rolled, found["executed"])
    if cells_engine is not None:
        row = replace(row, baselines=((CELLS_ENGINE, cells_engine),))
    return Trial(
        file=file,
        row=row,
        lacking=tuple(lacking),
        impossible_count=_impossible_count(facts.outcome),
        replays=replays,
        localised=localised,
    )


def _with_rollout(row: TrialRow, rolled: DerivedFile, executed: Replay) -> TrialRow:
    """Lay a trial of a policy beside its rollout in the twin, which stands where a plan's would.

    Its own motion in the twin is judged as the rollout is, by the task alone.
    """
    told = rollout_of(rolled)
    success = bool(told["success"])
    return replace(
        row,
        plan_id=ROLLOUT,
        nothing_executed=False,
        sim_planned=success,
        sim_executed=None if executed.verdict is None else executed.verdict.done,
        planned_replay=rolled.file_name,
        first_failing=None if success else "terminal",
        failing_detail=None if success else str(told.get("detail") or "") or None,
        failing_cause=None,
        failing_bodies=(),
        failing_stage="",
    )


def _unlabelled(outcome: Outcome | None) -> list[str]:
    if outcome is None:
        return ["the outcome was not labelled"]
    why = f": {outcome.detail}" if outcome.detail else ""
    return [f"the outcome is labelled unknown{why}"] if outcome.result == "unknown" else []


def _impossible_count(outcome: Outcome | None) -> str:
    """Say what is wrong with a count of objects or sub-tasks; nothing where it can be."""
    if outcome is None or outcome.unit == "trial":
        return ""
    if 0 <= outcome.k <= outcome.n and 0 < outcome.n <= MOST_IN_TRIAL:
        return ""
    return f"the label counts {outcome.k} of {outcome.n} {outcome.unit}s, which cannot be"


def _row(
    file: RunFile,
    facts: RecordedFacts,
    found: Mapping[str, Replay],
    localised: DerivedFile | None,
    replays: Mapping[str, DerivedFile],
) -> TrialRow:
    info, outcome, verdict = facts.info, facts.outcome, facts.verdict
    result, detail = (outcome.result, outcome.detail or "") if outcome else (None, "")
    planned = found["planned"]
    answer = found["executed"] if facts.plan_id == NO_PLAN else planned
    failing = answer.verdict if answer.verdict is not None else verdict
    counted = outcome is not None and outcome.unit != "trial" and not _impossible_count(outcome)
    probabilities = [s.p_success for s in (planned.verdict, verdict) if s is not None]
    places = () if localised is None else localised.facts.places
    fails_ns = None if failing is None else failing.failing_t_ns
    begun = [e.id for e in facts.plan_stages if fails_ns is not None and fails_ns >= e.t_start_ns]
    return TrialRow(
        episode=info.id,
        file=file.file_name,
        condition=treatment_of(info.condition, info.study_arm),
        why_unknown=(detail or UNLABELLED) if result in (None, "unknown") else "",
        **{name: getattr(info, name) for name in _OF_INFO},
        recorded=_ANSWERS.get(result),
        unit="trial" if outcome is None else outcome.unit,
        k=outcome.k if outcome is not None and counted else None,
        n=outcome.n if outcome is not None and counted else None,
        plan_id=facts.plan_id,
        num_plans=facts.num_plans,
        num_plans_sent=facts.num_plans_sent,
        # Without plans and a word about it, a robot moved by other means.
        nothing_executed=facts.plan_id is None
        and (facts.num_plans > 0 or detail.startswith(NOTHING_EXECUTED)),
        sim_planned=planned.accepted,
        sim_executed=found["executed"].accepted,
        verdict=None if verdict is None else verdict.accepted,
        p_success=next((p for p in probabilities if p is not None), None),
        **{} if failing is None else {name: getattr(failing, name) for name in _OF_FAILURE},
        failing_stage=next(reversed(begun), ""),
        stages=_stages(outcome),
        planned_replay=replays["planned"].file_name if "planned" in replays else None,
        divergence=replays["executed"].facts.divergence if "executed" in replays else "",
        executed_replay=replays["executed"].file_name if "executed" in replays else None,
        began_ns=facts.began_ns,
        start_positions_m=facts.start_positions_m | positions_at_start(places, facts.started_ns),
    )


_OF_INFO = ("task", "study_arm", "policy", "checkpoint", "start_id", "cell", "stand_in")
_OF_FAILURE = ("first_failing", "failing_detail", "failing_cause", "failing_bodies")
"""Fields of a row that what it is made from calls by the same name."""
_ANSWERS: dict[str | None, bool] = {"success": True, "failure": False}


def _stages(outcome: Outcome | None) -> tuple[tuple[str, bool | None], ...]:
    return tuple(
        (str(stage.get("id", "")), _ANSWERS.get(str(stage.get("result"))))
        for stage in (outcome.stages if outcome is not None else ())
    )
