"""Measure everything that follows from trial rows alone, wherever they came from."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from bridge.episode.executions import NO_PLAN
from bridge.task.protocol import VOID_CAUSES, Protocol
from evaluator.compare.agreement import group_agreement, usable_groups
from evaluator.compare.axes import axis_tables
from evaluator.compare.baselines import baseline_results
from evaluator.compare.conclusions import conclusions_table
from evaluator.compare.gains import replanning_gains
from evaluator.compare.gate import agreement, reliability
from evaluator.compare.measure import refuse_alike
from evaluator.compare.notes import notes, notes_table
from evaluator.compare.policies import Answer, compare_policies, comparison_part
from evaluator.compare.regret import regret_results
from evaluator.compare.rows import Comparison, RateGroup, TrialRow
from evaluator.compare.stages import failures_table, stage_results
from evaluator.compare.study import study_results
from evaluator.compare.success import (
    WITH,
    WITHOUT,
    averages,
    rate_groups,
    side_rates,
    trials_in,
    unpaired_keys,
    varied_sim,
)
from evaluator.compare.tables import (
    confusion_table,
    gains_table,
    layout_table,
    success_table,
    trials_table,
)
from evaluator.result import Exclusion, Measurement, Table


@dataclass(frozen=True, kw_only=True)
class _Found:
    """What was measured, before it is laid out for readers."""

    groups: tuple[RateGroup, ...]
    measurements: tuple[Measurement, ...]
    exclusions: tuple[Exclusion, ...]
    gains: list[Measurement]
    study_tables: tuple[Table, ...]
    answers: list[Answer]
    """Which candidate is better."""
    compared_tables: tuple[Table, ...]
    gate_tables: tuple[Table, ...]
    """The gate's scorecard."""
    stage_tables: tuple[Table, ...]


def compare_rows(
    rows: Sequence[TrialRow],
    *,
    run: str,
    source: str,
    stand_in: bool | None,
    method: str = "wilson",
    void_causes: Sequence[str] = VOID_CAUSES,
    protocol: Protocol | None = None,
) -> Comparison:
    """Measure everything that follows from trial rows alone, wherever they came from."""
    empty = Comparison(run=run, source=source, stand_in=stand_in)
    if not rows:
        return empty
    for kind in ("task", "condition", "policy"):
        refuse_alike(kind, ((getattr(row, kind), row.episode) for row in rows))
    found = _measure(rows, method, void_causes, protocol)
    return replace(
        empty,
        rows=tuple(rows),
        groups=found.groups,
        measurements=found.measurements,
        tables=_tables(rows, found, empty.recorded_word, source),
        exclusions=found.exclusions,
        missing=tuple(_missing(rows, found.measurements, source)),
    )


def _measure(
    rows: Sequence[TrialRow],
    method: str,
    void_causes: Sequence[str],
    protocol: Protocol | None,
) -> _Found:
    rates = side_rates(rows, method=method)
    groups = rate_groups(rows, rates, method=method)
    gains = replanning_gains(groups)
    answers = compare_policies(rows, protocol, void_causes)
    compared = comparison_part(answers, protocol)
    beside, beside_tables = baseline_results(rows)
    stages, stage_tables, other_stages = stage_results(rows)
    study, study_tables, void = study_results(rows, void_causes, method=method)
    measurements = (
        *rates,
        *(rate for group in groups for rate in (group.sim_common, group.recorded_common) if rate),
        *averages(groups, method=method),
        *agreement(rows, method=method),
        *group_agreement(groups),
        *gains,
        *varied_sim(rows),
        *study,
        *compared.measurements,
        *regret_results(usable_groups(groups)),
        *beside,
        *reliability(rows),
        *stages,
    )
    return _Found(
        groups=groups,
        measurements=measurements,
        exclusions=(*void, *other_stages),
        gains=gains,
        study_tables=study_tables,
        answers=answers,
        compared_tables=compared.tables,
        gate_tables=beside_tables,
        stage_tables=stage_tables,
    )


def _tables(rows: Sequence[TrialRow], found: _Found, word: str, source: str) -> tuple[Table, ...]:
    """Lay out what was found; ``word`` is what the recorded side is called."""
    # Who gave a table of outcomes knows how they were made.
    given = source != "run" and not unpaired_keys(rows)
    note = "Outcomes as the table gives them." if given else ""
    groups, measurements = found.groups, found.measurements
    return (
        *found.compared_tables,
        *conclusions_table(groups, found.answers, rows),
        success_table(groups, word, note),
        *layout_table(groups, measurements, word),
        *gains_table(found.gains, word),
        *found.study_tables,
        *notes_table(notes(groups, measurements)),
        confusion_table(rows, word),
        *found.gate_tables,
        *found.stage_tables,
        *failures_table(rows, word),
        *axis_tables(rows, word),
        trials_table(rows, word),
    )


NO_DATA = (
    ("reliability.", "reliability of the success probability", "no trial has p_success"),
    (
        "rate.sim_varied.",
        "sim estimated again with fresh seeds",
        "no planned replay has varied ones; robot-gst replay RUN --samples 16 makes them",
    ),
    ("stage.", "stage funnel", "no trial has labelled stages or counts sub-tasks"),
)
"""Parts of the evaluation whose input a run may not have."""


def _missing(
    rows: Sequence[TrialRow], measurements: Sequence[Measurement], source: str
) -> list[str]:
    """Say what could not be computed; of a table only what some of its rows have, and not all."""
    found = []
    conditions = {row.condition for row in rows}
    if not {WITH, WITHOUT} <= conditions and (source == "run" or conditions & {WITH, WITHOUT}):
        there = ", ".join(sorted(name or "unnamed" for name in conditions))
        found.append(f"replanning gain: it needs both conditions, there is only {there}")
    sides: tuple[tuple[str, str], ...] = (
        ("sim_planned", "a decided dynamic replay of the plan sent"),
        ("verdict", "a verdict before motion"),
        ("sim_executed", "a dynamic replay of the executed joints"),
    )
    paired = any(None not in (row.recorded, row.sim_planned) for row in rows)
    if not paired and any(row.sim_planned is not None for row in rows):
        sides = ()  # trials of either side, without pairs: what a row lacks, another one is
    unplanned = trials_in(row for row in rows if row.plan_id == NO_PLAN)
    if unplanned:
        found.append(f"planned: {unplanned} of {trials_in(rows)} trials had no plan")
    for side, words in sides:
        asked = rows if side == "sim_executed" else [r for r in rows if r.plan_id != NO_PLAN]
        without = trials_in(row for row in asked if getattr(row, side) is None)
        if without and (source == "run" or without < trials_in(asked)):
            found.append(f"{side}: {without} of {trials_in(rows)} trials have no {words[2:]}")
    found += [
        f"{words}: no data ({why})"
        for start, words, why in (NO_DATA if source == "run" else ())
        if not any(m.id.startswith(start) for m in measurements)
    ]
    return found
