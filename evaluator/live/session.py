"""The trials of a session as they are known now, what they settle, and which start to run next.

Each episode counts once, by the last word on it.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial

from bridge.episode.catalogue_store import Entry
from bridge.episode.metadata import WITH, WITHOUT, study_arm_of, treatment_of
from evaluator.errors import UndefinedStatisticError
from evaluator.statistics.sequential import (
    Advice,
    pairs_advice,
    pairs_sequence,
    sequence_of,
    stop_or_continue,
)

OUTCOMES = {"success": True, "failure": False}


@dataclass(frozen=True, kw_only=True)
class LiveTrial:
    """One recorded trial."""

    episode: str
    task: str
    condition: str
    policy: str
    start_id: str | None
    recorded: bool | None
    """None while nobody has said how it ended."""
    start_ns: int
    """When its recording began: trials count in this order."""

    @property
    def key(self) -> tuple[str, str, str]:
        """Task, condition and policy."""
        return self.task, self.condition, self.policy


@dataclass(frozen=True, kw_only=True)
class Change:
    """What became different."""

    trial: LiveTrial
    before: LiveTrial | None
    """None for a new trial."""

    @property
    def changes_numbers(self) -> bool:
        """Say whether it changes any number: a description of an unlabelled trial does not."""
        return self.trial.recorded is not None or (
            self.before is not None and self.before.recorded is not None
        )


def trial_of(entry: Entry) -> LiveTrial | None:
    """Read a line of the catalogue; None for what is no trial, or cannot be read."""
    if entry.kind != "trial" or entry.error:
        return None
    return LiveTrial(
        episode=entry.id,
        task=entry.task,
        condition=treatment_of(entry.condition, study_arm_of(entry.tags)),
        policy=entry.policy,
        start_id=entry.start_id,
        recorded=OUTCOMES.get(entry.outcome),
        start_ns=entry.start_ns,
    )


class SessionTrials:
    """All trials by episode. Takes the same update any number of times, in any order."""

    def __init__(self) -> None:
        """Begin without trials."""
        self._trials: dict[str, LiveTrial] = {}
        self._listed: set[str] = set()

    @property
    def trials(self) -> list[LiveTrial]:
        """In the order in which they were recorded."""
        return sorted(self._trials.values(), key=lambda trial: (trial.start_ns, trial.episode))

    def take(self, trial: LiveTrial) -> Change | None:
        """Take in one trial; None when it is known already, as it is."""
        before = self._trials.get(trial.episode)
        if before == trial:
            return None
        self._trials[trial.episode] = trial
        return Change(trial=trial, before=before)

    def take_listing(self, trials: Iterable[LiveTrial]) -> tuple[list[Change], list[LiveTrial]]:
        """Take in what the run folder holds now; return what changed, and what has gone.

        A trial that only a message told of is kept until the folder has listed it once.
        """
        found = sorted(trials, key=lambda trial: (trial.start_ns, trial.episode))
        names = {trial.episode for trial in found}
        gone = [self._trials.pop(name) for name in self._listed - names if name in self._trials]
        self._listed = names
        changes = [change for trial in found if (change := self.take(trial)) is not None]
        return changes, gone


Key = tuple[str, str, str]


@dataclass(frozen=True, kw_only=True)
class RateSummary:
    """One group's recorded success rate, at any time."""

    task: str
    condition: str
    policy: str
    k: int
    n: int
    low: float
    high: float
    advice: Advice | None
    """None where no goal was asked for."""
    changed: str = ""
    """Why no interval is left, where the rate has changed between trials."""

    @property
    def is_settled(self) -> bool:
        """Say whether more trials would answer nothing that was asked."""
        return self.advice is not None and self.advice.stop


@dataclass(frozen=True, kw_only=True)
class GainSummary:
    """The gain with replanning over paired starts of one task and policy, at any time."""

    task: str
    policy: str
    improved: int
    worsened: int
    n: int
    low: float
    """Difference of success rates, as a fraction."""
    high: float
    advice: Advice
    changed: str = ""


