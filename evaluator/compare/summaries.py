"""How each trial moved and where its objects came to lie, read once from its files and then kept.

What is kept follows from the trial's files, the plan sent and the task file, all named by their
content in the key. Only summaries stay in memory, no series.
"""

import gc
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any

from bridge.episode import streams
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.process_pool import ALONE, ProcessPool, cores
from bridge.task.find import MissingTaskError, find_task_file
from bridge.task.task_file import Task
from bridge.terminal import Output
from evaluator.cache import SummaryCache
from evaluator.compare.baselines import RuleSummary, apply_rule
from evaluator.compare.motion import MotionSummary, summarise_motions
from evaluator.compare.states import StateSummary, summarise_states
from evaluator.compare.trial import TRAJECTORIES, Trial
from evaluator.result import Exclusion
from evaluator.run_reader.contents import ODD, broken

MAX_PROCESSES = 32
"""Beyond this the one that collects what the others found cannot keep up."""
COMPARE_S = 0.03
"""About what comparing one trial takes [s]."""


@dataclass(frozen=True, kw_only=True)
class Summaries:
    """Everything that had to be read from the series of the trials."""

    motions: tuple[MotionSummary, ...] = ()
    states: tuple[StateSummary, ...] = ()
    rules: tuple[RuleSummary, ...] = ()
    left_out: tuple[Exclusion, ...] = ()
    """Trials of which something could not be read."""


@dataclass(frozen=True, kw_only=True)
class _Files:
    """The episodes of one trial, each opened at most once, and only if somebody asks."""

    episode: str
    plan_id: str
    paths: Mapping[str, Path]
    """Of the recording, its localisation and its replays."""

    @cached_property
    def recorded(self) -> Episode:
        return Episode.open(self.paths["recorded"])

    @cached_property
    def replays(self) -> dict[str, Episode]:
        return {n: Episode.open(path) for n, path in self.paths.items() if n in TRAJECTORIES}

    @cached_property
    def localised(self) -> Episode | None:
        path = self.paths.get("localised")
        return None if path is None else Episode.open(path)

    @cached_property
    def task(self) -> Task | None:
        return recorded_task(self.recorded)


def recorded_task(episode: Episode) -> Task | None:
    """Load the task an episode was recorded with; None where its file is nowhere."""
    try:
        return streams.task_file(episode).task()
    except MissingTaskError:
        return None


@dataclass(frozen=True, kw_only=True)
class _Part:
    kind: type[Any]
    scope: str
    make: Callable[[_Files], tuple[Any, ...]]
    made_from: tuple[str, ...]
    """What the key names: replays, localised or both, as ``_hashes`` has them."""

    def key(self, hashes: Mapping[str, str]) -> str:
        return " ".join([hashes[name] for name in self.made_from])


_Job = tuple[_Files, tuple[_Part, ...]]


def evaluation_pool(processes: int | None = None) -> ProcessPool:
    """Processes for reading and comparing; one for each core by default, none for one."""
    size = min(cores(), MAX_PROCESSES) if processes is None else processes
    return ProcessPool(size if size > 1 else 0, prepare=get_ready, quiet=True)


def get_ready(_: None) -> None:
    """Make a new process ready; what nearly all work needs was imported to call this."""
    gc.collect()
    gc.freeze()  # nothing loaded so far is garbage
    # What would be printed is told by the owner, who does it once more.
    warnings.simplefilter("error", append=True)


