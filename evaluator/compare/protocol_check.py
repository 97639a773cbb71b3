"""A study against its locked protocol: every departure, and the answers to its questions."""

from bisect import bisect_left
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from scipy.special import ndtr

from bridge.episode.metadata import treatment_of
from bridge.task.protocol import FILE_NAME, Endpoint, Protocol
from evaluator.compare.measure import Part, ends, measured, vouched_rate
from evaluator.compare.rows import TrialRow, in_order
from evaluator.compare.study import study_starts
from evaluator.compare.success import CONDITION_OF_ARM
from evaluator.errors import UndefinedStatisticError
from evaluator.result import Cell, Exclusion, Interval, Measurement, Table
from evaluator.statistics.differences import sign_test, tango_points
from evaluator.statistics.planning import holm
from evaluator.study_measurements import (
    PROTOCOL_AGREEMENT,
    PROTOCOL_AGREEMENT_P,
    PROTOCOL_DEPARTURES,
    PROTOCOL_DIFFERENCE,
    PROTOCOL_DIFFERENCE_P,
)

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
        is_blank = row.path is None and row.recorded is None and row.sim_planned is None
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
    method: str = "wilson",
    left_out: Sequence[Exclusion] = (),
    task_hashes: Mapping[str, frozenset[str]] | None = None,
) -> Part:
    """Compare a study with its design, and answer the design's questions; nothing without one."""
    if protocol is None or protocol.primary is None:
        return Part()
    mine = [row for row in rows if row.study_arm]
    found = [
        *_of_file(protocol, method, task_hashes or {}),
        *_of_numbers(mine, protocol),
        *_of_starts(mine, protocol),
        *_of_arms(rows, protocol),
        *_of_order(mine, protocol),
        *_of_exclusions(mine, protocol, left_out),
    ]
    answers = _answers(mine, protocol, method)
    if answers[0].p is None:
        why = answers[0].reason
        found.append(_Departure("primary question", answers[0].question, "an answer", why))
    count = measured(
        PROTOCOL_DEPARTURES.of(),
        lambda: float(len(found)),
        n=len(mine),
        counted="trial",
        reason_without_interval="a count",
    )
    return Part(
        measurements=(count, *_measured(answers[0], protocol)),
        tables=(_answer_table(answers, protocol), _departure_table(found, protocol)),
    )


@dataclass(frozen=True)
class _Departure:
    kind: str
    where: str
    planned: Cell
    done: Cell


def _of_file(
    protocol: Protocol, method: str, task_hashes: Mapping[str, frozenset[str]]
) -> Iterable[_Departure]:
    if protocol.edited:
        found = "the content does not fit the hash: edited after it was written"
        yield _Departure("protocol", FILE_NAME, protocol.sha256, found)
    elif not protocol.sha256:
        yield _Departure("protocol", FILE_NAME, "a hash", "none: an edit would not be seen")
    if method != protocol.interval:
        yield _Departure("analysis", "interval of rates", protocol.interval, method)
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
    _, dropped = study_starts(rows, protocol.void_causes)
    declared = ", ".join(protocol.void_causes)
    reasons = Counter(item.reason for item in dropped if "is void in all arms" not in item.reason)
    for reason, count in sorted(reasons.items()):
        yield _Departure("exclusion not declared", f"{count} trials", declared, reason)
    for item in left_out:
        yield _Departure("exclusion not declared", item.episode, declared, item.reason)


def _listed(names: Sequence[str]) -> str:
    more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    return ", ".join(names[:SHOWN]) + more


@dataclass(frozen=True, kw_only=True)
class _Answer:
    """What the data say to one question."""

    role: str
    question: str
    endpoint: Endpoint
    n: int
    value: float | None
    """Percentage points, or a share of 1."""
    interval: Interval | None
    p: float | None
    reason: str = ""
    words: str = ""
    episodes: tuple[str, ...] = ()


def _answers(rows: Sequence[TrialRow], protocol: Protocol, method: str) -> list[_Answer]:
    """Answer the primary question, it again in each task, then the secondary ones."""
    starts, _ = study_starts(rows, protocol.void_causes)
    used = {start.trials[arm].episode for start in starts for arm in start.trials}
    kept = [row for row in rows if row.episode in used]
    primary = protocol.primary
    if primary is None:
        return []
    found = [_answer(kept, primary, "primary", "", method)]
    if len(protocol.tasks) > 1:
        found += [
            _answer(
                [row for row in kept if row.task == task.task], primary, "task", task.task, method
            )
            for task in protocol.tasks
        ]
    return found + [_answer(kept, each, "secondary", "", method) for each in protocol.secondary]


def _answer(
    rows: Sequence[TrialRow], endpoint: Endpoint, role: str, task: str, method: str
) -> _Answer:
    answer = _agreement if endpoint.kind == "agreement" else _difference
    question = endpoint.words if not task else f"{task}: {endpoint.words}"
    return replace(answer(rows, endpoint, method), role=role, question=question)


