"""Success rates per cell, how the twin's move with the recorded ones, and the replanning gain."""

from collections.abc import Callable, Sequence
from fractions import Fraction
from functools import partial

from evaluator.compare.measure import measured, proportion, slug
from evaluator.compare.rows import RateCell, TrialRow
from evaluator.errors import UndefinedStatisticError
from evaluator.result import Interval, Measurement
from evaluator.statistics import correlation
from evaluator.statistics.proportion import newcombe_difference, relative_gain

WITHOUT = "without_replanning"
WITH = "with_replanning"

SIM_DEFINITION = (
    "successes / trials in the twin: the plan actually sent, planned trajectory, dynamic replay; "
    "with replanning the twin itself selected these plans"
)
EXECUTED_DEFINITION = (
    "successes / trials in the twin: the executed joints re-lived dynamically; diagnosis only, "
    "never part of r"
)
VERDICT_DEFINITION = (
    "plans accepted / plans judged: the gate's verdict on the plan actually sent, before motion; "
    "without replanning it was recorded and not obeyed, with replanning it selected these plans"
)

SIDES: tuple[tuple[str, Callable[[TrialRow], bool | None], str], ...] = (
    ("recorded", lambda row: row.recorded, "successes / trials as labelled by the operator"),
    ("sim_planned", lambda row: row.sim_planned, SIM_DEFINITION),
    ("sim_executed", lambda row: row.sim_executed, EXECUTED_DEFINITION),
    ("verdict", lambda row: row.verdict, VERDICT_DEFINITION),
)


def group_rows(rows: Sequence[TrialRow]) -> dict[tuple[str, str, str], list[TrialRow]]:
    """Gather rows by task, condition and policy; without replanning comes first."""
    groups: dict[tuple[str, str, str], list[TrialRow]] = {}
    for row in rows:
        groups.setdefault((row.task, row.condition, row.policy), []).append(row)
    return dict(
        sorted(groups.items(), key=lambda item: (item[0][0], item[0][2], item[0][1] == WITH))
    )


def side_rates(rows: Sequence[TrialRow]) -> list[Measurement]:
    """Measure every side of every cell, counted in trials; object counts beside them."""
    measurements = []
    for key, members in group_rows(rows).items():
        for side, answer, definition in SIDES:
            known = [row for row in members if answer(row) is not None]
            measurements.append(
                proportion(
                    _rate_id(side, key),
                    sum(answer(row) is True for row in known),
                    len(known),
                    definition=definition,
                    counted="trial",
                    reason_if_undefined=f"none of {len(members)} trials has it",
                    episodes=[row.episode for row in known],
                )
            )
        measurements.extend(_object_rate(key, members))
    return measurements


def _object_rate(key: tuple[str, str, str], members: Sequence[TrialRow]) -> list[Measurement]:
    counted = [row for row in members if row.unit != "trial" and row.k is not None and row.n]
    if not counted:
        return []
    unit = counted[0].unit
    return [
        proportion(
            _rate_id(f"recorded_{unit}", key),
            sum(row.k or 0 for row in counted),
            sum(row.n or 0 for row in counted),
            definition=f"successes / {unit}s as labelled; {unit}s of one trial are not "
            "independent, so the interval is narrower than the trials justify",
            counted=unit,
            reason_if_undefined="no counts",
            episodes=[row.episode for row in counted],
        )
    ]


def never_sent(rows: Sequence[TrialRow]) -> list[Measurement]:
    """Count the plans that were published and never executed; a trials CSV does not say."""
    planned = [row for row in rows if row.num_plans]
    if not planned:
        return []
    made = sum(row.num_plans for row in planned)
    return [
        measured(
            "plans.never_sent",
            lambda: float(made - sum(row.num_plans_sent for row in planned)),
            unit="count",
            definition="plans that were published and never executed, of all plans published; "
            "they are part of no rate",
            n=made,
            counted="plan",
            reason_without_interval="a count",
            episodes=[row.episode for row in planned],
        )
    ]


