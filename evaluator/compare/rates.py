"""A table of printed rates into a ``Comparison``: no trials, so no pairing and no verdicts."""

from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

from bridge.episode.provenance import hash_file, software
from bridge.exchange.trials_rates import RateRecord
from evaluator.compare.agreement import group_agreement, usable_groups
from evaluator.compare.conclusions import conclusions_table
from evaluator.compare.gains import replanning_gains
from evaluator.compare.measure import refuse_alike
from evaluator.compare.notes import notes, notes_table
from evaluator.compare.policies import compare_counts, comparison_part
from evaluator.compare.regret import regret_results
from evaluator.compare.rows import Comparison, RateGroup
from evaluator.compare.success import WITH, averages
from evaluator.compare.tables import gains_table, layout_table, success_table
from evaluator.measurements import RATE_AS_GIVEN
from evaluator.result import Exclusion, Measurement
from evaluator.statistics.intervals import RATE_INTERVALS


def compare_records(
    records: Sequence[RateRecord], path: Path, *, method: str = "wilson"
) -> Comparison:
    """Compare rates that were read already; ``path`` is where they come from."""
    for kind in ("task", "condition", "policy"):
        refuse_alike(kind, ((getattr(r, kind), f"row {r.row}") for r in records))
    sides = {record.side for record in records}
    # Rates of the twin alone say nothing of where the others would come from.
    stand_in = True if "stand-in" in sides else (False if "real" in sides else None)
    groups, left_out = _rate_groups(records, method)
    word = Comparison(run=path.stem, source="rates", stand_in=stand_in).recorded_word
    gains = replanning_gains(groups)
    compared = comparison_part(answers := compare_counts(groups))
    measurements = (
        *(side for group in groups for side in (group.recorded, group.sim)),
        *averages(groups, method=method),
        *_without_counts(groups, group_agreement(groups)),
        *gains,
        *compared.measurements,
        *regret_results(usable_groups(groups)),
    )
    return Comparison(
        run=path.stem,
        source="rates",
        stand_in=stand_in,
        groups=groups,
        measurements=measurements,
        tables=(
            *compared.tables,
            *conclusions_table(groups, answers),
            success_table(groups, word, "Rates as given."),
            *layout_table(groups, measurements, word),
            *gains_table(gains, word),
            *notes_table(notes(groups, measurements)),
        ),
        exclusions=tuple(left_out),
        missing=() if _all_counted(groups) else (f"intervals: {NO_COUNTS}",),
        provenance={"software": software(), "file": path.name, "sha256": hash_file(path)},
    )


NO_COUNTS = "rates without n: a column n, or 7/10 in the place of 70 %, gives an interval"


def _all_counted(groups: Sequence[RateGroup]) -> bool:
    return all(rate.n for group in usable_groups(groups) for rate in (group.recorded, group.sim))


def _without_counts(
    groups: Sequence[RateGroup], found: Sequence[Measurement]
) -> Sequence[Measurement]:
    """Leave intervals out where a rate has no n: nothing says how far it would move again."""
    if _all_counted(groups):
        return found
    return [
        replace(each, interval=None, reason_without_interval=NO_COUNTS)
        if each.value is not None
        else each
        for each in found
    ]


def _rate_groups(
    records: Sequence[RateRecord], method: str
) -> tuple[tuple[RateGroup, ...], list[Exclusion]]:
    keys = list(dict.fromkeys((r.task, r.condition, r.policy, r.unit) for r in records))
    policies = list(dict.fromkeys(record.policy for record in records))
    tasks = list(dict.fromkeys(record.task for record in records))
    keys.sort(key=lambda key: (tasks.index(key[0]), policies.index(key[2]), key[1] == WITH))
    groups, left_out = [], []
    for key in keys:
        task, condition, policy, unit = key
        sides: dict[str, RateRecord] = {
            "sim" if r.side == "sim" else "recorded": r
            for r in records
            if (r.task, r.condition, r.policy) == (task, condition, policy)
        }
        for side in ("sim", "recorded"):
            if side not in sides:
                name = " ".join(part for part in (task, condition, policy) if part)
                reason = f"{name}: no {side} rate"
                left_out.append(Exclusion(episode=task, scope="agreement of groups", reason=reason))
        groups.append(
            RateGroup(
                task=task,
                condition=condition,
                policy=policy,
                unit=unit,
                recorded=_rate(sides.get("recorded"), "recorded", key, method),
                sim=_rate(sides.get("sim"), "sim_planned", key, method),
                recorded_rate=_fraction(sides.get("recorded")),
                sim_rate=_fraction(sides.get("sim")),
            )
        )
    return tuple(groups), left_out


def _fraction(record: RateRecord | None) -> Fraction | None:
    return None if record is None else record.rate


def _rate(
    record: RateRecord | None, side: str, key: tuple[str, str, str, str], method: str
) -> Measurement:
    task, condition, policy, unit = key
    interval = None
    if record is not None and record.k is not None and record.n is not None:
        interval = RATE_INTERVALS[method](record.k, record.n)
    where = "" if record is None else f" in row {record.row} ({record.side})"
    parts = {"task": task, "condition": condition, "policy": policy, "unit": unit}
    defined = RATE_AS_GIVEN.of(side=side, where=where, **parts)
    return Measurement(
        **vars(defined),
        value=None if record is None else float(record.rate),
        interval=interval,
        k=record.k if record is not None else None,
        n=record.n if record is not None else None,
        counted=unit,
        reason_if_undefined="not in the table" if record is None else None,
        reason_without_interval=None if interval is not None else "no n",
    )
