"""Which of two candidates is better as recorded: policies, or one without and with replanning.

Each pair that was asked gets one answer, the same that ``robot-gst design`` plans for: a sequential
comparison (``evaluator/statistics/sequential.py``) over all tasks, paired where both tried a start.
A trial that was made and has no outcome is a failure of its candidate, unless the protocol declares
its cause void: a policy that trips the arm must not gain by it.
"""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations
from typing import NamedTuple, TypeVar

from bridge.episode.catalogue_query import UNLABELLED
from bridge.task.protocol import VOID_CAUSES, Protocol
from evaluator.compare.beside import MEASURES, Measure
from evaluator.compare.measure import Part, ends, grouped, measured, percent
from evaluator.compare.rows import RateGroup, TrialRow, in_order
from evaluator.compare.success import CONDITION_OF_ARM, WITH, WITHOUT
from evaluator.errors import UndefinedStatisticError
from evaluator.measurements import COMPARED, COMPARED_IN_TASK
from evaluator.quantity import noun
from evaluator.result import Cell, Exclusion, Interval, Measurement, Table
from evaluator.statistics.sequential import Evidence, Look, Plan, Stratum, pairs_equivalent

Item = TypeVar("Item")

START_LIMIT_M = 0.03
"""Trials whose objects started further apart than this are not of the same start."""
MOST_CANDIDATES = 12
"""Beyond, pairs that nobody asked about are too many to be shown anything."""
CLOSE = 0.10
"""A difference that lies within this, whatever it is, needs no further trial."""
ALL_TASKS = "all tasks"


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """What is chosen between."""

    policy: str
    condition: str

    @staticmethod
    def of(one: TrialRow | RateGroup) -> "Candidate":
        """Return whose trial or rate it is."""
        return Candidate(policy=one.policy, condition=one.condition)

    @property
    def words(self) -> str:
        """Policy and condition as a reader has them."""
        parts = (self.policy, self.condition.replace("_", " "))
        return ", ".join(part for part in parts if part) or "unnamed"


@dataclass(frozen=True, kw_only=True)
class Question:
    """Whether the second candidate is better than the first."""

    first: Candidate
    second: Candidate
    is_primary: bool = False
    """Tested at the whole alpha; the others share it (Holm 1979)."""

    @property
    def names(self) -> tuple[str, str]:
        """Both in words, without what they have in common."""
        first, second = self.first, self.second
        if first.policy == second.policy:
            return tuple(c.condition.replace("_", " ") for c in (first, second))  # type: ignore[return-value]
        if first.condition == second.condition:
            return first.policy, second.policy
        return first.words, second.words


def questions(found: Iterable[Candidate], protocol: Protocol | None = None) -> list[Question]:
    """Return what a protocol asks; without one replanning of each policy, and each two policies."""
    if protocol is not None and protocol.primary is not None:
        return [
            Question(
                first=Candidate(
                    policy=each.against_policy, condition=CONDITION_OF_ARM[each.against_arm]
                ),
                second=Candidate(policy=each.policy, condition=CONDITION_OF_ARM[each.arm]),
                is_primary=each == protocol.primary,
            )
            for each in (protocol.primary, *protocol.secondary)
            if each.kind == "difference"
        ]
    kept = list(dict.fromkeys(found))
    asked = [
        Question(first=a, second=b)
        for a in kept
        for b in kept
        if a.policy == b.policy and (a.condition, b.condition) == (WITHOUT, WITH)
    ]
    if len({each.policy for each in kept}) > MOST_CANDIDATES:
        return asked
    return asked + [
        Question(first=a, second=b)
        for a, b in combinations(kept, 2)
        if a.policy != b.policy and a.condition == b.condition
    ]


class Try(NamedTuple):
    """One trial of one of two candidates."""

    task: str
    start: str
    is_second: bool
    succeeded: bool
    has_outcome: bool
    row: TrialRow