def rate_cells(rows: Sequence[TrialRow], rates: Sequence[Measurement]) -> tuple[RateCell, ...]:
    """Lay the recorded and the headline sim rate of each cell side by side."""
    by_id = {measurement.id: measurement for measurement in rates}
    cells = []
    for key, members in group_rows(rows).items():
        both = [r for r in members if r.recorded is not None and r.sim_planned is not None]
        num = len(both)
        recorded_common, sim_common = _common_rates(key, both)
        cells.append(
            RateCell(
                task=key[0],
                condition=key[1],
                policy=key[2],
                unit="trial",
                recorded=by_id[_rate_id("recorded", key)],
                sim=by_id[_rate_id("sim_planned", key)],
                recorded_rate=Fraction(sum(r.recorded is True for r in both), num) if num else None,
                sim_rate=Fraction(sum(r.sim_planned is True for r in both), num) if num else None,
                episodes=tuple(row.episode for row in both),
                recorded_common=recorded_common,
                sim_common=sim_common,
            )
        )
    return tuple(cells)


def _common_rates(
    key: tuple[str, str, str], both: Sequence[TrialRow]
) -> tuple[Measurement, Measurement]:
    rates = [
        proportion(
            _rate_id(side, key).replace("rate.", "rate_common.", 1),
            sum(answer(row) is True for row in both),
            len(both),
            definition=f"{definition}; over the trials where both sides are known",
            counted="trial",
            reason_if_undefined="no trial has both sides",
            episodes=[row.episode for row in both],
        )
        for side, answer, definition in SIDES[:2]
    ]
    return rates[0], rates[1]


def cell_agreement(cells: Sequence[RateCell]) -> list[Measurement]:
    """Measure over cells: r, rank correlation, bias, MAE, MMRV in both conventions."""
    usable = [c for c in cells if c.recorded_rate is not None and c.sim_rate is not None]
    recorded = [c.recorded_rate for c in usable if c.recorded_rate is not None]
    sim = [c.sim_rate for c in usable if c.sim_rate is not None]
    units = sorted({cell.unit for cell in usable})
    what = f"over cells (task x condition x policy), n = {len(usable)}"
    what += f", rates counted in different units ({', '.join(units)})" if len(units) > 1 else ""
    shared = len({(c.task, c.policy) for c in usable}) < len(usable)
    make = partial(
        measured,
        n=len(usable),
        counted="cell",
        episodes=[name for cell in usable for name in cell.episodes],
    )
    return [
        make(
            "agreement.pearson_r",
            partial(_pearson, recorded, sim, shared),
            unit="1",
            definition=f"Pearson r of the twin's and the recorded success rates {what}",
            reason_without_interval=_no_interval(len(usable), shared),
        ),
        make(
            "agreement.spearman_rho",
            partial(correlation.spearman, recorded, sim),
            unit="1",
            definition=f"Spearman rank correlation of the same rates {what}; average ranks",
        ),
        make(
            "agreement.bias_pp",
            lambda: 100 * correlation.bias(recorded=recorded, sim=sim),
            unit="pp",
            definition=f"mean of sim rate - recorded rate {what}; above 0 the twin is optimistic",
        ),
        make(
            "agreement.mae_pp",
            lambda: 100 * correlation.mean_absolute_error(recorded=recorded, sim=sim),
            unit="pp",
            definition=f"mean |sim rate - recorded rate| {what}",
        ),
        make(
            "agreement.mmrv_recorded_gap",
            partial(correlation.mmrv, recorded=recorded, sim=sim, gap="recorded"),
            unit="1",
            definition=f"mean maximum rank violation {what}; convention: gap of recorded rates "
            "(SIMPLER equation 1)",
        ),
        make(
            "agreement.mmrv_sim_gap",
            partial(correlation.mmrv, recorded=recorded, sim=sim, gap="sim"),
            unit="1",
            definition=f"mean maximum rank violation {what}; convention: gap of sim rates "
            "(arguments swapped, as some published code does)",
        ),
    ]


def _pearson(
    recorded: Sequence[Fraction], sim: Sequence[Fraction], shared: bool
) -> tuple[float, Interval | None]:
    r = correlation.pearson(recorded, sim)
    if shared or len(recorded) < correlation.MIN_CELLS_INTERVAL or abs(r) >= 1:
        return r, None
    return r, correlation.fisher_interval(r, len(recorded))