def _difference(rows: Sequence[TrialRow], endpoint: Endpoint, _: str) -> _Answer:
    """Count starts by both outcomes; what was not executed is a failure of its arm."""
    sides = [
        {(row.task, row.start_id): row for row in rows if (row.policy, row.study_arm) == arm}
        for arm in (
            (endpoint.against_policy, endpoint.against_arm),
            (endpoint.policy, endpoint.arm),
        )
    ]
    both = [key for key in sides[0] if key in sides[1]]
    outcomes = [(sides[0][key].recorded is True, sides[1][key].recorded is True) for key in both]
    improved = sum(after and not before for before, after in outcomes)
    worsened = sum(before and not after for before, after in outcomes)
    empty = _Answer(
        role="", question="", endpoint=endpoint, n=len(both), value=None, interval=None, p=None
    )
    if not both:
        return replace(empty, reason="no start was tried in both arms")
    value, interval = tango_points(improved, worsened, len(both))
    p = sign_test(improved, worsened)[1] if improved + worsened else 1.0
    words = f"{improved} improved, {worsened} worsened of {len(both)} starts"
    episodes = tuple(side[key].episode for key in both for side in sides)
    return replace(empty, value=value, interval=interval, p=p, words=words, episodes=episodes)


def _agreement(rows: Sequence[TrialRow], endpoint: Endpoint, method: str) -> _Answer:
    """Test the share of trials in which twin and outcome agree against the limit."""
    known = [
        row
        for row in rows
        if (row.policy, row.study_arm) == (endpoint.policy, endpoint.arm)
        and row.recorded is not None
        and row.sim_planned is not None
    ]
    agreed, n = sum(row.recorded == row.sim_planned for row in known), len(known)
    empty = _Answer(role="", question="", endpoint=endpoint, n=n, value=None, interval=None, p=None)
    if not n:
        return replace(empty, reason="no trial has a decided replay and an outcome")
    share, limit = agreed / n, endpoint.limit
    sd = (limit * (1 - limit) / n) ** 0.5
    z = (share - limit) / sd if sd else (float("inf") if share > limit else 0.0)
    p = 2 * (1 - float(ndtr(z))) if z > 0 else 1.0
    interval, _ = vouched_rate(agreed, n, method)
    words = f"{agreed} of {n} trials"
    episodes = tuple(row.episode for row in known)
    return replace(empty, value=share, interval=interval, p=p, words=words, episodes=episodes)


def _measured(answer: _Answer, protocol: Protocol) -> list[Measurement]:
    """Return value and p of the primary question."""

    def known(value: float | None) -> float:
        if value is None:
            raise UndefinedStatisticError(statistic="primary question", reason=answer.reason)
        return value

    agreement = answer.endpoint.kind == "agreement"
    value = PROTOCOL_AGREEMENT if agreement else PROTOCOL_DIFFERENCE
    test = PROTOCOL_AGREEMENT_P if agreement else PROTOCOL_DIFFERENCE_P
    about = f"{answer.question}: {answer.words or answer.reason}"
    counted = "trial" if agreement else "pair"
    return [
        measured(
            value.of(about=about),
            lambda: (known(answer.value), answer.interval),
            n=answer.n,
            counted=counted,
            episodes=answer.episodes,
        ),
        measured(
            test.of(about=about, alpha=protocol.alpha),
            lambda: known(answer.p),
            n=answer.n,
            counted=counted,
            reason_without_interval="a p-value",
            episodes=answer.episodes,
        ),
    ]


def _answer_table(answers: Sequence[_Answer], protocol: Protocol) -> Table:
    """Lay all questions out; Holm over tasks and secondary ones, the primary one stands alone."""
    others = [each for each in answers[1:] if each.p is not None]
    adjusted = dict(zip(map(id, others), holm([each.p or 0.0 for each in others]), strict=True))
    rows: list[dict[str, Cell]] = []
    for each in answers:
        factor = 100.0 if each.endpoint.kind == "agreement" else 1.0
        low, high = ends(each.interval, factor)
        p = each.p if each.role == "primary" else adjusted.get(id(each))
        shown = "not answered" if p is None else "shown" if p <= protocol.alpha else "not shown"
        if each.endpoint.kind == "difference" and shown == "shown":
            shown = "better" if (each.value or 0) > 0 else "worse"
        rows.append(
            {
                "question": each.question,
                "role": each.role,
                "n": each.n,
                "value (pp or %)": None if each.value is None else round(factor * each.value, 1),
                "low": low,
                "high": high,
                "p": each.p,
                "p after Holm": p,
                "answer": shown if each.p is not None else each.reason,
            }
        )
    return Table.of(
        rows,
        id="protocol_questions",
        title="The questions that were fixed before the first trial",
        note="Difference: McNemar's mid-p and Tango's interval over starts tried in both arms, "
        "whatever was not executed a failure. Agreement: score test against the limit. The "
        f"primary question is tested at {protocol.alpha:g} alone; the same in each task and the "
        "secondary ones share that after Holm (1979).",
    )


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