def made_trials(rows: Sequence[TrialRow], void_causes: Sequence[str]) -> list[TrialRow]:
    """Return the trials that count, in the order in which they were made."""
    void = {each.episode for each in void_starts(rows, void_causes)}
    return [
        row
        for row in in_order(rows)
        if (row.recorded is not None or row.nothing_executed)
        or row.why_unknown not in ("", UNLABELLED)
        if row.episode not in void
    ]


def tries_of(made: Sequence[TrialRow], question: Question) -> list[Try]:
    """Return the trials of both candidates among those that count."""
    first, second = ((c.policy, c.condition) for c in (question.first, question.second))
    sides = {first: False, second: True}
    return [
        Try(row.task, row.start_id or "", side, row.recorded is True, row.recorded is not None, row)
        for row in made
        if (side := sides.get((row.policy, row.condition))) is not None
    ]


def in_rounds(tries: Sequence[Try]) -> list[Try]:
    """Take a trial of each candidate on each task, then the next of each.

    In the order of a lab that goes task after task a look would see the first tasks only.
    """
    seen: Counter[tuple[str, bool]] = Counter()
    rounds = []
    for each in tries:
        seen[each.task, each.is_second] += 1
        rounds.append(seen[each.task, each.is_second])
    return [each for _, each in sorted(zip(rounds, tries, strict=True), key=lambda item: item[0])]


def void_starts(rows: Sequence[TrialRow], void_causes: Sequence[str]) -> list[Exclusion]:
    """Name the trials that enter no comparison, and why: void ones, in a study with their start."""
    void = [r for r in rows if r.recorded is None and r.why_unknown.startswith(tuple(void_causes))]
    reasons = {row.episode: f"void: {row.why_unknown}" for row in void}
    starts = {(row.task, row.start_id): row for row in void}
    for row in rows:
        in_study = bool(row.study_arm) and row.start_id is not None
        first = starts.get((row.task, row.start_id)) if in_study else None
        if first is not None:
            words = f"start {row.start_id} is void in all arms: {first.episode}: "
            reasons.setdefault(row.episode, f"{words}{first.why_unknown}")
    return [
        Exclusion(episode=name, scope="comparisons", reason=why) for name, why in reasons.items()
    ]


@dataclass(kw_only=True)
class _Count:
    """Trials of one task, counted as they come in: pairs of one start, and the others."""

    starts: dict[str, list[Try | None]] = field(default_factory=dict)
    improved: int = 0
    worsened: int = 0
    pairs: int = 0
    k: list[int] = field(default_factory=lambda: [0, 0])
    n: list[int] = field(default_factory=lambda: [0, 0])
    num_pairs: float = 0.0
    """Pairs that all of them are worth."""

    def add(self, each: Try) -> None:
        """Count one more; the first of each side on a start are a pair."""
        self.k[each.is_second] += each.succeeded
        self.n[each.is_second] += 1
        firsts = self.starts.setdefault(each.start, [None, None])
        if each.start and firsts[each.is_second] is None:
            firsts[each.is_second] = each
            first, second = firsts
            if first and second and _is_same_start(first.row, second.row):
                self.pairs += 1
                self.improved += second.succeeded and not first.succeeded
                self.worsened += first.succeeded and not second.succeeded
                for side, member in enumerate((first, second)):
                    self.k[side] -= member.succeeded
                    self.n[side] -= 1
        self.num_pairs = self.pairs + pairs_equivalent(*self.n)

    def stratum(self) -> Stratum:
        """Return what was counted so far."""
        return Stratum(
            improved=self.improved,
            worsened=self.worsened,
            pairs=self.pairs,
            first=(self.k[0], self.n[0]),
            second=(self.k[1], self.n[1]),
        )


