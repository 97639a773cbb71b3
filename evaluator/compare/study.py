"""A study of replanning: the same starts without, with, and with a coin in the gate's place.

Every declared start is tried once in each arm. Whatever was not executed (all plans refused, no
plan, no verdict, object not found) is a failure of its arm, for otherwise an arm that refuses hard
starts would look better. A start is left out only for a cause that was named before, and then in
all arms.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from bridge.episode.metadata import RETRY, EpisodeInfo, Outcome, treatment_of
from bridge.task.protocol import VOID_CAUSES
from evaluator.compare.measure import proportion
from evaluator.compare.rows import TrialRow
from evaluator.result import Cell, Exclusion, Measurement, Table
from evaluator.study_measurements import STUDY_NOT_EXECUTED

SCOPE = "study of replanning"


@dataclass(frozen=True, kw_only=True)
class StudyStart:
    """One declared start and its trials by arm."""

    task: str
    policy: str
    start_id: str
    trials: dict[str, TrialRow]

    def succeeded(self, arm: str) -> bool:
        """Whether the task was done; what is unknown or was not executed was not."""
        return self.trials[arm].recorded is True

    def executed(self, *arms: str) -> bool:
        """Whether something was executed in all of these arms; a table knows outcomes, no plans."""
        trials = [self.trials[arm] for arm in arms]
        known = [each.plan_id is not None or each.recorded is not None for each in trials]
        return all(known) and not any(each.nothing_executed for each in trials)


def study_starts(
    rows: Sequence[TrialRow], void_causes: Sequence[str] = VOID_CAUSES
) -> tuple[list[StudyStart], list[Exclusion]]:
    """Gather the trials of a study by start; whole starts are left out, never single trials."""
    mine = [row for row in rows if row.study_arm]
    gathered: dict[tuple[str, str, str], list[TrialRow]] = {}
    for row in mine:
        gathered.setdefault((row.task, row.policy, row.start_id or ""), []).append(row)
    planned = {
        (task, policy): {row.study_arm for row in mine if (row.task, row.policy) == (task, policy)}
        for task, policy, _ in gathered
    }
    starts, left_out = [], []
    for (task, policy, start_id), members in gathered.items():
        why = _why_out(start_id, members, planned[task, policy], void_causes)
        if why:
            left_out += [Exclusion(episode=row.episode, scope=SCOPE, reason=why) for row in members]
            continue
        trials = {row.study_arm: row for row in members}
        starts.append(StudyStart(task=task, policy=policy, start_id=start_id, trials=trials))
    return starts, left_out


def _why_out(
    start_id: str, members: Sequence[TrialRow], arms: set[str], void_causes: Sequence[str]
) -> str:
    found = [row.study_arm for row in members]
    if not start_id:
        return "no start_id"
    if len(found) != len(set(found)):
        return f"start {start_id} was tried more than once in one arm"
    if missing := sorted(arms - set(found)):
        return f"start {start_id} was not tried in the arms {', '.join(missing)}"
    for row in members:
        if row.recorded is None and row.why_unknown.startswith(tuple(void_causes)):
            return f"start {start_id} is void in all arms: {row.episode}: {row.why_unknown}"
        if row.recorded is None and row.plan_id is not None:
            return f"start {start_id}: {row.episode} was executed, and nobody knows how it ended"
    return ""


def study_results(
    rows: Sequence[TrialRow],
    void_causes: Sequence[str] = VOID_CAUSES,
    *,
    method: str = "wilson",
) -> tuple[list[Measurement], tuple[Table, ...], list[Exclusion]]:
    """Measure what each arm did not execute, and lay its successes out; nothing without a study.

    Which arm is better is a comparison, as of any two candidates.
    """
    starts, left_out = study_starts(rows, void_causes)
    measurements: list[Measurement] = []
    lines: list[tuple[Cell, ...]] = []
    for policy in dict.fromkeys(start.policy for start in starts):
        mine = [start for start in starts if start.policy == policy]
        tasks = list(dict.fromkeys(start.task for start in mine))
        for task in tasks:
            of_task = [start for start in mine if start.task == task]
            for arm in of_task[0].trials:
                measurements.append(_not_executed(of_task, arm, method))
                lines.append(_arm_line(of_task, arm))
    if not starts:
        return [], (), left_out
    return measurements, (_arms_table(lines),), left_out


def _not_executed(starts: Sequence[StudyStart], arm: str, method: str) -> Measurement:
    left = sum(not start.executed(arm) for start in starts)
    first = starts[0]
    return proportion(
        STUDY_NOT_EXECUTED.of(
            arm=arm,
            task=first.task,
            policy=first.policy,
            words=f"{left} of {len(starts)}, all counted as failures",
        ),
        left,
        len(starts),
        counted="start",
        reason_if_undefined="there are no starts",
        episodes=[start.trials[arm].episode for start in starts],
        method=method,
    )


def _arm_line(starts: Sequence[StudyStart], arm: str) -> tuple[Cell, ...]:
    executed = [start for start in starts if start.executed(arm)]
    return (
        starts[0].task,
        starts[0].policy,
        arm,
        sum(start.succeeded(arm) for start in starts),
        len(starts),
        sum(start.succeeded(arm) for start in executed),
        len(executed),
    )


def _arms_table(lines: Sequence[tuple[Cell, ...]]) -> Table:
    return Table(
        id="study_arms",
        title="Study of replanning: successes by arm",
        columns=("task", "policy", "arm", "k", "starts", "k of executed", "executed"),
        rows=tuple(lines),
        note="without: the planner's first plan. with: the first of at most K plans that the gate "
        "accepts. control: plans chosen by a coin with the gate's share of yes. Every start was "
        "tried in each arm; what was not executed is a failure.",
    )


def retry_table(recorded: Sequence[tuple[EpisodeInfo, Outcome | None]]) -> tuple[Table, ...]:
    """Count new starts after failed executions, beside the first attempts and in none of them.

    Returns:
        The table ``retries``; nothing where no execution was retried.
    """
    groups: dict[tuple[str, str, str], list[Outcome | None]] = {}
    for info, outcome in recorded:
        if info.kind == RETRY:
            name = info.study_arm or treatment_of(info.condition, "")
            groups.setdefault((info.task, info.policy, name), []).append(outcome)
    if not groups:
        return ()
    lines: list[tuple[Cell, ...]] = []
    for key, outcomes in groups.items():
        results = ["unknown" if each is None else each.result for each in outcomes]
        lines.append((*key, results.count("success"), len(results), results.count("unknown")))
    table = Table(
        id="retries",
        title="New starts after a failed execution",
        columns=("task", "policy", "treatment", "k", "retried", "unknown"),
        rows=tuple(lines),
        note="Each is one new start of a trial whose execution failed: objects put back, localised "
        "and planned anew. Only failures are retried, so these are no success rates of trials, and "
        "no other number of this report counts them.",
    )
    return (table,)
