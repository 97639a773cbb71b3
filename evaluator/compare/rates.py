"""A table of printed rates into a ``Comparison``: no trials, so no pairing and no verdicts."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from bridge.exchange.trials_rates import RateRecord
from evaluator.compare.agreement import group_agreement, usable_groups
from evaluator.compare.conclusions import conclusions_table
from evaluator.compare.measure import refuse_alike
from evaluator.compare.notes import notes, notes_table
from evaluator.compare.policies import compare_counts, comparison_part
from evaluator.compare.regret import regret_results
from evaluator.compare.rows import Comparison, RateGroup
from evaluator.compare.success import WITH, of_group
from evaluator.compare.tables import success_table
from evaluator.measurements import RATE_AS_GIVEN
from evaluator.result import Exclusion, Measurement
from evaluator.statistics.intervals import wilson

Key = tuple[str, str, str, str]
"""Task, condition, policy, unit."""
NO_COUNTS = "rates without n: a column n, or 7/10 in the place of 70 %, gives an interval"


def compare_records(records: Sequence[RateRecord], name: str) -> Comparison:
    """Compare rates that were read already."""
    for kind in ("task", "condition", "policy"):
        refuse_alike(kind, ((getattr(r, kind), f"row {r.row}") for r in records))
    sides = {record.side for record in records}
    # Rates of the twin alone say nothing of where the others would come from.
    stand_in = True if "stand-in" in sides else (False if "real" in sides else None)
    empty = Comparison(run=name, source="rates", stand_in=stand_in)
    groups, left_out = _rate_groups(records)
    counted = all(rate.n for group in usable_groups(groups) for rate in (group.recorded, group.sim))
    agreement = group_agreement(groups)
    if not counted:  # nothing says how far a rate without n would move if it was counted again
        bare = partial(replace, interval=None, reason_without_interval=NO_COUNTS)
        agreement = [each if each.value is None else bare(each) for each in agreement]
    compared = comparison_part(compare_counts(groups))
    measurements = (
        *(side for group in groups for side in (group.recorded, group.sim)),
        *agreement,
        *compared.measurements,
        *regret_results(usable_groups(groups)),
    )
    return replace(
        empty,
        groups=groups,
        measurements=measurements,
        tables=(
            *compared.tables,
            *conclusions_table(groups),
            success_table(groups, empty.recorded_word, "Rates as given."),
            *notes_table(notes(groups, measurements)),
        ),
        exclusions=tuple(left_out),
        missing=() if counted else (f"intervals: {NO_COUNTS}",),
    )


def _rate_groups(records: Sequence[RateRecord]) -> tuple[tuple[RateGroup, ...], list[Exclusion]]:
    """Lay both sides of each group beside each other, and name what lacks one."""
    cells: dict[Key, dict[str, RateRecord]] = {}
    for record in records:
        key = (record.task, record.condition, record.policy, record.unit)
        cells.setdefault(key, {})["sim" if record.side == "sim" else "recorded"] = record
    tasks, policies = (list(dict.fromkeys(key[place] for key in cells)) for place in (0, 2))
    groups, left_out = [], []
    for key in sorted(
        cells, key=lambda key: (tasks.index(key[0]), policies.index(key[2]), key[1] == WITH)
    ):
        found = {side: cells[key].get(side) for side in ("sim", "recorded")}
        name = " ".join(part for part in key[:3] if part)
        left_out += [
            Exclusion(episode=key[0], scope="agreement of groups", reason=f"{name}: no {side} rate")
            for side, record in found.items()
            if record is None
        ]
        real, sim = found["recorded"], found["sim"]
        groups.append(
            RateGroup(
                task=key[0],
                condition=key[1],
                policy=key[2],
                unit=key[3],
                recorded=_rate(real, "recorded", key),
                sim=_rate(sim, "sim_planned", key),
                recorded_rate=None if real is None else real.rate,
                sim_rate=None if sim is None else sim.rate,
            )
        )
    return tuple(groups), left_out


def _rate(record: RateRecord | None, side: str, key: Key) -> Measurement:
    k, n = (None, None) if record is None else (record.k, record.n)
    interval = None if k is None or n is None else wilson(k, n)
    where = "" if record is None else f" in row {record.row} ({record.side})"
    defined = of_group(RATE_AS_GIVEN, key[:3], unit=key[3], side=side, where=where)
    return Measurement(
        **vars(defined),
        value=None if record is None else float(record.rate),
        interval=interval,
        k=k,
        n=n,
        counted=key[3],
        reason_if_undefined="not in the table" if record is None else None,
        reason_without_interval=None if interval is not None else "no n",
    )