@dataclass(frozen=True, kw_only=True)
class SessionSummary:
    """Everything that is known now."""

    rates: tuple[RateSummary, ...]
    gains: tuple[GainSummary, ...]
    unknown: int
    """Trials without a known outcome: part of nothing."""

    def rate(self, key: Key) -> RateSummary | None:
        """Return one group."""
        return next((r for r in self.rates if (r.task, r.condition, r.policy) == key), None)

    def gain(self, task: str, policy: str) -> GainSummary | None:
        """Return the gain of one task and policy.

        Args:
            policy: Policy of the pairs; without a complete pair of both the answer is None.
        """
        return next((g for g in self.gains if (g.task, g.policy) == (task, policy)), None)


def summarise_session(trials: Sequence[LiveTrial], goal: float | None) -> SessionSummary:
    """Work everything out anew: a corrected label changes what came after it too.

    Args:
        trials: In the order in which they were recorded.
    """
    known = [trial for trial in trials if trial.recorded is not None]
    outcomes_of: dict[Key, list[bool]] = {}
    for trial in known:
        outcomes_of.setdefault(trial.key, []).append(bool(trial.recorded))
    groups = dict.fromkeys((trial.task, trial.policy) for trial in known)
    gains = (_gain(task, policy, changes_of(known, task, policy)) for task, policy in groups)
    return SessionSummary(
        rates=tuple(_rate(key, outcomes, goal) for key, outcomes in sorted(outcomes_of.items())),
        gains=tuple(gain for gain in gains if gain is not None),
        unknown=len(trials) - len(known),
    )


def _rate(key: Key, outcomes: Sequence[bool], goal: float | None) -> RateSummary:
    task, condition, policy = key
    summary = partial(
        RateSummary,
        task=task,
        condition=condition,
        policy=policy,
        k=sum(outcomes),
        n=len(outcomes),
    )
    try:
        sequence = sequence_of(outcomes)
    except UndefinedStatisticError as error:
        return summary(low=0.0, high=1.0, advice=None, changed=error.reason)
    advice = None if goal is None else stop_or_continue(sequence, goal)
    return summary(low=sequence.low, high=sequence.high, advice=advice)


def changes_of(known: Sequence[LiveTrial], task: str, policy: str) -> list[int]:
    """Return per start tried once in both conditions: +1 improved, -1 worsened, 0 the same.

    In the order in which the pairs became complete. A start tried twice in one condition is no
    pair: which of the two would count?
    """
    starts: dict[str, list[LiveTrial]] = {}
    for trial in known:
        if (trial.task, trial.policy) == (task, policy) and trial.start_id is not None:
            starts.setdefault(trial.start_id, []).append(trial)
    pairs = []
    for members in starts.values():
        by_condition = {trial.condition: trial for trial in members}
        if len(members) == 2 and by_condition.keys() == {WITHOUT, WITH}:
            pairs.append((by_condition[WITHOUT], by_condition[WITH]))
    pairs.sort(key=lambda pair: max(trial.start_ns for trial in pair))
    return [int(bool(after.recorded)) - int(bool(before.recorded)) for before, after in pairs]


def _gain(task: str, policy: str, changes: Sequence[int]) -> GainSummary | None:
    if not changes:
        return None
    summary = partial(
        GainSummary,
        task=task,
        policy=policy,
        improved=sum(c > 0 for c in changes),
        worsened=sum(c < 0 for c in changes),
        n=len(changes),
    )
    try:
        interval = pairs_sequence(changes)
    except UndefinedStatisticError as error:
        advice = Advice(stop=False, answer="open", more_trials=None)
        return summary(low=-1.0, high=1.0, advice=advice, changed=error.reason)
    advice = pairs_advice(changes, interval)
    return summary(low=interval.low, high=interval.high, advice=advice)


BOTH = (WITHOUT, WITH)


