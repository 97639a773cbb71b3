"""Success rates per task, condition and policy, in the twin and recorded, and their averages."""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from fractions import Fraction

from bridge.episode.executions import NO_PLAN
from bridge.episode.metadata import CONTROL
from bridge.episode.metadata import WITH as WITH
from bridge.episode.metadata import WITHOUT as WITHOUT
from evaluator.compare.measure import grouped, proportion
from evaluator.compare.rows import RateGroup, TrialRow
from evaluator.measurements import RATE_BY_UNIT, RATES, RATES_IN_COMMON, Defined, Quantity
from evaluator.result import Measurement

CONDITION_OF_ARM = {"without": WITHOUT, "with": WITH, "control": CONTROL}
"""What the trials of a study arm are grouped by."""
Key = tuple[str, str, str]
"""Task, condition, policy."""
Answer = Callable[[TrialRow], bool | None]

SIDES: dict[str, Answer] = {
    "recorded": lambda row: row.recorded,
    "sim_planned": lambda row: row.sim_planned,
    "sim_executed": lambda row: row.sim_executed,
    "verdict": lambda row: row.verdict,
}


def group_rows(rows: Sequence[TrialRow]) -> dict[Key, list[TrialRow]]:
    """Gather rows by task, condition and policy; without replanning comes first."""
    groups = grouped(rows, lambda row: (row.task, row.condition, row.policy))
    return dict(
        sorted(groups.items(), key=lambda item: (item[0][0], item[0][2], item[0][1] == WITH))
    )


def unpaired_keys(rows: Iterable[TrialRow]) -> set[Key]:
    """Return the groups whose sides have trials of their own, none with both."""
    seen: dict[Key, set[tuple[bool, bool]]] = {}
    for row in rows:
        known = (row.recorded is not None, row.sim_planned is not None)
        seen.setdefault((row.task, row.condition, row.policy), set()).add(known)
    one_sided = {(True, False), (False, True)}
    return {key for key, known in seen.items() if one_sided <= known and (True, True) not in known}


def names_of(rows: Iterable[TrialRow]) -> list[str]:
    """List the episodes of rows that stand for one trial each."""
    return [row.episode for row in rows if row.episode]


def answered(
    defined: Defined, rows: Sequence[TrialRow], answer: Answer, *, reason_if_undefined: str
) -> Measurement:
    """Measure the share of yes among the trials whose answer is known."""
    known = [row for row in rows if answer(row) is not None]
    return proportion(
        defined,
        sum(bool(answer(row)) for row in known),
        len(known),
        reason_if_undefined=reason_if_undefined,
        episodes=names_of(known),
    )


def side_rates(rows: Sequence[TrialRow]) -> list[Measurement]:
    """Measure every side of every group, counted in trials; object counts beside them."""
    measurements = []
    for key, members in group_rows(rows).items():
        for side, answer in SIDES.items():
            no_plan = side == "sim_planned" and _without_plans(members)
            why = "no plan" if no_plan else f"none of {len(members)} trials has it"
            defined = of_group(RATES[side], key)
            measurements.append(answered(defined, members, answer, reason_if_undefined=why))
        measurements.extend(_counted_rate(key, members))
    return measurements


def _without_plans(rows: Sequence[TrialRow]) -> bool:
    return all(row.plan_id == NO_PLAN for row in rows)


def _counted_rate(key: Key, members: Sequence[TrialRow]) -> list[Measurement]:
    """Measure objects or sub-tasks where trials are counted in them; never two units together."""
    counted = [row for row in members if row.unit != "trial" and row.k is not None and row.n]
    if not counted:
        return []
    by_unit = {row.unit: row for row in reversed(counted)}
    mixed = len(by_unit) > 1
    firsts = " and ".join(f"{row.episode} in {name}s" for name, row in sorted(by_unit.items()))
    return [
        proportion(
            of_group(RATE_BY_UNIT, key, unit=counted[0].unit),
            0 if mixed else sum(row.k or 0 for row in counted),
            0 if mixed else sum(row.n or 0 for row in counted),
            counted=counted[0].unit,
            reason_if_undefined=f"trials are counted in different units: {firsts}",
            episodes=names_of(counted),
        )
    ]


def rate_groups(rows: Sequence[TrialRow], rates: Sequence[Measurement]) -> tuple[RateGroup, ...]:
    """Lay the recorded and the headline sim rate of each group side by side.

    Over the trials where both sides are known; where there is none, each side over its own trials.
    """
    by_id = {measurement.id: measurement for measurement in rates}
    groups = []
    for key, members in group_rows(rows).items():
        both = [r for r in members if r.recorded is not None and r.sim_planned is not None]
        recorded, sim, executed = (
            by_id[of_group(RATES[side], key).id]
            for side in ("recorded", "sim_planned", "sim_executed")
        )
        why = "no trial has both sides"
        recorded_common, sim_common = (
            answered(of_group(common, key), both, SIDES[side], reason_if_undefined=why)
            for side, common in RATES_IN_COMMON.items()
        )
        own = bool(not both and recorded.n and sim.n)  # each side has trials of its own
        real, twin = (recorded, sim) if own else (recorded_common, sim_common)
        groups.append(
            RateGroup(
                **dict(zip(("task", "condition", "policy"), key, strict=True)),
                unit="trial",
                recorded=recorded,
                sim=sim,
                recorded_rate=fraction_of(real),
                sim_rate=fraction_of(twin),
                episodes=(*real.episodes, *twin.episodes) if own else tuple(names_of(both)),
                recorded_common=None if own else recorded_common,
                sim_common=None if own else sim_common,
                trial_table=trial_table(both, [r.sim_planned for r in both]) if both else None,
                executed=executed if _without_plans(members) else None,
            )
        )
    return tuple(groups)


def fraction_of(measurement: Measurement) -> Fraction | None:
    """Return k/n exactly, None where it is not known."""
    k, n = measurement.k, measurement.n
    return None if k is None or not n else Fraction(k, n)


def trial_table(
    both: Sequence[TrialRow], answers: Sequence[bool | None]
) -> tuple[int, int, int, int]:
    """Count trials in which both succeed, only sim, only recorded, neither."""
    table = Counter((bool(yes), bool(row.recorded)) for row, yes in zip(both, answers, strict=True))
    return table[True, True], table[True, False], table[False, True], table[False, False]


def of_group(quantity: Quantity, key: Key, **words: object) -> Defined:
    """Name a measurement of one task, condition and policy."""
    return quantity.of(task=key[0], condition=key[1], policy=key[2], **words)
