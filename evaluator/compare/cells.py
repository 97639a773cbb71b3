"""Over cells: do the twin's success rates move with the recorded ones, and how far off are they?"""

from collections.abc import Callable, Sequence
from functools import partial

from evaluator.compare.cell_intervals import CellIntervals, interval_table, sides, usable_cells
from evaluator.compare.measure import measured, slug
from evaluator.compare.rows import RateCell
from evaluator.errors import UndefinedStatisticError
from evaluator.result import Interval, Measurement, Table
from evaluator.statistics import agreement, correlation
from evaluator.statistics.columns import Number

Statistic = Callable[[], float]
TABLE: tuple[tuple[str, str, float], ...] = (
    ("Pearson r", "pearson", 1.0),
    ("Spearman rho", "spearman", 1.0),
    ("Kendall tau-b", "kendall", 1.0),
    ("bias (pp)", "bias", 100.0),
    ("mean absolute error (pp)", "mae", 100.0),
    ("root mean square error (pp)", "rmse", 100.0),
    ("calibration slope", "slope", 1.0),
    ("calibration intercept (pp)", "intercept", 100.0),
    ("pairwise order accuracy", "order", 1.0),
    ("MMRV, recorded gap", "mmrv-recorded", 1.0),
    ("MMRV, sim gap", "mmrv-sim", 1.0),
)
"""Words, name of the statistic, and factor to the printed unit."""


def cell_agreement(cells: Sequence[RateCell]) -> list[Measurement]:
    """Measure over cells: r, ranks, bias, errors, calibration line, MMRV in both conventions."""
    usable = usable_cells(cells)
    intervals = CellIntervals(usable)
    units = sorted({cell.unit for cell in usable})
    what = f"over cells (task x condition x policy), n = {len(usable)}"
    what += f", rates counted in different units ({', '.join(units)})" if len(units) > 1 else ""
    make = partial(_measure, usable, intervals, what)
    return [
        _pearson(usable, "agreement.pearson_r", what),
        *_pearson_by_condition(usable),
        _remeasured(usable, intervals, what),
        *_errors(usable, make),
        *_line_and_ranks(usable, make),
        measured(
            "agreement.largest_gap_pp",
            lambda: 100 * agreement.largest_gap(**_both(usable)),
            unit="pp",
            definition=f"largest |sim rate - recorded rate| {what}",
            n=len(usable),
            counted="cell",
            reason_without_interval="a largest value grows with the number of cells",
            episodes=_episodes(usable),
        ),
    ]


def agreement_intervals(cells: Sequence[RateCell]) -> tuple[Table, ...]:
    """Lay out the interval of every statistic, over other cells and over a new measurement."""
    return interval_table(CellIntervals(usable_cells(cells)), TABLE)


def _both(cells: Sequence[RateCell]) -> dict[str, list[Number]]:
    recorded, sim = sides(cells)
    return {"recorded": [*recorded], "sim": [*sim]}


def _episodes(cells: Sequence[RateCell]) -> list[str]:
    return [name for cell in cells for name in cell.episodes]


def _measure(
    cells: Sequence[RateCell],
    intervals: CellIntervals,
    what: str,
    name: str,
    statistic: str,
    value: Statistic,
    unit: str,
    definition: str,
) -> Measurement:
    """Measure one statistic with the interval that the coverage map chooses for it."""
    factor = 100.0 if unit == "pp" else 1.0
    found = intervals.of(statistic)

    def compute() -> tuple[float, Interval | None]:
        interval = found.interval
        if interval is not None and factor != 1:
            interval = Interval(
                low=factor * interval.low,
                high=factor * interval.high,
                level=interval.level,
                method=interval.method,
            )
        return factor * value(), interval

    resampled = f"; interval: {intervals.unit} resampled" if intervals.kind == "clusters" else ""
    return measured(
        name,
        compute,
        unit=unit,
        definition=f"{definition.format(what)}{resampled}",
        n=len(cells),
        counted="cell",
        reason_without_interval=found.reason,
        episodes=_episodes(cells),
        interval_n=found.num_units,
        coverage_key=found.choice.key,
        instead=found.choice.instead,
    )


