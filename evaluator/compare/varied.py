"""Sim estimated again with fresh seeds: what the twin says beyond the replay that chose a plan.

With replanning the accepted plan was selected by the twin, so its one nominal replay is optimistic
by that selection (the winner's curse). ``robot-gst replay RUN --samples K`` replays each plan K
more times with everything varied that is not known exactly. The gate used none of those draws:
those of a replay are named after its recording, those of a gate after the start it was asked about.
"""

from collections.abc import Sequence

from evaluator.compare.measure import measured
from evaluator.compare.rows import TrialRow
from evaluator.compare.success import Key, group_rows, names_of, rate_id
from evaluator.errors import UndefinedStatisticError
from evaluator.result import Cell, Measurement, Table

VARIED_DEFINITION = (
    "mean over trials of the share of varied planned replays of the plan actually sent that "
    "succeed: start, friction, forces, masses, stiffness and timing drawn anew, no draw that the "
    "gate used"
)
GAP_DEFINITION = "sim - sim estimated again, over the trials that have varied replays"
NO_INTERVAL = "means of shares are no counts, and no interval of them was checked for its coverage"


def varied_sim(rows: Sequence[TrialRow]) -> tuple[list[Measurement], tuple[Table, ...]]:
    """Estimate the twin's rates again from varied replays, beside the nominal ones.

    Returns:
        Per task, condition and policy with varied replays: ``rate.sim_varied.*``, and
        ``bias.selection.*``, how far the nominal replays of the same trials lie above them [pp];
        and the table of both. Nothing where no trial has varied replays.
    """
    found: list[Measurement] = []
    lines: list[tuple[Cell, ...]] = []
    for key, members in group_rows(rows).items():
        there = [row for row in members if row.sim_varied is not None]
        if there:
            again, gap = _again(key, there), _gap(key, there)
            found += [again, gap]
            lines.append(_line(key, there, again, gap))
    return found, (_table(lines),) if lines else ()


def _again(key: Key, rows: Sequence[TrialRow]) -> Measurement:
    return measured(
        rate_id("sim_varied", key),
        lambda: _mean(rows),
        unit="1",
        definition=VARIED_DEFINITION,
        n=len(rows),
        counted="trial",
        reason_without_interval=NO_INTERVAL,
        episodes=names_of(rows),
    )


def _gap(key: Key, rows: Sequence[TrialRow]) -> Measurement:
    both = [row for row in rows if row.sim_planned is not None]

    def gap_pp() -> float:
        if not both:
            reason = "no nominal planned replay of these trials was decided"
            raise UndefinedStatisticError(statistic="selection", reason=reason)
        return 100 * (_nominal(both) / len(both) - _mean(both))

    return measured(
        rate_id("selection", key).replace("rate.", "bias.", 1),
        gap_pp,
        unit="pp",
        definition=GAP_DEFINITION,
        n=len(both),
        counted="trial",
        reason_without_interval=NO_INTERVAL,
        episodes=names_of(both),
    )


def _mean(rows: Sequence[TrialRow]) -> float:
    return sum(row.sim_varied for row in rows if row.sim_varied is not None) / len(rows)


def _nominal(rows: Sequence[TrialRow]) -> int:
    return sum(row.sim_planned is True for row in rows)


def _line(
    key: Key, rows: Sequence[TrialRow], again: Measurement, gap: Measurement
) -> tuple[Cell, ...]:
    decided = sum(row.sim_planned is not None for row in rows)
    task, condition, policy = key
    return (
        task,
        condition.replace("_", " "),
        policy,
        f"{_nominal(rows)}/{decided}",
        f"{100 * (again.value or 0.0):.1f} % (n = {len(rows)})",
        None if gap.value is None else round(gap.value, 1),
    )


def _table(lines: Sequence[tuple[Cell, ...]]) -> Table:
    return Table(
        id="sim_varied",
        title="Sim estimated again with fresh seeds",
        columns=("task", "condition", "policy", "sim", "sim, fresh seeds", "difference (pp)"),
        rows=tuple(lines),
        note="sim: nominal planned replays of the plans sent, in trials that have varied replays. "
        "Fresh seeds: the share of each plan's varied replays that succeed, averaged over trials; "
        "what is not known exactly is drawn anew, with no draw the gate used. Where the twin "
        "selected the plans, the difference shows how much of sim is that selection. There are no "
        f"intervals: {NO_INTERVAL}.",
    )
