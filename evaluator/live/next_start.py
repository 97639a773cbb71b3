"""Which start and condition to run next, so that conditions stay balanced and pairs complete."""

from collections.abc import Sequence
from dataclasses import dataclass

from bridge.episode.metadata import WITH, WITHOUT
from evaluator.live.ledger import LiveTrial
from evaluator.live.standing import Standing

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


def next_start(trials: Sequence[LiveTrial], standing: Standing) -> NextStart | None:
    """Propose the next trial; None when every question is settled or nothing was tried yet.

    The task and policy with the fewest known outcomes comes first. There a start that was tried in
    one condition is tried in the other; with none left, a new start begins with the condition that
    has begun fewer starts, so that neither always meets the fresher objects. Where only one
    condition was ever run, the cell goes on with it.

    Args:
        trials: In the order in which they were recorded; those without an outcome count as tried
            but not as known.
        standing: What they have settled.
    """
    open_groups = [
        (sum(t.recorded is not None for t in members), place, key, members)
        for place, (key, members) in enumerate(_groups(trials).items())
        if not _is_settled(key, members, standing)
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


def _is_settled(key: tuple[str, str], members: Sequence[LiveTrial], standing: Standing) -> bool:
    """Whether no question about this task and policy is open."""
    rates = [standing.rate(trial_key) for trial_key in {trial.key for trial in members}]
    gain = standing.gain(*key)
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