@dataclass(frozen=True, kw_only=True)
class Course:
    """What was counted when each look was due, and in all."""

    all_: Evidence
    at: Mapping[float, Evidence]

    @staticmethod
    def of(tries: Sequence[Try], plan: Plan) -> "Course":
        """Count trials in their order."""
        counts: dict[str, _Count] = {}
        at: dict[float, Evidence] = {}

        def so_far() -> Evidence:
            return Evidence(strata=tuple(count.stratum() for count in counts.values()))

        places, total = plan.places(), 0.0
        place = next(places)
        for each in tries:
            count = counts.setdefault(each.task, _Count())
            total -= count.num_pairs
            count.add(each)
            total += count.num_pairs
            while total >= place - 1e-9:
                at[place] = so_far()
                place = next(places)
        return Course(all_=so_far(), at=at)

    def read(self, plan: Plan) -> "Reading":
        """Look at the trials as planned."""
        return read(plan, self.all_, lambda pairs: self.at.get(pairs, self.all_))


def _is_same_start(first: TrialRow, second: TrialRow) -> bool:
    one, other = first.start_positions_m, second.start_positions_m
    return all(math.dist(one[n], other[n]) <= START_LIMIT_M for n in one.keys() & other.keys())


@dataclass(frozen=True, kw_only=True)
class Reading:
    """What the trials say to one question, by one plan."""

    plan: Plan
    evidence: Evidence
    limit: float
    """Standard errors from which on the last look that was due decides, else the first."""
    decided: Look | None
    """The look at which it was decided."""
    better: int
    """1 where the second is better, -1 where it is worse, 0 undecided."""

    @cached_property
    def interval(self) -> Interval | None:
        """Differences that the look leaves possible."""
        return self.evidence.interval(self.limit) if self.evidence.pairs else None

    @cached_property
    def more(self) -> int | None:
        """Further trials of each candidate after which a decision is likely; None without any."""
        likely = self.plan.likely_at(self.evidence) if self.decided is None else None
        return None if likely is None else max(1, math.ceil(likely - self.evidence.pairs))


def read(plan: Plan, all_: Evidence, until: Callable[[float], Evidence] | None = None) -> Reading:
    """Look at the trials as planned.

    ``until`` gives what was counted after so many pairs; without it the last look that was due sees
    all of it.
    """
    limit = math.inf
    decided, better = None, 0
    for look in plan.looks(all_.kind) if all_.pairs else ():
        if look.pairs > all_.pairs + 1e-9:
            limit = look.limit if math.isinf(limit) else limit
            break
        limit = look.limit
        if until is None:
            decided = None  # of what was counted at once only the last look is asked
        seen = all_ if until is None else until(look.pairs)
        z = seen.of_no_difference if decided is None else 0.0
        if decided is None and abs(z) >= limit - 1e-9:
            decided, better = look, 1 if z > 0 else -1
    better = better if decided is not None else 0
    return Reading(plan=plan, evidence=all_, limit=limit, decided=decided, better=better)


def with_holm(
    items: Sequence[Item], plan: Plan, read_one: Callable[[Plan, Item], Reading]
) -> list[Reading]:
    """Read several questions that share alpha; each that is decided leaves its share."""
    found: dict[int, Reading] = {}
    open_ = list(range(len(items)))
    while open_:
        shared = replace(plan, alpha=plan.alpha / len(open_))
        found |= {place: read_one(shared, items[place]) for place in open_}
        left = [place for place in open_ if found[place].decided is None]
        open_ = left if len(left) < len(open_) else []
    return [found[place] for place in range(len(items))]


