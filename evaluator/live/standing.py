"""What the trials so far have settled: each cell's success rate, and the gain with replanning."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

from bridge.episode.metadata import WITH, WITHOUT
from evaluator.errors import UndefinedStatisticError
from evaluator.live.ledger import LiveTrial
from evaluator.statistics.sequential import Advice, sequence_of, stop_or_continue
from evaluator.statistics.sequential_pairs import pairs_advice, pairs_sequence

Key = tuple[str, str, str]


@dataclass(frozen=True, kw_only=True)
class RateStanding:
    """One cell's recorded success rate, at any time."""

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
class GainStanding:
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
class Standing:
    """Everything that is known now."""

    rates: tuple[RateStanding, ...]
    gains: tuple[GainStanding, ...]
    unknown: int
    """Trials without a known outcome: part of nothing."""

    def rate(self, key: Key) -> RateStanding | None:
        """Return one cell."""
        return next((r for r in self.rates if (r.task, r.condition, r.policy) == key), None)

    def gain(self, task: str, policy: str) -> GainStanding | None:
        """Return the gain of one task and policy."""
        return next((g for g in self.gains if (g.task, g.policy) == (task, policy)), None)


def standing_of(trials: Sequence[LiveTrial], goal: float | None) -> Standing:
    """Work everything out anew: a corrected label changes what came after it too.

    Args:
        trials: In the order in which they were recorded.
        goal: Success rate that is asked about.
    """
    known = [trial for trial in trials if trial.recorded is not None]
    cells: dict[Key, list[bool]] = {}
    for trial in known:
        cells.setdefault(trial.key, []).append(bool(trial.recorded))
    groups = dict.fromkeys((trial.task, trial.policy) for trial in known)
    gains = (_gain(task, policy, changes_of(known, task, policy)) for task, policy in groups)
    return Standing(
        rates=tuple(_rate(key, outcomes, goal) for key, outcomes in sorted(cells.items())),
        gains=tuple(gain for gain in gains if gain is not None),
        unknown=len(trials) - len(known),
    )


def _rate(key: Key, outcomes: Sequence[bool], goal: float | None) -> RateStanding:
    task, condition, policy = key
    standing = partial(
        RateStanding,
        task=task,
        condition=condition,
        policy=policy,
        k=sum(outcomes),
        n=len(outcomes),
    )
    try:
        sequence = sequence_of(outcomes)
    except UndefinedStatisticError as error:
        return standing(low=0.0, high=1.0, advice=None, changed=error.reason)
    advice = None if goal is None else stop_or_continue(sequence, goal)
    return standing(low=sequence.low, high=sequence.high, advice=advice)


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


def _gain(task: str, policy: str, changes: Sequence[int]) -> GainStanding | None:
    if not changes:
        return None
    standing = partial(
        GainStanding,
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
        return standing(low=-1.0, high=1.0, advice=advice, changed=error.reason)
    advice = pairs_advice(changes, interval)
    return standing(low=interval.low, high=interval.high, advice=advice)
