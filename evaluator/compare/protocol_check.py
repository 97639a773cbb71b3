"""A study against its locked protocol: every departure from it."""

from bisect import bisect_left
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from bridge.episode.metadata import treatment_of
from bridge.task.protocol import FILE_NAME, Endpoint, Protocol
from evaluator.compare.measure import Part, measured
from evaluator.compare.policies import Answer
from evaluator.compare.rows import TrialRow, in_order
from evaluator.compare.success import CONDITION_OF_ARM
from evaluator.measurements import PROTOCOL_DEPARTURES
from evaluator.result import Cell, Exclusion, Table

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
    policies = {each.policy for each in protocol.policies}
    found = []
    for row in rows:
        is_blank = not row.file and row.recorded is None and row.sim_planned is None
        if is_blank and row.plan_id is None:
            continue
        if row.policy in arms:
            policy, arm = arms[row.policy]
            condition = treatment_of(CONDITION_OF_ARM[arm], arm)
            row = replace(row, policy=policy, condition=condition)  # noqa: PLW2901
        if not row.study_arm and row.policy in policies:
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
    """Compare a study with its design; nothing without one.

    Args:
        answers: What the comparisons say that the design asked for.
    """
    if protocol is None or protocol.primary is None:
        return Part()
    mine = [row for row in rows if row.study_arm]
    found = [
        *_of_file(protocol, task_hashes or {}),
        *_of_numbers(mine, protocol),
        *_of_starts(mine, protocol),
        *_of_arms(rows, protocol),
        *_of_order(mine, protocol),
        *_of_exclusions(mine, protocol, left_out),
    ]
    found += _unanswered(answers, protocol.primary)
    count = measured(
        PROTOCOL_DEPARTURES.of(),
        lambda: float(len(found)),
        n=len(mine),
        counted="trial",
        reason_without_interval="a count",
    )
    return Part(
        measurements=(count,),
        tables=(_departure_table(found, protocol),),
    )


@dataclass(frozen=True)
class _Departure:
    kind: str
    where: str
    planned: Cell
    done: Cell


def _of_file(protocol: Protocol, task_hashes: Mapping[str, frozenset[str]]) -> Iterable[_Departure]:
    if protocol.edited:
        found = "the content does not fit the hash: edited after it was written"
        yield _Departure("protocol", FILE_NAME, protocol.sha256, found)
    elif not protocol.sha256:
        yield _Departure("protocol", FILE_NAME, "a hash", "none: an edit would not be seen")
    if protocol.interval != "wilson":
        yield _Departure("analysis", "interval of rates", protocol.interval, "wilson")
    for task in protocol.tasks:
        other = task_hashes.get(task.task, frozenset()) - {task.task_sha256}
        if other and task.task_sha256 != NO_HASH:
            names = ", ".join(sorted(name[:12] for name in other))
            yield _Departure("task file", task.task, task.task_sha256[:12], names)


def _of_numbers(rows: Sequence[TrialRow], protocol: Protocol) -> Iterable[_Departure]:
    done = Counter((row.task, row.policy, row.study_arm) for row in rows)
    for task in protocol.tasks:
        for policy in protocol.policies:
            for arm in policy.arms:
                count = done[task.task, policy.policy, arm]
                if count != task.starts:
                    kind = "too few trials" if count < task.starts else "more trials"
                    where = f"{task.task}, {policy.policy}, {arm}"
                    yield _Departure(kind, where, task.starts, count)


def _of_starts(rows: Sequence[TrialRow], protocol: Protocol) -> Iterable[_Departure]:
    for task in protocol.tasks:
        planned = {task.start_id(start) for start in range(task.starts)}
        tried = {row.start_id or "unnamed" for row in rows if row.task == task.task}
        if other := sorted(tried - planned):
            yield _Departure("other starts", task.task, "none", _listed(other))
        missing = sorted(planned - tried)
        if missing and tried:
            yield _Departure("starts not tried", task.task, "none", _listed(missing))


def _of_arms(rows: Sequence[TrialRow], protocol: Protocol) -> Iterable[_Departure]:
    tasks = {task.task for task in protocol.tasks}
    arms = {(each.policy, arm) for each in protocol.policies for arm in each.arms}
    other_tasks = Counter(row.task for row in rows if row.task not in tasks)
    for name, count in sorted(other_tasks.items()):
        yield _Departure("other task", name, "none", f"{count} trials")
    other = Counter(
        (row.policy or "no policy", row.study_arm or row.condition or "no arm")
        for row in rows
        if row.task in tasks and (row.policy, row.study_arm) not in arms
    )
    for (policy, arm), count in sorted(other.items()):
        yield _Departure("other policy or arm", f"{policy}, {arm}", "none", f"{count} trials")


def _of_order(rows: Sequence[TrialRow], protocol: Protocol) -> Iterable[_Departure]:
    planned = {
        (trial.task, trial.start_id, trial.policy, trial.arm): trial.number
        for trial in protocol.order()
    }
    made = in_order(rows)
    keys = [(row.task, row.start_id or "", row.policy, row.study_arm) for row in made]
    numbers = [planned[key] for key in keys if key in planned]
    moved = len(numbers) - _longest_rising(numbers)
    if moved:
        where = f"{len(numbers)} trials"
        yield _Departure("order", where, "as drawn", f"{moved} made at another place")


def _longest_rising(numbers: Sequence[int]) -> int:
    """Length of the longest rising part that leaving others out gives (Schensted 1961)."""
    tops: list[int] = []
    for number in numbers:
        place = bisect_left(tops, number)
        tops[place : place + 1] = [number]
    return len(tops)


def _of_exclusions(
    rows: Sequence[TrialRow], protocol: Protocol, left_out: Sequence[Exclusion]
) -> Iterable[_Departure]:
    declared = ", ".join(protocol.void_causes)
    tried = Counter((row.task, row.policy, row.study_arm, row.start_id) for row in rows)
    for (task, policy, arm, start), count in tried.items():
        if count > 1:
            where = f"{task}, {policy}, {arm}"
            yield _Departure("start tried again", where, 1, f"{start or 'unnamed'}: {count} times")
    for item in left_out:
        yield _Departure("exclusion not declared", item.episode, declared, item.reason)


def _listed(names: Sequence[str]) -> str:
    more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    return ", ".join(names[:SHOWN]) + more


def _unanswered(answers: Sequence[Answer], endpoint: Endpoint) -> Iterable[_Departure]:
    """Say that the primary question has no answer at all."""
    if endpoint.kind == "agreement":
        why = "claims of agreement are no longer judged: read agreement.sim_planned.rate"
        yield _Departure("primary question", endpoint.words, "an answer", why)
        return
    known = [each for each in answers if each.question.is_primary and not each.task]
    if not any(each.reading.evidence.pairs for each in known):
        why = "no start was tried in both arms"
        yield _Departure("primary question", endpoint.words, "an answer", why)


def _departure_table(found: Sequence[_Departure], protocol: Protocol) -> Table:
    rows = tuple((each.kind, each.where, each.planned, each.done) for each in found)
    trials = len(protocol.order())
    return Table(
        id="protocol_departures",
        title="Departures from the protocol" if found else "No departure from the protocol",
        columns=("what", "where", "planned", "done"),
        rows=rows or (("none", f"{trials} trials as planned", None, None),),
        note=f"{FILE_NAME}, sha256 {protocol.sha256 or 'not there'}: {trials} trials in a drawn "
        f"order, stopping {protocol.stopping}, declared exclusions: "
        f"{', '.join(protocol.void_causes)}.",
    )
