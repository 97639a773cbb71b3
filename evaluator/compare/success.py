"""Success rates per task, condition and policy, in the twin and recorded, and their averages."""

from collections.abc import Callable, Iterable, Sequence
from fractions import Fraction
from functools import partial

from bridge.episode.executions import NO_PLAN
from bridge.episode.metadata import CONTROL
from bridge.episode.metadata import WITH as WITH
from bridge.episode.metadata import WITHOUT as WITHOUT
from evaluator.compare.measure import proportion
from evaluator.compare.rows import RateGroup, TrialRow
from evaluator.measurements import (
    RATE_BY_UNIT,
    RATES,
    RATES_IN_COMMON,
    Defined,
    Quantity,
)
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
    groups: dict[Key, list[TrialRow]] = {}
    for row in rows:
        groups.setdefault((row.task, row.condition, row.policy), []).append(row)
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


def trials_in(rows: Iterable[TrialRow]) -> int:
    """Count trials."""
    return sum(1 for _ in rows)


def names_of(rows: Iterable[TrialRow]) -> list[str]:
    """List the episodes of rows that stand for one trial each."""
    return [row.episode for row in rows if row.episode]


def answered(
    defined: Defined,
    rows: Sequence[TrialRow],
    answer: Answer,
    *,
    reason_if_undefined: str,
) -> Measurement:
    """Measure the share of yes among the trials whose answer is known."""
    known = [row for row in rows if answer(row) is not None]
    return proportion(
        defined,
        trials_in(row for row in known if answer(row)),
        trials_in(known),
        counted="trial",
        reason_if_undefined=reason_if_undefined,
        episodes=names_of(known),
    )


def side_rates(rows: Sequence[TrialRow]) -> list[Measurement]:
    """Measure every side of every group, counted in trials; object counts beside them."""
    measurements = []
    for key, members in group_rows(rows).items():
        for side, answer in SIDES.items():
            measurements.append(
                answered(
                    of_group(RATES[side], key),
                    members,
                    answer,
                    reason_if_undefined="no plan"
                    if side == "sim_planned" and _without_plans(members)
                    else f"none of {trials_in(members)} trials has it",
                )
            )
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
    unit = counted[0].unit
    mixed = len(by_unit) > 1
    firsts = " and ".join(f"{row.episode} in {name}s" for name, row in sorted(by_unit.items()))
    return [
        proportion(
            of_group(RATE_BY_UNIT, key, unit=unit),
            0 if mixed else sum(row.k or 0 for row in counted),
            0 if mixed else sum(row.n or 0 for row in counted),
            counted=unit,
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
        recorded, sim = (
            by_id[of_group(RATES[side], key).id] for side in ("recorded", "sim_planned")
        )
        recorded_common, sim_common = (
            answered(
                of_group(common, key),
                both,
                SIDES[side],
                reason_if_undefined="no trial has both sides",
            )
            for side, common in RATES_IN_COMMON.items()
        )
        group = partial(
            RateGroup,
            task=key[0],
            condition=key[1],
            policy=key[2],
            unit="trial",
            recorded=recorded,
            sim=sim,
            executed=by_id[of_group(RATES["sim_executed"], key).id]
            if _without_plans(members)
            else None,
        )
        if not both and recorded.n and sim.n:  # each side has trials of its own
            own_rates = fraction_of(recorded), fraction_of(sim)
            names = (*recorded.episodes, *sim.episodes)
            groups.append(group(recorded_rate=own_rates[0], sim_rate=own_rates[1], episodes=names))
            continue
        groups.append(
            group(
                recorded_rate=fraction_of(recorded_common),
                sim_rate=fraction_of(sim_common),
                episodes=tuple(names_of(both)),
                recorded_common=recorded_common,
                sim_common=sim_common,
                trial_table=(
                    trial_table(both, [row.sim_planned for row in both]) if both else None
                ),
            )
        )
    return tuple(groups)


def fraction_of(measurement: Measurement) -> Fraction | None:
    """Return k/n exactly, None where it is not known."""
    if measurement.k is None or not measurement.n:
        return None
    return Fraction(measurement.k, measurement.n)


def trial_table(
    both: Sequence[TrialRow], answers: Sequence[bool | None]
) -> tuple[int, int, int, int]:
    """Count trials in which both succeed, only sim, only recorded, neither."""
    table = [0, 0, 0, 0]
    for row, yes in zip(both, answers, strict=True):
        place = (0 if row.recorded else 1) if yes else (2 if row.recorded else 3)
        table[place] += 1
    return table[0], table[1], table[2], table[3]


def of_group(quantity: Quantity, key: Key, **words: object) -> Defined:
    """Name a measurement of one task, condition and policy."""
    return quantity.of(task=key[0], condition=key[1], policy=key[2], **words)