@dataclass(frozen=True, kw_only=True)
class Answer:
    """One question, what was counted, and what it says."""

    question: Question
    task: str
    counts: tuple[tuple[int, int], tuple[int, int]]
    reading: Reading
    no_outcome: tuple[int, int] = (0, 0)
    """Trials without an outcome that count as failures."""
    without_these: float | None = None
    """The difference if they did not count."""
    episodes: tuple[str, ...] = field(default=(), repr=False)
    beside: tuple[str, ...] = ()
    """What progress and time to success say."""

    @property
    def sentence(self) -> str:
        """The answer in words, and what stands beside it."""
        return "; ".join((self._of_success, *self.beside))

    @property
    def _of_success(self) -> str:
        first, second = self.question.names
        (k, n), (j, m) = self.counts
        pairs = self.reading.evidence.pairs
        if not pairs:
            return f"{second} and {first} cannot be compared: no task was tried by both"
        difference = 100 * self.reading.evidence.difference
        low, high = (100 * (end or 0.0) for end in ends(self.reading.interval))
        counts = [f"{j} of {m}", f"{k} of {n}"]
        if self.reading.better < 0:
            first, second, difference, low, high = second, first, -difference, -high, -low
            counts.reverse()
        points = f"{round(difference):+d} points [{round(low):+d}, {round(high):+d}]"
        if lost := sum(self.no_outcome):
            points += f" ({lost} without an outcome as {noun('failure', lost)}"
            without = 100 * (self.without_these or 0.0) * (-1 if self.reading.better < 0 else 1)
            points += ")" if self.without_these is None else f"; {round(without):+d} without them)"
        if self.reading.better:
            words = f"{second} is better than {first}: {' against '.join(counts)}, {points}"
            look = self.reading.decided
            then = f", decided after {look.pairs:g} pairs" if look and low <= 0 else ""
            return f"{words}{then}; stop here"
        found = f"{second} {counts[0]}, {first} {counts[1]}, {points}"
        if max(-low, high) <= 100 * CLOSE:
            return f"no difference of more than 10 points: {found}; stop here"
        more = self.reading.more
        rest = (
            f"if that stays, {more} more {noun('trial', more)} of each are likely to decide it"
            if more is not None
            else "no number of trials worth running is likely to decide it"
        )
        return f"undecided: {found}; {rest}"


def notes_of_trials(rows: Sequence[TrialRow], void_causes: Sequence[str]) -> list[tuple[str, str]]:
    """Say which trials have no outcome, and which starts a candidate tried again."""
    made = made_trials(rows, void_causes)
    groups = grouped(made, lambda row: (row.task, Candidate.of(row)))
    found = []
    for (task, who), made in groups.items():
        about = f"{who.words}, {task}" if len({t for t, _ in groups}) > 1 else who.words
        if lost := [row for row in made if row.recorded is None]:
            k, n = sum(row.recorded is True for row in made), len(made)
            why = ", ".join(dict.fromkeys(row.why_unknown or "nothing executed" for row in lost))
            words = f"{len(lost)} of {n} trials have no outcome ({why}): {k} of {n} succeeded where"
            words += f" they count as failures, as in comparisons, {k} of {n - len(lost)} without"
            found.append((about, f"{words} them, as in its rate"))
        starts = Counter(row.start_id for row in made if row.start_id)
        if again := [f"{name} {times} times" for name, times in starts.items() if times > 1]:
            more = f" and {len(again) - 3} more" if len(again) > 3 else ""
            words = f"starts tried more than once: {', '.join(again[:3])}{more}; the first trial "
            found.append((about, f"{words}of a start is paired, the others count without a pair"))
    return found


def compare_policies(
    rows: Sequence[TrialRow],
    protocol: Protocol | None = None,
    void_causes: Sequence[str] = VOID_CAUSES,
) -> list[Answer]:
    """Answer every question over all tasks, then in each task where there are several."""
    made = made_trials(rows, void_causes)
    plan, of_task = plan_of(protocol), plan_of(protocol, of_task=True)
    asked: list[_Case] = []
    parts: list[_Case] = []
    for question in questions(map(Candidate.of, rows), protocol):
        tries = tries_of(made, question)
        if len({each.is_second for each in tries}) < 2:
            continue
        tasks = grouped(tries, lambda each: each.task)
        tries = in_rounds(tries)
        asked.append(_Case(question, "", tries, Course.of(tries, plan)))
        if len(tasks) > 1:
            parts += [_Case(question, t, own, Course.of(own, of_task)) for t, own in tasks.items()]
    primary = [case for case in asked if case.question.is_primary]
    others = [case for case in asked if not case.question.is_primary]
    readings = [case.course.read(plan) for case in primary]
    readings += with_holm(others, plan, lambda share, case: case.course.read(share))
    readings += with_holm(parts, of_task, lambda share, case: case.course.read(share))
    beside = _beside(asked, plan)
    return [
        _answer(case, reading, beside.get(id(case), ()))
        for case, reading in zip((*primary, *others, *parts), readings, strict=True)
    ]