def _errors(cells: Sequence[RateCell], make: "partial[Measurement]") -> list[Measurement]:
    both = _both(cells)
    return [
        make(
            "agreement.spearman_rho",
            "spearman",
            lambda: correlation.spearman(both["recorded"], both["sim"]),
            "1",
            "Spearman rank correlation of the same rates {}; average ranks",
        ),
        make(
            "agreement.kendall_tau_b",
            "kendall",
            lambda: correlation.kendall(both["recorded"], both["sim"]),
            "1",
            "Kendall's tau-b of the same rates {}",
        ),
        make(
            "agreement.bias_pp",
            "bias",
            lambda: agreement.bias(**both),
            "pp",
            "mean of sim rate - recorded rate {}; above 0 the twin is optimistic",
        ),
        make(
            "agreement.mae_pp",
            "mae",
            lambda: agreement.mean_absolute_error(**both),
            "pp",
            "mean |sim rate - recorded rate| {}",
        ),
        make(
            "agreement.rmse_pp",
            "rmse",
            lambda: agreement.root_mean_square_error(**both),
            "pp",
            "square root of the mean (sim rate - recorded rate)^2 {}",
        ),
    ]


def _line_and_ranks(cells: Sequence[RateCell], make: "partial[Measurement]") -> list[Measurement]:
    both = _both(cells)
    return [
        make(
            "agreement.calibration_slope",
            "slope",
            lambda: agreement.calibration_line(**both).slope,
            "1",
            "slope of recorded = a + b x sim, least squares {}; 1 is calibrated, noise pulls it "
            "towards 0",
        ),
        make(
            "agreement.calibration_intercept_pp",
            "intercept",
            lambda: agreement.calibration_line(**both).intercept,
            "pp",
            "intercept of the same line {}",
        ),
        make(
            "agreement.order_accuracy",
            "order",
            lambda: agreement.order_accuracy(**both).value,
            "1",
            "pairs of cells that the twin orders as the recorded rates do / pairs whose recorded "
            "rates differ; a tie in the twin counts 1/2; {}",
        ),
        make(
            "agreement.mmrv_recorded_gap",
            "mmrv-recorded",
            partial(agreement.mmrv, **both, gap="recorded"),
            "1",
            "mean maximum rank violation {}; convention: gap of recorded rates (SIMPLER equation "
            "1); it grows with the number of cells",
        ),
        make(
            "agreement.mmrv_sim_gap",
            "mmrv-sim",
            partial(agreement.mmrv, **both, gap="sim"),
            "1",
            "mean maximum rank violation {}; convention: gap of sim rates (arguments swapped, as "
            "some published code does); it grows with the number of cells",
        ),
    ]


def _pearson(cells: Sequence[RateCell], name: str, what: str) -> Measurement:
    recorded, sim = sides(cells)
    return _measure(
        cells,
        CellIntervals(cells),
        what,
        name,
        "pearson",
        lambda: correlation.pearson(recorded, sim),
        "1",
        "Pearson r of the twin's and the recorded success rates {}",
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


def _remeasured(cells: Sequence[RateCell], intervals: CellIntervals, what: str) -> Measurement:
    recorded, sim = sides(cells)

    def compute() -> tuple[float, Interval | None]:
        r = correlation.pearson(recorded, sim)
        again = intervals.again()
        try:
            return r, again.band("pearson")
        except UndefinedStatisticError:
            return r, None

    return measured(
        "agreement.pearson_r_remeasured",
        compute,
        unit="1",
        definition=f"the same r {what}; its band is where r would fall if the same cells were "
        "measured again with as many trials",
        n=len(cells),
        counted="cell",
        reason_without_interval="r is exactly 1 or -1, or no other outcome changes it",
        episodes=_episodes(cells),
        coverage_key="remeasurement",
    )
