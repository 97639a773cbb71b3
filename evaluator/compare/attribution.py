"""Why trials of a policy end otherwise than its rollouts: what it does, or what comes of that."""

from collections import Counter
from collections.abc import Sequence

from evaluator.compare.measure import grouped
from evaluator.compare.rows import TrialRow
from evaluator.result import Cell, Table

AGREE, WORLD, ACTIONS, UNKNOWN = "end alike", "world", "actions", "not known"
"""``WORLD``: the trial's own motion, replayed in the twin, ends as the rollout did. ``ACTIONS``:
it ends as the trial did, so that the policy did something else in the rollout."""
COLUMNS = {WORLD: "same motion, other end", ACTIONS: "other motion"}
SAID = {
    WORLD: "The same motion ends otherwise in the twin: ",
    ACTIONS: "The policy moved otherwise in the twin: ",
}


def attributed(row: TrialRow) -> str | None:
    """To what a difference of trial and rollout is due; None where one of them is not known."""
    if not row.is_rolled_out or row.recorded is None or row.sim_planned is None:
        return None
    if row.recorded == row.sim_planned:
        return AGREE
    if row.sim_executed is None:
        return UNKNOWN
    return ACTIONS if row.sim_executed == row.recorded else WORLD


def attribution_table(rows: Sequence[TrialRow]) -> tuple[Table, ...]:
    """Count by task and policy; nothing where no policy was rolled out."""
    known = [(row, found) for row in rows if (found := attributed(row)) is not None]
    by_group = grouped(known, lambda item: (item[0].task, item[0].policy))
    if not by_group:
        return ()
    lines: list[dict[str, Cell]] = []
    for (task, policy), members in [*by_group.items(), (("", "all"), known)]:
        counts = Counter(found for _, found in members)
        line: dict[str, Cell] = {"task": task, "policy": policy, "trials": len(members)}
        for kind in (AGREE, WORLD, ACTIONS, UNKNOWN):
            line[COLUMNS.get(kind, kind)] = counts[kind]
        lines.append(line)
    table = Table.of(
        lines,
        id="attribution",
        title="Why trials and rollouts differ",
        note="Same motion, other end: the recorded joints, replayed in the twin's physics, end as "
        "the rollout did and not as the trial. Other motion: they end as the trial did, so the "
        "policy acted otherwise on what it saw, or on what had come of its first actions. Not "
        "known: robot-gst replay has not replayed the trial.",
    )
    return (table,)