def _beside(cases: Sequence["_Case"], plan: Plan) -> dict[int, tuple[str, ...]]:
    """Compare progress and time to success over all tasks; these share another alpha."""
    asked: list[tuple[_Case, Measure, Course]] = []
    for case in cases:
        anywhere = replace(case.tries[0].row, start_positions_m={})  # they are paired already
        for measure in MEASURES:
            if not all(map(measure.is_recorded, case.sides)):
                continue
            tries: list[Try] = []
            pairs = measure.pairs((t.is_second, t.row) for t in case.tries)
            for number, (first, second, won) in enumerate(pairs):
                for row, is_second, better in ((first, False, won < 0), (second, True, won > 0)):
                    tries.append(Try(row.task, str(number), is_second, better, True, anywhere))
            asked.append((case, measure, Course.of(tries, plan)))
    found: dict[int, tuple[str, ...]] = {}
    readings = with_holm(asked, plan, lambda share, each: each[2].read(share))
    for (case, measure, _), reading in zip(asked, readings, strict=True):
        won, lost, many = reading.evidence.counted
        theirs, mine = map(measure.shown, case.sides)
        words = f"{measure.name} {mine} against {theirs}, {measure.won} in {won} and "
        words += f"{measure.lost} in {lost} of {many} pairs"
        words += f" ({'decided' if reading.better else 'undecided'})"
        found[id(case)] = (*found.get(id(case), ()), words)
    return found


class _Case(NamedTuple):
    """One question over all tasks or in one."""

    question: Question
    task: str
    tries: Sequence[Try]
    course: Course

    @property
    def sides(self) -> list[list[TrialRow]]:
        """Trials of the first candidate, and of the second."""
        return [[t.row for t in self.tries if t.is_second == second] for second in (False, True)]


def plan_of(protocol: Protocol | None, *, of_task: bool = False) -> Plan:
    """Return the plan that a protocol locked; one that is supposed without."""
    if protocol is None or protocol.primary is None:
        return Plan()
    starts = [task.starts for task in protocol.tasks]
    pairs = max(starts) if of_task else sum(starts)
    return Plan(pairs=max(4, pairs), locked=not protocol.edited, alpha=protocol.alpha)


def _answer(case: _Case, reading: Reading, beside: tuple[str, ...] = ()) -> Answer:
    sides = [[t for t in case.tries if t.is_second == second] for second in (False, True)]
    counts = [(sum(t.succeeded for t in side), len(side)) for side in sides]
    unknown = [sum(not t.has_outcome for t in side) for side in sides]
    known = Course.of([t for t in case.tries if t.has_outcome], Plan()).all_
    return Answer(
        question=case.question,
        task=case.task,
        counts=(counts[0], counts[1]),
        reading=reading,
        no_outcome=(unknown[0], unknown[1]),
        without_these=known.difference if any(unknown) and known.pairs else None,
        episodes=tuple(each.row.episode for each in case.tries),
        beside=beside,
    )


def compare_counts(groups: Sequence[RateGroup]) -> list[Answer]:
    """Answer the same of a table of rates; nothing of what has no n, or counts parts of trials."""
    cells = {
        (g.task, Candidate.of(g)): (g.recorded.k, g.recorded.n)
        for g in groups
        if g.unit == "trial" and g.recorded.k is not None and g.recorded.n
    }
    asked: list[tuple[Question, str, list[Stratum]]] = []
    parts: list[tuple[Question, str, list[Stratum]]] = []
    for question in questions(c for _, c in cells):
        first, second = question.first, question.second
        tasks = [task for task, c in cells if c == first and (task, second) in cells]
        strata = [Stratum(first=cells[t, first], second=cells[t, second]) for t in tasks]
        if tasks:
            asked.append((question, "", strata))
        if len(tasks) > 1:
            parts += [(question, task, [own]) for task, own in zip(tasks, strata, strict=True)]
    found = []
    for cases in (asked, parts):
        readings = with_holm(cases, Plan(), lambda plan, c: read(plan, Evidence(strata=(*c[2],))))
        for (question, task, strata), reading in zip(cases, readings, strict=True):
            counts = _sum(s.first for s in strata), _sum(s.second for s in strata)
            found.append(Answer(question=question, task=task, counts=counts, reading=reading))
    return found