def _no_interval(num_cells: int, shared: bool) -> str:
    if num_cells < correlation.MIN_CELLS_INTERVAL:
        return f"{num_cells} cells; Fisher's interval needs {correlation.MIN_CELLS_INTERVAL}"
    if shared:
        return "cells share tasks across conditions; Fisher's interval assumes independent cells"
    return "r is exactly 1 or -1"


def replanning_gains(cells: Sequence[RateCell]) -> list[Measurement]:
    """Measure the gain with replanning per task and side: percentage points and relative."""
    found = {(c.task, c.policy, c.condition): c for c in cells}
    measurements = []
    both: list[tuple[RateCell, RateCell]] = []
    for (task, policy, condition), before in found.items():
        after = found.get((task, policy, WITH))
        if condition != WITHOUT or after is None:
            continue
        both.append((before, after))
        for side in ("recorded", "sim"):
            name = f"{slug(task)}.{slug(policy)}"
            first, second = getattr(before, side), getattr(after, side)
            measurements.extend(_gain(side, name, first, second))
    measurements.extend(_average_gains(both))
    return measurements


def _gain(side: str, name: str, before: Measurement, after: Measurement) -> list[Measurement]:
    def points() -> tuple[float, Interval | None]:
        first, second = _value(before), _value(after)
        if before.k is None or not before.n or after.k is None or not after.n:
            return 100 * (second - first), None
        fraction = newcombe_difference(before.k, before.n, after.k, after.n)
        interval = Interval(
            low=100 * fraction.low,
            high=100 * fraction.high,
            level=fraction.level,
            method=f"{fraction.method}, unpaired",
        )
        return 100 * (second - first), interval

    words = f"{_shown(before)} without and {_shown(after)} with replanning"
    return [
        measured(
            f"gain.pp.{side}.{name}",
            points,
            unit="pp",
            definition=f"gain with replanning in percentage points ({side}): {words}",
            reason_without_interval="no n",
            episodes=(*before.episodes, *after.episodes),
        ),
        measured(
            f"gain.relative.{side}.{name}",
            lambda: relative_gain(_value(before), _value(after)),
            unit="1",
            definition=f"relative gain with replanning ({side}), (with - without) / without: "
            f"{words}; not percentage points",
            episodes=(*before.episodes, *after.episodes),
        ),
    ]


def _average_gains(both: Sequence[tuple[RateCell, RateCell]]) -> list[Measurement]:
    measurements = []
    for side in ("recorded", "sim") if len(both) > 1 else ():
        first = partial(_mean, [getattr(before, side) for before, _ in both])
        second = partial(_mean, [getattr(after, side) for _, after in both])
        what = f"of the unrounded mean rates of {len(both)} tasks ({side})"
        measurements += [
            measured(
                f"gain.pp.{side}.average",
                lambda first=first, second=second: 100 * (second() - first()),  # type: ignore[misc]
                unit="pp",
                definition=f"gain with replanning in percentage points {what}",
                n=len(both),
                counted="task",
                reason_without_interval="tasks may be counted in different units",
            ),
            measured(
                f"gain.relative.{side}.average",
                lambda first=first, second=second: relative_gain(first(), second()),  # type: ignore[misc]
                unit="1",
                definition=f"relative gain with replanning {what}; not percentage points",
                n=len(both),
                counted="task",
            ),
        ]
    return measurements


def _mean(measurements: Sequence[Measurement]) -> float:
    return sum(_value(m) for m in measurements) / len(measurements)


def _value(measurement: Measurement) -> float:
    if measurement.value is None:
        raise UndefinedStatisticError(
            statistic="gain", reason=f"a rate is undefined: {measurement.reason_if_undefined}"
        )
    return measurement.value


def _shown(measurement: Measurement) -> str:
    if measurement.value is None:
        return "undefined"
    if measurement.n is None:
        return f"{measurement.value:.3g}"
    return f"{measurement.k}/{measurement.n}"


def _rate_id(side: str, key: tuple[str, str, str]) -> str:
    return f"rate.{side}.{slug(key[0])}.{slug(key[1])}.{slug(key[2])}"
