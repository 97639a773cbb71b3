"""Measure everything that follows from trial rows alone, wherever they came from."""

from collections.abc import Sequence
from dataclasses import replace

from bridge.episode.executions import NO_PLAN
from bridge.task.protocol import VOID_CAUSES, Protocol
from evaluator.cache import SummaryCache
from evaluator.compare.agreement import group_agreement, usable_groups
from evaluator.compare.attribution import attribution_table
from evaluator.compare.baselines import baseline_results
from evaluator.compare.conclusions import conclusions_table
from evaluator.compare.gate import agreement
from evaluator.compare.measure import refuse_alike, refuse_changed
from evaluator.compare.notes import notes, notes_table
from evaluator.compare.policies import (
    compare_policies,
    comparison_part,
    notes_of_trials,
    void_starts,
)
from evaluator.compare.regret import regret_results
from evaluator.compare.rows import Comparison, TrialRow
from evaluator.compare.stages import failures_table, stage_results
from evaluator.compare.success import WITH, WITHOUT, rate_groups, side_rates, unpaired_keys
from evaluator.compare.tables import confusion_table, success_table, trials_table
from evaluator.result import Measurement


def compare_rows(
    rows: Sequence[TrialRow],
    *,
    run: str,
    source: str,
    stand_in: bool | None,
    void_causes: Sequence[str] = VOID_CAUSES,
    protocol: Protocol | None = None,
    cache: SummaryCache | None = None,
) -> Comparison:
    """Measure everything that follows from trial rows alone, wherever they came from."""
    empty = Comparison(run=run, source=source, stand_in=stand_in)
    if not rows:
        return empty
    for kind in ("task", "condition", "policy"):
        refuse_alike(kind, ((getattr(row, kind), row.episode) for row in rows))
    refuse_changed((row.episode, row.policy, row.checkpoint) for row in rows)
    rates = side_rates(rows)
    groups = rate_groups(rows, rates)
    # A run may lack its replays, which is told; a table without a twin is none of a twin.
    has_twin = source == "run" or any(
        each is not None for r in rows for each in (r.sim_planned, r.sim_executed, r.verdict)
    )
    compared = comparison_part(compare_policies(rows, protocol, void_causes), protocol)
    stages, stage_tables, other_stages = stage_results(rows)
    measurements = (
        *rates,
        *(rate for group in groups for rate in (group.sim_common, group.recorded_common) if rate),
        *((*agreement(rows), *group_agreement(groups, cache)) if has_twin else ()),
        *compared.measurements,
        *regret_results(usable_groups(groups)),
        *baseline_results(rows),
        *stages,
    )
    word = empty.recorded_word
    # Who gave a table of outcomes knows how they were made.
    given = source != "run" and not unpaired_keys(rows)
    return replace(
        empty,
        rows=tuple(rows),
        groups=groups,
        measurements=measurements,
        tables=(
            *compared.tables,
            *conclusions_table(groups, rows),
            success_table(groups, word, "Outcomes as the table gives them." if given else ""),
            *notes_table([*notes_of_trials(rows, void_causes), *notes(groups, measurements)]),
            *((confusion_table(rows, word),) if has_twin else ()),
            *attribution_table(rows),
            *stage_tables,
            *failures_table(rows, word),
            trials_table(rows, word),
        ),
        exclusions=(*void_starts(rows, void_causes), *other_stages),
        missing=tuple(_missing(rows, measurements, source)),
    )


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
    unplanned = sum(row.plan_id == NO_PLAN for row in rows)
    if unplanned:
        found.append(f"planned: {unplanned} of {len(rows)} trials had no plan")
    for side, words in sides:
        asked = rows if side == "sim_executed" else [r for r in rows if r.plan_id != NO_PLAN]
        without = sum(getattr(row, side) is None for row in asked)
        if without and (source == "run" or without < len(asked)):
            found.append(f"{side}: {without} of {len(rows)} trials have no {words[2:]}")
    if source == "run" and not any(m.id.startswith("stage.") for m in measurements):
        found.append("stage funnel: no data (no trial has labelled stages or counts sub-tasks)")
    return found
