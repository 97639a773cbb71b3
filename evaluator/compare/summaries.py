"""How each trial moved and where its objects came to lie, read once from its files and then kept.

What is kept follows from the trial's files, the plan sent and the task file, all named by their
content in the key. Only summaries stay in memory, no series.
"""

import functools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from bridge.episode.provenance import hash_file
from bridge.episode.reader import Episode
from bridge.task.data import dataset_file
from bridge.terminal import Output
from evaluator.compare.cache import SummaryCache
from evaluator.compare.contents import ODD, broken
from evaluator.compare.known_task import known_task
from evaluator.compare.label import Witness, summarise_witness
from evaluator.compare.motion import MotionSummary, summarise_motions
from evaluator.compare.states import StateSummary, summarise_states
from evaluator.compare.trial import TRAJECTORIES, Trial
from evaluator.result import Exclusion


@dataclass(frozen=True, kw_only=True)
class Summaries:
    """Everything that had to be read from the series of the trials."""

    motions: tuple[MotionSummary, ...] = ()
    states: tuple[StateSummary, ...] = ()
    witnesses: tuple[Witness, ...] = ()
    left_out: tuple[Exclusion, ...] = ()
    """Trials of which something could not be read."""


class _Files:
    """The episodes of one trial, each opened at most once, and only if somebody asks."""

    def __init__(self, trial: Trial, plan_id: str) -> None:
        self._trial = trial
        self.plan_id = plan_id

    @cached_property
    def recorded(self) -> Episode:
        return Episode.open(self._trial.file.path)

    @cached_property
    def replays(self) -> dict[str, Episode]:
        return {name: replay.episode for name, replay in self._trial.replays.items()}

    @cached_property
    def localised(self) -> Episode | None:
        return None if self._trial.localised is None else self._trial.localised.episode


@dataclass(frozen=True, kw_only=True)
class _Part:
    kind: type[Any]
    scope: str
    make: Callable[[_Files], tuple[Any, ...]]
    key: Callable[[Trial], str]


def sum_up(trials: Sequence[Trial], cache: SummaryCache, output: Output) -> Summaries:
    """Summarise motions, final states and localised success of every trial with a plan sent."""
    found: dict[type[Any], list[Any]] = {part.kind: [] for part in PARTS}
    unknown: list[tuple[Trial, list[_Part]]] = []
    for trial in trials:
        if trial.row.plan_id is None:
            continue
        kept = {part.kind: cache.find(part.kind, part.key(trial)) for part in PARTS}
        parts = [part for part in PARTS if kept[part.kind] is None]
        if parts:
            unknown.append((trial, parts))
        for kind, known in kept.items():
            found[kind] += known or ()
    left_out = []
    if unknown:
        with output.progress("compare motions", len(unknown)) as advance:
            for done, (trial, parts) in enumerate(unknown, start=1):
                left_out += _make(trial, parts, cache, found)
                advance(done, trial.row.episode)
    return Summaries(
        motions=_in_order(found[MotionSummary], trials),
        states=_in_order(found[StateSummary], trials),
        witnesses=_in_order(found[Witness], trials),
        left_out=tuple(left_out),
    )


def _make(
    trial: Trial,
    parts: Iterable[_Part],
    cache: SummaryCache,
    found: dict[type[Any], list[Any]],
) -> list[Exclusion]:
    files = _Files(trial, trial.row.plan_id or "")
    left_out = []
    for part in parts:
        try:
            made = part.make(files)
        except ODD as error:
            left_out.append(broken(trial.row.episode, error, scope=part.scope))
            continue
        cache.keep(part.kind, part.key(trial), made)
        found[part.kind] += made
    return left_out


def _in_order(found: Iterable[Any], trials: Iterable[Trial]) -> tuple[Any, ...]:
    """Sort by trial, so that a number does not depend on what was kept and what was read."""
    place = {trial.row.episode: number for number, trial in enumerate(trials)}
    return tuple(sorted(found, key=lambda summary: place[summary.episode]))


def _motions(files: _Files) -> tuple[MotionSummary, ...]:
    if not files.replays:
        return ()
    return summarise_motions(files.recorded, files.replays, plan_id=files.plan_id)


def _states(files: _Files) -> tuple[StateSummary, ...]:
    return summarise_states(files.recorded, files.replays, files.localised, plan_id=files.plan_id)


def _witness(files: _Files) -> tuple[Witness, ...]:
    if files.localised is None:
        return ()
    found = summarise_witness(files.recorded, files.localised, plan_id=files.plan_id)
    return () if found is None else (found,)


def _replays_key(trial: Trial) -> str:
    hashes = [trial.replays[name].sha256 if name in trial.replays else "-" for name in TRAJECTORIES]
    return " ".join([trial.file.sha256, *hashes, str(trial.row.plan_id)])


def _localised_key(trial: Trial) -> str:
    localised = "-" if trial.localised is None else trial.localised.sha256
    return f"{trial.file.sha256} {localised} {trial.row.plan_id} {_task_sha256(trial.row.task)}"


def _states_key(trial: Trial) -> str:
    return f"{_replays_key(trial)} {_localised_key(trial)}"


@functools.cache
def _task_sha256(name: str) -> str:
    return "-" if known_task(name) is None else hash_file(dataset_file("tasks", name))


PARTS = (
    _Part(kind=MotionSummary, scope="motion", make=_motions, key=_replays_key),
    _Part(kind=StateSummary, scope="final states", make=_states, key=_states_key),
    _Part(kind=Witness, scope="label", make=_witness, key=_localised_key),
)
