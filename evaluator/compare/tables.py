"""The tables of a report as plain rows of numbers; the text made of them is left to the report."""

from collections.abc import Sequence

from evaluator.compare.gate import confusion_of, heeded_verdict, unheeded_verdict
from evaluator.compare.measure import RATE_COLUMNS, rate_row
from evaluator.compare.rows import RateGroup, TrialRow
from evaluator.compare.success import Answer
from evaluator.result import Table

EXECUTED = "executed in twin"
"""The twin's side of a group in which nobody published a plan."""
EXECUTED_NOTE = "executed in twin: the recorded joints, replayed dynamically; there was no plan."
SIM_NOTE = (
    "twin: the plan actually sent, replayed with physics from the start localised again in the "
    "recording. With replanning the twin selected the accepted plans, so its rate is optimistic by "
    "that selection: the replay has the gate's engine and nominal physics and draws nothing new. "
    "A trial in which no plan was sent is recorded only."
)
UNPAIRED_NOTE = "Each side counts its own trials; none was made on both."
METHOD_NAMES = {
    "wilson": "Wilson",
    "score": "score",
    "tango": "Tango",
    "repeated-score": "repeated score",
    "populations": "model of populations",
}


def _brackets(groups: Sequence[RateGroup]) -> str:
    """Name the intervals that stand in brackets, or say that there are none."""
    shown = [side.interval for group in groups for side in (group.shown_sim, group.recorded)]
    found = [interval.method for interval in shown if interval is not None]
    known = {name: METHOD_NAMES.get(name.removeprefix("mean-"), name) for name in found}
    names = " and ".join(dict.fromkeys(known.values()))
    return f"Brackets: 95 % {names} intervals." if found else "There are no intervals."


def success_table(groups: Sequence[RateGroup], word: str, source_note: str = "") -> Table:
    """Success without and with replanning, in the twin and recorded."""
    twin = not source_note or any(group.shown_sim.value is not None for group in groups)
    paired = any(group.trial_table is not None for group in groups)
    one_sided = any(group.sim.n for group in groups) and not paired
    note = EXECUTED_NOTE if all(group.executed is not None for group in groups) else SIM_NOTE
    parts = [source_note or (UNPAIRED_NOTE if one_sided else note), _brackets(groups)]
    if paired:
        parts.append("The difference is over trials where both sides are known.")
    rows = tuple(
        (
            *(group.task, group.condition, group.policy, side, group.unit),
            *rate_row(rate),
            None if (gap := group.gap) is None else round(float(100 * gap), 1),
            rate.reason_if_undefined,
        )
        for group in groups
        for side, rate in (
            ("sim" if group.executed is None else EXECUTED, group.shown_sim),
            (word, group.recorded),
        )
        if twin or rate is group.recorded
    )
    return Table(
        id="success",
        title="Success rates",
        columns=(
            *("task", "condition", "policy", "side", "unit"),
            *(*RATE_COLUMNS, f"sim - {word} (pp)", "why undefined"),
        ),
        rows=rows,
        note=" ".join(parts),
    )


def trials_table(rows: Sequence[TrialRow], word: str) -> Table:
    """One line per trial."""
    return Table(
        id="trials",
        title="Trials",
        columns=(
            *("episode", "task", "condition", "policy", "start", word, "sim planned"),
            *("verdict before motion", "sim executed", "first failing", "detail"),
        ),
        rows=tuple(
            (
                *(row.episode, row.task, row.condition.replace("_", " "), row.policy, row.start_id),
                *map(_ANSWERS.get, (row.recorded, row.sim_planned, row.verdict, row.sim_executed)),
                *(row.first_failing, row.failing_detail),
            )
            for row in rows
        ),
        note="twin executed is diagnosis only. Empty: unknown, undecided or not there; the "
        "exclusions say which.",
    )


def confusion_table(rows: Sequence[TrialRow], word: str) -> Table:
    """What the twin said against what happened, counted over trials."""
    ends = ("success", "failure")
    kinds = [f"predicted {foretold}, {word} {end}" for foretold in ends for end in ends]
    sides: tuple[tuple[str, Answer], ...] = (
        ("sim planned", lambda row: row.sim_planned),
        ("verdict before motion", lambda row: row.verdict),
        ("verdict, not obeyed (without replanning)", unheeded_verdict),
        ("verdict, obeyed (with replanning)", heeded_verdict),
        ("sim executed (diagnosis)", lambda row: row.sim_executed),
    )
    counted = [(name, confusion_of(rows, answer_of)) for name, answer_of in sides]
    return Table(
        id="confusion",
        title="Prediction of the twin against the outcome",
        columns=("twin", *kinds, "trials"),
        rows=tuple((name, *counts, counts.n) for name, counts in counted),
        note="Trials with a known outcome in which a plan was executed. A verdict before motion "
        "that predicted failure refused the plan; it was executed anyway, because the answer was "
        "only recorded. With replanning refused plans are not executed, so the gate's misses there "
        "show and its false refusals cannot.",
    )


_ANSWERS = {True: "success", False: "failure", None: None}
