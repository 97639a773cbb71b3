"""The trials of a session as they are known now: each episode once, the last word counts."""

from collections.abc import Iterable
from dataclasses import dataclass

from bridge.episode.catalogue_store import Entry

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
    def is_worth_saying(self) -> bool:
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
        condition=entry.condition,
        policy=entry.policy,
        start_id=entry.start_id,
        recorded=OUTCOMES.get(entry.outcome),
        start_ns=entry.start_ns,
    )


class Ledger:
    """All trials by episode. Takes the same news any number of times, in any order."""

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
