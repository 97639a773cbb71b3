"""The tables of a report, as plain rows; rounding and colours are left to the report."""

from collections.abc import Sequence

from evaluator.compare.gate import confusion_of, heeded_verdict, unheeded_verdict
from evaluator.compare.rows import RateCell, TrialRow
from evaluator.compare.success import WITH, WITHOUT
from evaluator.result import Measurement, Table


def shown_rate(measurement: Measurement) -> str:
    """Write a rate with its count and interval: ``4/5 = 80.0 % [37.6, 96.4]``."""
    if measurement.value is None:
        return f"undefined: {measurement.reason_if_undefined}"
    percent = f"{100 * measurement.value:.1f} %"
    if measurement.k is None or measurement.n is None:
        return f"{percent} (no n)"
    text = f"{measurement.k}/{measurement.n} = {percent}"
    if measurement.interval is not None:
        low, high = 100 * measurement.interval.low, 100 * measurement.interval.high
        text += f" [{low:.1f}, {high:.1f}]"
    return text


SIM_NOTE = (
    "sim: planned-in-twin, dynamic, of the plan actually sent, replayed from the start localised "
    "again in the recording. With replanning the twin selected the accepted plans, so their sim is "
    "optimistic by that selection: the replay has the gate's engine and nominal physics and draws "
    "nothing new. Replays with --samples estimate it again with fresh seeds, in its own table. "
    "A trial in which no plan was sent has an outcome and no sim."
)


METHOD_NAMES = {
    "wilson": "Wilson",
    "clopper-pearson": "Clopper-Pearson",
    "jeffreys": "Jeffreys",
    "newcombe-10, unpaired": "Newcombe",
    "clopper-pearson-difference, unpaired": "Clopper-Pearson (difference)",
}


def _brackets(shown: Sequence[Measurement]) -> str:
    """Name the intervals that stand in brackets, and say that some are left out if they are."""
    found = [m.interval.method for m in shown if m.interval is not None]
    names = " and ".join(METHOD_NAMES.get(name, name) for name in dict.fromkeys(found))
    said = f"Brackets: 95 % {names} intervals." if found else "There are no intervals."
    if any("; use " in (m.reason_without_interval or "") for m in shown):
        said += " One that would cover too little is left out; measurements say which to use."
    return said


def success_table(cells: Sequence[RateCell], word: str, sim_note: str = SIM_NOTE) -> Table:
    """Success without and with replanning, in the twin and recorded."""
    shown = [side for cell in cells for side in (cell.sim, cell.recorded)]
    rows = tuple(
        (
            cell.task,
            cell.condition.replace("_", " "),
            cell.policy,
            cell.unit,
            shown_rate(cell.sim),
            shown_rate(cell.recorded),
            _gap(cell),
        )
        for cell in cells
    )
    return Table(
        id="success",
        title="Success",
        columns=("task", "condition", "policy", "unit", "sim", word, f"sim - {word} (pp)"),
        rows=rows,
        note=f"{sim_note} {_brackets(shown)} The difference is over trials where both sides are "
        "known.",
    )


def _gap(cell: RateCell) -> float | None:
    if cell.sim_rate is None or cell.recorded_rate is None:
        return None
    return round(float(100 * (cell.sim_rate - cell.recorded_rate)), 1)


def gains_table(gains: Sequence[Measurement], word: str) -> tuple[Table, ...]:
    """The replanning gain: percentage points and relative gain are two columns; none without."""
    points = [m for m in gains if m.id.startswith("gain.pp.")]
    relative = {m.id: m for m in gains if m.id.startswith("gain.relative.")}
    if not points:
        return ()
    rows = []
    for gain in points:
        side, name = gain.id.split(".", 3)[2:]
        rows.append(
            (
                "mean of tasks"
                if name == "average"
                else name.removesuffix(".-").replace(".", ", "),
                word if side == "recorded" else "sim",
                _points(gain),
                _relative(relative[gain.id.replace("gain.pp.", "gain.relative.")]),
            )
        )
    table = Table(
        id="gains",
        title="Gain with replanning",
        columns=("task", "side", "percentage points", "relative gain"),
        rows=tuple(rows),
        note=f"Two different numbers. {_brackets(points)} Groups count as unpaired; an interval "
        "that reaches below 0 does not show a gain.",
    )
    return (table,)


