"""A study against its locked protocol: every departure from it."""

from bisect import bisect_left
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

from bridge.episode.metadata import treatment_of
from bridge.task.protocol import FILE_NAME, Endpoint, Protocol
from evaluator.compare.measure import Part, measured
from evaluator.compare.policies import Answer
from evaluator.compare.rows import TrialRow, in_order
from evaluator.compare.success import CONDITION_OF_ARM
from evaluator.measurements import PROTOCOL_DEPARTURES
from evaluator.result import Cell, Exclusion, Table

Departure = tuple[str, str, Cell, Cell]
"""What departs, where, what was planned, and what was done."""
ARM_OF_CONDITION = {condition: arm for arm, condition in CONDITION_OF_ARM.items()}
NO_HASH = "0" * 64
SHOWN = 8
"""Names that one line of departures lists."""


def as_designed(rows: Sequence[TrialRow], protocol: Protocol | None) -> list[TrialRow]:
    """Return rows with blinding codes resolved and arms named as a design has them.

    Trials of a table have a condition and no arm; a line of the operator's list that nobody filled
    in is no trial.
    """
    if protocol is None or protocol.primary is None:
        return list(rows)
    arms = {code: name.rpartition(", ")[::2] for name, code in protocol.codes.items()}
    arms_of = {each.policy: each.arms for each in protocol.policies}
    found = []
    for row in rows:
        if not row.file and {row.recorded, row.sim_planned, row.plan_id} == {None}:
            continue
        policy, arm = arms.get(row.policy, (row.policy, ""))
        if not row.condition and len(arms_of.get(policy, ())) == 1:  # an import names none
            (arm,) = arms_of[policy]
        if arm:
            condition = treatment_of(CONDITION_OF_ARM[arm], arm)
            row = replace(row, policy=policy, condition=condition)  # noqa: PLW2901
        if not row.study_arm and row.policy in arms_of:
            arm = ARM_OF_CONDITION.get(row.condition, "")
            row = replace(row, study_arm=arm)  # noqa: PLW2901
        found.append(row)
    return found


def protocol_results(
    rows: Sequence[TrialRow],
    protocol: Protocol | None,
    *,
    answers: Sequence[Answer] = (),
    left_out: Sequence[Exclusion] = (),
    task_hashes: Mapping[str, frozenset[str]] | None = None,
) -> Part:
    """Compare a study, and the answers its design asked for, with it; nothing without one."""
    if protocol is None or protocol.primary is None:
        return Part()
    mine = [row for row in rows if row.study_arm]
    declared = ", ".join(protocol.void_causes)
    found: list[Departure] = [
        *_of_file(protocol, task_hashes or {}),
        *_of_trials(rows, mine, protocol),
        *_of_starts(mine, protocol),
        *_of_order(mine, protocol),
        *(("exclusion not declared", item.episode, declared, item.reason) for item in left_out),
        *_unanswered(answers, protocol.primary),
    ]
    count = measured(
        PROTOCOL_DEPARTURES.of(),
        lambda: float(len(found)),
        n=len(mine),
        counted="trial",
        reason_without_interval="a count",
    )
    trials = len(protocol.order())
    table = Table(
        id="protocol_departures",
        title="Departures from the protocol" if found else "No departure from the protocol",
        columns=("what", "where", "planned", "done"),
        rows=tuple(found) or (("none", f"{trials} trials as planned", None, None),),
        note=f"{FILE_NAME}, sha256 {protocol.sha256 or 'not there'}: {trials} trials in a drawn "
        f"order, stopping {protocol.stopping}, declared exclusions: {declared}.",
    )
    return Part(measurements=(count,), tables=(table,))


def _of_file(protocol: Protocol, task_hashes: Mapping[str, frozenset[str]]) -> Iterable[Departure]:
    if protocol.edited:
        found = "the content does not fit the hash: edited after it was written"
        yield "protocol", FILE_NAME, protocol.sha256, found
    elif not protocol.sha256:
        yield "protocol", FILE_NAME, "a hash", "none: an edit would not be seen"
    if protocol.interval != "wilson":
        yield "analysis", "interval of rates", protocol.interval, "wilson"
    for task in protocol.tasks:
        other = task_hashes.get(task.task, frozenset()) - {task.task_sha256}
        if other and task.task_sha256 != NO_HASH:
            names = ", ".join(sorted(name[:12] for name in other))
            yield "task file", task.task, task.task_sha256[:12], names


def _of_trials(
    rows: Sequence[TrialRow], mine: Sequence[TrialRow], protocol: Protocol
) -> Iterable[Departure]:
    """Count trials of each task, policy and arm, and name what was not planned at all."""
    done = Counter((row.task, row.policy, row.study_arm) for row in mine)
    starts = {task.task: task.starts for task in protocol.tasks}
    arms = {(each.policy, arm) for each in protocol.policies for arm in each.arms}
    for task, planned in starts.items():
        for policy, arm in sorted(arms):
            count = done[task, policy, arm]
            if count != planned:
                kind = "too few trials" if count < planned else "more trials"
                yield kind, f"{task}, {policy}, {arm}", planned, count
    other: Counter[tuple[str, str]] = Counter()
    for row in rows:
        who = f"{row.policy or 'no policy'}, {row.study_arm or row.condition or 'no arm'}"
        if row.task not in starts:
            other["other task", row.task] += 1
        elif (row.policy, row.study_arm) not in arms:
            other["other policy or arm", who] += 1
    for (kind, where), count in sorted(other.items()):
        yield kind, where, "none", f"{count} trials"


def _of_starts(rows: Sequence[TrialRow], protocol: Protocol) -> Iterable[Departure]:
    for task in protocol.tasks:
        planned = {task.start_id(start) for start in range(task.starts)}
        tried = {row.start_id or "unnamed" for row in rows if row.task == task.task}
        if other := sorted(tried - planned):
            yield "other starts", task.task, "none", _listed(other)
        if tried and (missing := sorted(planned - tried)):
            yield "starts not tried", task.task, "none", _listed(missing)
    again = Counter((row.task, row.policy, row.study_arm, row.start_id) for row in rows)
    for (name, policy, arm, start_id), count in again.items():
        if count > 1:
            done = f"{start_id or 'unnamed'}: {count} times"
            yield "start tried again", f"{name}, {policy}, {arm}", 1, done


def _of_order(rows: Sequence[TrialRow], protocol: Protocol) -> Iterable[Departure]:
    planned = {
        (trial.task, trial.start_id, trial.policy, trial.arm): trial.number
        for trial in protocol.order()
    }
    keys = [(row.task, row.start_id or "", row.policy, row.study_arm) for row in in_order(rows)]
    numbers = [planned[key] for key in keys if key in planned]
    tops: list[int] = []  # as long as the longest rising part, others left out (Schensted 1961)
    for number in numbers:
        place = bisect_left(tops, number)
        tops[place : place + 1] = [number]
    if moved := len(numbers) - len(tops):
        yield "order", f"{len(numbers)} trials", "as drawn", f"{moved} made at another place"


def _listed(names: Sequence[str]) -> str:
    more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    return ", ".join(names[:SHOWN]) + more


def _unanswered(answers: Sequence[Answer], endpoint: Endpoint) -> Iterable[Departure]:
    """Say that the primary question has no answer at all."""
    why = ""
    if endpoint.kind == "agreement":
        why = "claims of agreement are no longer judged: read agreement.sim_planned.rate"
    elif not any(e.reading.evidence.pairs for e in answers if e.question.is_primary and not e.task):
        why = "no start was tried in both arms"
    if why:
        yield "primary question", endpoint.words, "an answer", why