@dataclass(frozen=True, kw_only=True)
class NextStart:
    """One proposal."""

    task: str
    condition: str
    policy: str
    start_id: str | None
    """None: a start that was not tried yet."""
    reason: str


def next_start(trials: Sequence[LiveTrial], summary: SessionSummary) -> NextStart | None:
    """Propose the next trial; None when every question is settled or nothing was tried yet.

    The task and policy with the fewest known outcomes comes first. There a start that was tried in
    one condition is tried in the other; with none left, a new start begins with the condition that
    has begun fewer starts, so that neither always meets the fresher objects. Where only one
    condition was ever run, the group goes on with it.

    Args:
        trials: In the order in which they were recorded; those without an outcome count as tried
            but not as known.
    """
    open_groups = [
        (sum(t.recorded is not None for t in members), place, key, members)
        for place, (key, members) in enumerate(_groups(trials).items())
        if not _is_settled(key, members, summary)
    ]
    if not open_groups:
        return None
    _, _, (task, policy), members = min(open_groups, key=lambda group: group[:2])
    seen = {trial.condition for trial in members}
    if not seen >= set(BOTH):
        condition = _fewest(members, sorted(seen))
        return NextStart(
            task=task,
            condition=condition,
            policy=policy,
            start_id=None,
            reason="only one condition is run" if len(seen) == 1 else "it has the fewest trials",
        )
    return _complete_a_pair(task, policy, members) or _begin_a_pair(task, policy, members)


def _groups(trials: Sequence[LiveTrial]) -> dict[tuple[str, str], list[LiveTrial]]:
    groups: dict[tuple[str, str], list[LiveTrial]] = {}
    for trial in trials:
        groups.setdefault((trial.task, trial.policy), []).append(trial)
    return groups


def _is_settled(
    key: tuple[str, str], members: Sequence[LiveTrial], summary: SessionSummary
) -> bool:
    """Whether no question about this task and policy is open."""
    rates = [summary.rate(trial_key) for trial_key in {trial.key for trial in members}]
    gain = summary.gain(*key)
    asked_of_rates = any(rate is not None and rate.advice is not None for rate in rates)
    rates_done = all(rate is not None and rate.is_settled for rate in rates)
    has_both = {trial.condition for trial in members} >= set(BOTH)
    gain_done = not has_both or (gain is not None and gain.advice.stop)
    if asked_of_rates:
        return rates_done and gain_done
    return has_both and gain_done


def _fewest(members: Sequence[LiveTrial], conditions: Sequence[str]) -> str:
    return min(
        conditions,
        key=lambda name: sum(t.condition == name and t.recorded is not None for t in members),
    )


def _complete_a_pair(task: str, policy: str, members: Sequence[LiveTrial]) -> NextStart | None:
    starts: dict[str, list[str]] = {}
    for trial in members:
        if trial.start_id is not None and trial.recorded is not None:
            starts.setdefault(trial.start_id, []).append(trial.condition)
    for start_id, known in starts.items():
        # A start tried twice in one condition makes no pair any more.
        if len(known) == 1 and known[0] in BOTH:
            return NextStart(
                task=task,
                condition=BOTH[1 - BOTH.index(known[0])],
                policy=policy,
                start_id=start_id,
                reason=f"it was tried {known[0].replace('_', ' ')} only",
            )
    return None


def _begin_a_pair(task: str, policy: str, members: Sequence[LiveTrial]) -> NextStart:
    first: dict[str, str] = {}
    for trial in members:
        if trial.start_id is not None:
            first.setdefault(trial.start_id, trial.condition)
    begun = list(first.values())
    condition = min(BOTH, key=lambda name: (begun.count(name), _known(members, name)))
    return NextStart(
        task=task,
        condition=condition,
        policy=policy,
        start_id=None,
        reason=f"{begun.count(condition)} of {len(begun)} starts began with it",
    )


def _known(members: Sequence[LiveTrial], condition: str) -> int:
    return sum(t.condition == condition and t.recorded is not None for t in members)