def _sum(side: Iterable[tuple[int, int]]) -> tuple[int, int]:
    k, n = map(sum, zip(*side, strict=True))
    return k, n


def comparison_part(answers: Sequence[Answer], protocol: Protocol | None = None) -> Part:
    """Lay answers out; the first column that a reader needs is the sentence."""
    if not answers:
        return Part()
    rows: list[dict[str, Cell]] = [
        {
            "answer": each.sentence,
            "task": each.task or ALL_TASKS,
            "first": each.question.first.words,
            "second": each.question.second.words,
            "shared starts": sum(s.pairs for s in each.reading.evidence.strata),
            "decided": {1: "better", -1: "worse", 0: "no"}[each.reading.better],
            "decided after (pairs)": look.pairs if (look := each.reading.decided) else None,
            "more trials of each": each.reading.more,
        }
        for each in answers
    ]
    plan = plan_of(protocol)
    words = f"no plan was locked: as if {plan.pairs} pairs had been planned"
    words = f"planned: {plan.pairs} pairs" if plan.locked else words
    table = Table.of(
        rows,
        id="comparisons",
        title="Which is better, as recorded",
        note=f"Group-sequential score test, {words}, extended by doubling; alpha {plan.alpha:g} "
        "holds however often one looks; over all tasks each is counted in turn. All questions "
        "share it (Holm), a primary one has it alone, the same in each task share another, "
        "progress and time to success a third. Intervals hold at every look. Trials that "
        "ended without an answer are failures; those that nobody labelled do not count.",
    )
    return Part(
        measurements=tuple(_measured(each) for each in answers), tables=(table, *_standing(answers))
    )


def _measured(answer: Answer) -> Measurement:
    question, evidence = answer.question, answer.reading.evidence
    second, first = (
        f"{side.policy}_{side.condition}".strip("_") or "unnamed"
        for side in (question.second, question.first)
    )
    parts = {"second": second, "first": first, "words": answer.sentence}
    defined = (COMPARED_IN_TASK if answer.task else COMPARED).of(**parts, task=answer.task)

    def compute() -> tuple[float, Interval | None]:
        if not evidence.pairs:
            reason = "no task was tried by both"
            raise UndefinedStatisticError(statistic="comparison", reason=reason)
        return 100 * evidence.difference, percent(answer.reading.interval)

    n = sum(n for _, n in answer.counts)
    return measured(defined, compute, n=n, counted="trial", episodes=answer.episodes)


def _standing(answers: Sequence[Answer]) -> tuple[Table, ...]:
    """Say who may be best, of three candidates and more: whoever nobody was shown to be better."""
    beaten: dict[Candidate, list[str]] = {}
    rates: dict[Candidate, tuple[int, int]] = {}
    for each in answers:
        if each.task:
            continue
        pair = (each.question.first, each.question.second)
        for side, candidate in enumerate(pair):
            rates.setdefault(candidate, each.counts[side])
            beaten.setdefault(candidate, [])
        if each.reading.better:
            loser, winner = pair if each.reading.better > 0 else pair[::-1]
            beaten[loser].append(winner.words)
    if len(beaten) < 3:
        return ()
    rows: list[dict[str, Cell]] = [
        {
            "candidate": candidate.words,
            **dict(zip("kn", rates[candidate], strict=True)),
            "may be best": "no" if by else "yes",
            "beaten by": ", ".join(by) or None,
        }
        for candidate, by in beaten.items()
    ]
    note = "Not a ranking: whoever is not shown to be worse than another may be the best."
    return (Table.of(rows, id="standing", title="Who may be best", note=note),)
