"""Over cells: do the twin's success rates move with the recorded ones, and how far off are they?"""

from collections.abc import Sequence
from fractions import Fraction
from functools import partial

import numpy as np

from evaluator.compare.measure import measured, slug
from evaluator.compare.rows import RateCell
from evaluator.errors import UndefinedStatisticError
from evaluator.result import Interval, Measurement
from evaluator.statistics import agreement, bootstrap, correlation

SEED = 0
"""Resampling is seeded: the same cells give the same interval."""
MIN_CLUSTERS = 4


def cell_agreement(cells: Sequence[RateCell]) -> list[Measurement]:
    """Measure over cells: r, ranks, bias, errors, calibration line, MMRV in both conventions."""
    usable = usable_cells(cells)
    recorded, sim = sides(usable)
    units = sorted({cell.unit for cell in usable})
    what = f"over cells (task x condition x policy), n = {len(usable)}"
    what += f", rates counted in different units ({', '.join(units)})" if len(units) > 1 else ""
    make = partial(
        measured,
        n=len(usable),
        counted="cell",
        episodes=[name for cell in usable for name in cell.episodes],
    )
    gaps = [s - r for r, s in zip(recorded, sim, strict=True)]
    plain = "a plain description of these cells"
    return [
        _pearson(usable, "agreement.pearson_r", what),
        *_pearson_by_condition(usable),
        make(
            "agreement.pearson_r_remeasured",
            partial(_remeasured, usable),
            unit="1",
            definition=f"the same r {what}; its band is where r would fall if the same cells were "
            "measured again with as many trials",
            coverage_key="remeasurement",
        ),
        make(
            "agreement.spearman_rho",
            partial(correlation.spearman, recorded, sim),
            unit="1",
            definition=f"Spearman rank correlation of the same rates {what}; average ranks",
            reason_without_interval=plain,
        ),
        make(
            "agreement.kendall_tau_b",
            partial(correlation.kendall, recorded, sim),
            unit="1",
            definition=f"Kendall's tau-b of the same rates {what}",
            reason_without_interval=plain,
        ),
        make(
            "agreement.bias_pp",
            partial(_mean_gap, gaps, usable),
            unit="pp",
            definition=f"mean of sim rate - recorded rate {what}; above 0 the twin is optimistic",
            interval_n=_clusters(usable)[1],
            coverage_key=f"student-t:{'' if _clusters(usable)[2] == 'cells' else 'cluster-'}bias",
            reason_without_interval=_too_few_means(usable),
        ),
        make(
            "agreement.mae_pp",
            lambda: 100 * agreement.mean_absolute_error(recorded=recorded, sim=sim),
            unit="pp",
            definition=f"mean |sim rate - recorded rate| {what}",
            reason_without_interval="resampled cells cover too little for absolute errors",
        ),
        make(
            "agreement.rmse_pp",
            lambda: 100 * agreement.root_mean_square_error(recorded=recorded, sim=sim),
            unit="pp",
            definition=f"square root of the mean (sim rate - recorded rate)^2 {what}",
            reason_without_interval=plain,
        ),
        make(
            "agreement.largest_gap_pp",
            lambda: 100 * agreement.largest_gap(recorded=recorded, sim=sim),
            unit="pp",
            definition=f"largest |sim rate - recorded rate| {what}",
            reason_without_interval=plain,
        ),
        *_line_and_ranks(recorded, sim, what, make),
    ]


def _line_and_ranks(
    recorded: Sequence[Fraction], sim: Sequence[Fraction], what: str, make: "partial[Measurement]"
) -> list[Measurement]:
    plain = "a plain description of these cells"
    return [
        make(
            "agreement.calibration_slope",
            lambda: agreement.calibration_line(recorded=recorded, sim=sim).slope,
            unit="1",
            definition=f"slope of recorded = a + b x sim, least squares {what}; 1 is calibrated, "
            "noise pulls it towards 0",
            reason_without_interval=plain,
        ),
        make(
            "agreement.calibration_intercept_pp",
            lambda: 100 * agreement.calibration_line(recorded=recorded, sim=sim).intercept,
            unit="pp",
            definition=f"intercept of the same line {what}",
            reason_without_interval=plain,
        ),
        make(
            "agreement.order_accuracy",
            lambda: agreement.order_accuracy(recorded=recorded, sim=sim).value,
            unit="1",
            definition="pairs of cells that the twin orders as the recorded rates do / pairs whose "
            f"recorded rates differ; a tie in the twin counts 1/2; {what}",
            reason_without_interval="pairs share cells",
        ),
        make(
            "agreement.mmrv_recorded_gap",
            partial(agreement.mmrv, recorded=recorded, sim=sim, gap="recorded"),
            unit="1",
            definition=f"mean maximum rank violation {what}; convention: gap of recorded rates "
            "(SIMPLER equation 1)",
            reason_without_interval="a mean of maxima has no honest interval from so few cells",
        ),
        make(
            "agreement.mmrv_sim_gap",
            partial(agreement.mmrv, recorded=recorded, sim=sim, gap="sim"),
            unit="1",
            definition=f"mean maximum rank violation {what}; convention: gap of sim rates "
            "(arguments swapped, as some published code does)",
            reason_without_interval="a mean of maxima has no honest interval from so few cells",
        ),
    ]