def sum_up(
    trials: Sequence[Trial],
    cache: SummaryCache,
    output: Output,
    pool: ProcessPool = ALONE,
) -> Summaries:
    """Summarise motions and final states of every trial with a plan sent."""
    found: dict[type[Any], list[Any]] = {part.kind: [] for part in PARTS}
    unknown: list[tuple[Trial, _Job]] = []
    for trial in trials:
        if trial.row.plan_id is None:
            continue
        hashes = _hashes(trial)
        kept = {part.kind: cache.find(part.kind, part.key(hashes)) for part in PARTS}
        parts = tuple(part for part in PARTS if kept[part.kind] is None)
        if parts:
            made_of = {"recorded": trial.file, **trial.replays, "localised": trial.localised}
            paths = {name: file.path for name, file in made_of.items() if file is not None}
            files = _Files(episode=trial.row.episode, plan_id=trial.row.plan_id, paths=paths)
            unknown.append((trial, (files, parts)))
        for kind, known in kept.items():
            found[kind] += known or ()
    left_out: list[Exclusion] = []
    if unknown:
        jobs = [job for _, job in unknown]
        with output.progress("compare motions", len(unknown)) as advance:
            all_made = zip(unknown, pool.map(_make, jobs, each_s=COMPARE_S), strict=True)
            for done, ((trial, (_, parts)), made) in enumerate(all_made, start=1):
                hashes = _hashes(trial)
                for part, summaries in zip(parts, made, strict=True):
                    if isinstance(summaries, Exclusion):
                        left_out.append(summaries)
                    else:
                        cache.keep(part.kind, part.key(hashes), summaries)
                        found[part.kind] += summaries
                advance(done, trial.row.episode)
    return Summaries(
        motions=_in_order(found[MotionSummary], trials),
        states=_in_order(found[StateSummary], trials),
        rules=_in_order(found[RuleSummary], trials),
        left_out=tuple(left_out),
    )


def _make(job: _Job) -> list[tuple[Any, ...] | Exclusion]:
    """Return the summaries of each part asked for, or why there are none."""
    files, parts = job
    made: list[tuple[Any, ...] | Exclusion] = []
    for part in parts:
        try:
            made.append(part.make(files))
        except ODD as error:
            made.append(broken(files.episode, error, scope=part.scope))
    return made


def _in_order(found: Iterable[Any], trials: Iterable[Trial]) -> tuple[Any, ...]:
    """Sort by trial, so that a number does not depend on what was kept and what was read."""
    place = {trial.row.episode: number for number, trial in enumerate(trials)}
    return tuple(sorted(found, key=lambda summary: place[summary.episode]))


def _motions(files: _Files) -> tuple[MotionSummary, ...]:
    there = bool(files.replays)
    return summarise_motions(files.recorded, files.replays, plan_id=files.plan_id) if there else ()


def _states(files: _Files) -> tuple[StateSummary, ...]:
    return summarise_states(
        files.recorded, files.replays, files.localised, plan_id=files.plan_id, task=files.task
    )


def _rules(files: _Files) -> tuple[RuleSummary, ...]:
    found = apply_rule(files.recorded, files.localised, plan_id=files.plan_id, task=files.task)
    return () if found is None else (found,)


def _hashes(trial: Trial) -> dict[str, str]:
    """Name the bytes that a trial's summaries follow from."""
    recorded, plan_id = trial.file.sha256, trial.row.plan_id
    made = [*map(trial.replays.get, TRAJECTORIES), trial.localised]
    *replays, localised = ("-" if file is None else file.sha256 for file in made)
    task = _task_sha256(trial.row.task, trial.file.folder)
    return {
        "replays": " ".join([recorded, *replays, str(plan_id)]),
        "localised": f"{recorded} {localised} {plan_id} {task}",
    }


@cache
def _task_sha256(name: str, folder: Path) -> str:
    """Hash the file of that name in a run's ``tasks/`` or among the shipped; "-" without one."""
    try:
        return find_task_file(name, tasks_dir=RunFolder(folder).tasks_dir).sha256
    except MissingTaskError:
        return "-"


PARTS = (
    _Part(kind=MotionSummary, scope="motion", make=_motions, made_from=("replays",)),
    _Part(
        kind=StateSummary, scope="final states", make=_states, made_from=("replays", "localised")
    ),
    _Part(kind=RuleSummary, scope="baselines", make=_rules, made_from=("localised",)),
)