def layout_table(
    cells: Sequence[RateCell], measurements: Sequence[Measurement], word: str
) -> tuple[Table, ...]:
    """Lay rates out as papers print them: a row per task, sim and recorded without and with."""
    conditions = [name for name in (WITHOUT, WITH) if any(c.condition == name for c in cells)]
    if len(conditions) < 2:
        return ()
    found = {(c.task, c.policy, c.condition): c for c in cells}
    rows = []
    for task, policy in dict.fromkeys((c.task, c.policy) for c in cells):
        line: list[str | None] = [task, policy]
        for condition in conditions:
            cell = found.get((task, policy, condition))
            line += [_percent(cell.sim), _percent(cell.recorded)] if cell else [None, None]
        rows.append(tuple(line))
    by_id = {measurement.id: measurement for measurement in measurements}
    for kind in ("macro", "pooled"):
        ids = [
            f"average.{kind}.{side}.{condition}"
            for condition in conditions
            for side in ("sim_planned", "recorded")
        ]
        if all(name in by_id for name in ids):
            rows.append((f"average, {kind}", "", *(_percent(by_id[name]) for name in ids)))
    columns = [
        f"{side}, {condition.replace('_', ' ')}"
        for condition in conditions
        for side in ("sim", word)
    ]
    return (
        Table(
            id="layout",
            title="Success without and with replanning",
            columns=("task", "policy", *columns),
            rows=tuple(rows),
            note="Percent. Macro: every task counts the same. Pooled: every trial counts the same; "
            "undefined where tasks are counted in different units.",
        ),
    )


def _percent(measurement: Measurement) -> str:
    return "undefined" if measurement.value is None else f"{100 * measurement.value:.1f} %"


def _points(gain: Measurement) -> str:
    if gain.value is None:
        return f"undefined: {gain.reason_if_undefined}"
    text = f"{gain.value:+.1f} pp"
    if gain.interval is not None:
        text += f" [{gain.interval.low:+.1f}, {gain.interval.high:+.1f}]"
    return text


def _relative(gain: Measurement) -> str:
    if gain.value is None:
        return f"undefined: {gain.reason_if_undefined}"
    return f"{100 * gain.value:+.1f} %"


def trials_table(rows: Sequence[TrialRow], word: str) -> Table:
    """One line per trial."""
    return Table(
        id="trials",
        title="Trials",
        columns=(
            "episode",
            "task",
            "condition",
            "policy",
            "start",
            word,
            "sim planned",
            "verdict before motion",
            "sim executed",
            "first failing",
            "detail",
        ),
        rows=tuple(
            (
                row.episode,
                row.task,
                row.condition.replace("_", " "),
                row.policy,
                row.start_id,
                _answer(row.recorded),
                _answer(row.sim_planned),
                _answer(row.verdict),
                _answer(row.sim_executed),
                row.first_failing,
                row.failing_detail,
            )
            for row in rows
        ),
        note="sim executed is diagnosis only. Empty: unknown, undecided or not there; the "
        "exclusions say which.",
    )


def confusion_table(rows: Sequence[TrialRow], word: str) -> Table:
    """What the twin said against what happened, counted over trials."""
    lines = []
    for name, said in (
        ("sim planned", lambda row: row.sim_planned),
        ("verdict before motion", lambda row: row.verdict),
        ("verdict, not obeyed (without replanning)", unheeded_verdict),
        ("verdict, obeyed (with replanning)", heeded_verdict),
        ("sim executed (diagnosis)", lambda row: row.sim_executed),
    ):
        counts = confusion_of(rows, said)
        lines.append(
            (
                name,
                counts.true_positive,
                counts.false_positive,
                counts.false_negative,
                counts.true_negative,
                counts.n,
            )
        )
    return Table(
        id="confusion",
        title="What the twin said, and what happened",
        columns=(
            "twin",
            f"said success, {word} success",
            f"said success, {word} failure",
            f"said failure, {word} success",
            f"said failure, {word} failure",
            "trials",
        ),
        rows=tuple(lines),
        note="Trials with a known outcome in which a plan was executed. Said failure by a verdict "
        "before motion: the gate refused the plan and it was executed anyway, because its answer "
        "was only recorded. With replanning refused plans are not executed, so the gate's misses "
        "there show and its false refusals cannot.",
    )


def _answer(value: bool | None) -> str | None:
    return None if value is None else ("success" if value else "failure")