def usable_cells(cells: Sequence[RateCell]) -> list[RateCell]:
    """Return the cells with both rates."""
    return [c for c in cells if c.recorded_rate is not None and c.sim_rate is not None]


def sides(cells: Sequence[RateCell]) -> tuple[list[Fraction], list[Fraction]]:
    """Return recorded and sim rates of usable cells."""
    recorded = [c.recorded_rate for c in cells if c.recorded_rate is not None]
    return recorded, [c.sim_rate for c in cells if c.sim_rate is not None]


def _is_shared(cells: Sequence[RateCell]) -> bool:
    return len({(c.task, c.policy) for c in cells}) < len(cells)


def _clusters(cells: Sequence[RateCell]) -> tuple[list[str], int, str]:
    """Return what each cell belongs to, how many of those there are, and their name."""
    policies, tasks = [c.policy for c in cells], [c.task for c in cells]
    if not _is_shared(cells) and len(set(policies)) in (1, len(cells)):
        return [str(i) for i in range(len(cells))], len(cells), "cells"
    if len(set(policies)) >= MIN_CLUSTERS or len(set(policies)) > len(set(tasks)):
        return policies, len(set(policies)), "policies"
    return tasks, len(set(tasks)), "tasks"


def _pearson(cells: Sequence[RateCell], name: str, what: str) -> Measurement:
    recorded, sim = sides(cells)
    clusters, count, kind = _clusters(cells)
    alone = kind == "cells"

    def compute() -> tuple[float, Interval | None]:
        r = correlation.pearson(recorded, sim)
        if alone and len(cells) >= correlation.MIN_CELLS_INTERVAL and abs(r) < 1:
            return r, correlation.fisher_interval(r, len(cells))
        if alone or count < MIN_CLUSTERS:
            return r, None
        try:
            interval = bootstrap.bootstrap_interval(
                "pearson",
                recorded=recorded,
                sim=sim,
                rng=np.random.default_rng(SEED),
                clusters=clusters,
            )
        except UndefinedStatisticError:
            return r, None
        return r, interval

    resampled = f"; interval: {kind} resampled" if not alone and count >= MIN_CLUSTERS else ""
    return measured(
        name,
        compute,
        unit="1",
        definition=f"Pearson r of the twin's and the recorded success rates {what}{resampled}",
        n=len(cells),
        counted="cell",
        reason_without_interval=_no_interval(len(cells), _is_shared(cells), count, kind),
        episodes=[episode for cell in cells for episode in cell.episodes],
        interval_n=count,
        coverage_key="fisher-z" if alone else "bootstrap-clusters:pearson",
    )


def _pearson_by_condition(cells: Sequence[RateCell]) -> list[Measurement]:
    conditions = list(dict.fromkeys(cell.condition for cell in cells))
    if len(conditions) < 2:
        return []
    return [
        _pearson(
            [cell for cell in cells if cell.condition == condition],
            f"agreement.pearson_r.{slug(condition)}",
            f"over cells {condition} only",
        )
        for condition in conditions
    ]


def _no_interval(num_cells: int, shared: bool, count: int, kind: str) -> str:
    if num_cells < correlation.MIN_CELLS_INTERVAL:
        return f"{num_cells} cells; Fisher's interval needs {correlation.MIN_CELLS_INTERVAL}"
    if kind == "cells":
        return "r is exactly 1 or -1"
    why = "cells share tasks across conditions" if shared else "cells share policies or tasks"
    why += "; Fisher's interval assumes independent cells"
    return f"{why}, and {count} {kind} are too few to resample ({MIN_CLUSTERS} are needed)"


def _remeasured(cells: Sequence[RateCell]) -> tuple[float, Interval | None]:
    r = correlation.pearson(*sides(cells))
    rng = np.random.default_rng(SEED)
    try:
        tables = [cell.trial_table for cell in cells if cell.trial_table is not None]
        if len(tables) == len(cells):
            return r, bootstrap.remeasurement_band(tables, rng=rng)
        pairs = [cell.pair for cell in cells]
        sim = [(s.k, s.n) for s, _ in pairs if s.k is not None and s.n]
        recorded = [(r.k, r.n) for _, r in pairs if r.k is not None and r.n]
        if len(sim) == len(recorded) == len(cells):
            return r, bootstrap.remeasurement_band_of_counts(recorded, sim, rng=rng)
    except UndefinedStatisticError:
        return r, None
    raise UndefinedStatisticError(
        statistic="remeasured r", reason="the number of trials of a cell is not known"
    )


def _mean_gap(gaps: Sequence[Fraction], cells: Sequence[RateCell]) -> tuple[float, Interval | None]:
    """Mean gap with Student's interval over the means of what the cells belong to."""
    recorded, sim = sides(cells)
    value = 100 * agreement.bias(recorded=recorded, sim=sim)
    clusters, _, _ = _clusters(cells)
    members: dict[str, list[Fraction]] = {}
    for name, gap in zip(clusters, gaps, strict=True):
        members.setdefault(name, []).append(100 * gap)
    if len({len(values) for values in members.values()}) != 1:
        return value, None
    try:
        means = [sum(values) / len(values) for values in members.values()]
        return value, bootstrap.student_interval(means)
    except UndefinedStatisticError:
        return value, None


def _too_few_means(cells: Sequence[RateCell]) -> str:
    _, count, kind = _clusters(cells)
    return f"{count} {kind}, or unequally many cells in each; Student's interval needs 3 alike"
