"""What the review pages show of a run: one file, read whole, so that no page reads the episodes.

``evaluate`` writes it beside its other caches. Whoever shows it compares the state of the run that
it was made from with the present one (``state_of``). It may be deleted at any time.
"""

import hashlib
import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from bridge.episode.catalogue_query import printable
from bridge.episode.provenance import software
from bridge.episode.run_folder import PART, RunFolder
from evaluator.cache import FOLDER, packed
from evaluator.quantity import slug
from evaluator.result import Measurement
from evaluator.trial_row import TrialRow

FILE_NAME = "review_index.msgpack"
VERSION = 11
"""Raise it whenever what a field holds changes."""


def severity(trial: TrialRow) -> tuple[int, float, str]:
    """Sort trials: a wrong yes, a wrong no, undecided, the rest; in each the farthest first.

    A wrong yes, success in the twin of a trial that failed, sends a bad plan to a robot.
    """
    agreed = trial.agrees
    rank = 2 if agreed is None else 3 if agreed else 0 if trial.twin else 1
    return rank, -(trial.distance_m or 0.0), trial.episode


@dataclass(frozen=True, kw_only=True)
class IndexedFile:
    """A file of the run that is not a trial: a scan, an import, or one that cannot be read."""

    name: str
    kind: str = ""
    task: str = ""
    source: str = ""
    """Robot or simulator that an imported recording names."""
    duration_s: float = 0.0
    error: str = ""
    """Why it cannot be read; empty for one that can."""


_SHOW: dict[str, tuple[str, Callable[[TrialRow], bool]]] = {
    "": ("all", lambda _: True),
    "disagree": ("disagreements", lambda trial: trial.agrees is False),
    "wrong_yes": (
        "wrong yes of the twin",
        lambda trial: trial.twin is True and trial.recorded is False,
    ),
    "failure": ("recorded failures", lambda trial: trial.recorded is False),
    "undecided": ("undecided", lambda trial: trial.agrees is None),
}
SHOW = {name: words for name, (words, _) in _SHOW.items()}
SORT: dict[str, tuple[Callable[[TrialRow], Any], ...]] = {
    "": (),
    "name": (lambda trial: trial.episode,),
    "task": (lambda trial: trial.task, lambda trial: (trial.condition, trial.policy)),
    "start": (lambda trial: trial.start_id or "",),
    "recorded": (lambda trial: -1 if trial.recorded is None else trial.recorded,),
    "planned": (lambda trial: -1 if trial.twin is None else trial.twin,),
    "cause": (lambda trial: trial.failing_cause or "~",),
    "distance": (lambda trial: 1.0 if trial.distance_m is None else -trial.distance_m,),
}
"""Orders of the list: what comes first, and what then; the first is that of ``severity``. Only what
comes first is turned round."""
FACETS = ("task", "condition", "policy")
_SEARCHED = ("episode", "task", "condition", "policy", "start_id", "failing_cause", "failed_stage")
_slug = cache(slug)

Chosen = TypeVar("Chosen", bound="_Selected")


@dataclass(frozen=True, kw_only=True)
class _Selected:
    """What lists of trials are selected by; empty means all. Tasks and so on are slugs."""

    task: str = ""
    condition: str = ""
    policy: str = ""

    @classmethod
    def of(cls: type[Chosen], query: Mapping[str, str]) -> Chosen:
        """Read the query of an address; unknown values simply select nothing."""
        return cls(**{item.name: query.get(item.name, "") for item in fields(cls)})

    def query(self, **changes: str) -> dict[str, str]:
        """Return this selection as a query, with some fields changed, from its first page."""
        return {**vars(self), "page": "", **changes}

    def takes(self, trial: TrialRow) -> bool:
        """Say whether a trial is selected."""
        asked = ((wanted, name) for name in FACETS if (wanted := getattr(self, name)))
        return all(_slug(getattr(trial, name)) == wanted for wanted, name in asked)

    def ordered(self, trials: Sequence[TrialRow]) -> list[TrialRow]:
        """Return trials in the order asked for."""
        return list(trials)


@dataclass(frozen=True, kw_only=True)
class Selection(_Selected):
    """Which trials are listed, and in which order."""

    show: str = ""
    q: str = ""
    """Words, in whatever order and case."""
    sort: str = ""
    page: str = ""
    """Number of the page, from 1."""

    @property
    def page_number(self) -> int:
        """The page asked for; anything but a number asks for the first."""
        digits = self.page if self.page.isascii() and self.page.isdigit() else "1"
        return max(1, int(digits[:9]))

    def takes(self, trial: TrialRow) -> bool:
        """Say whether a trial is selected."""
        if not super().takes(trial):
            return False
        if self.show not in _SHOW or not _SHOW[self.show][1](trial):
            return False
        return self._is_found(trial)

    def _is_found(self, trial: TrialRow) -> bool:
        if not self.q:
            return True
        told = " ".join(str(getattr(trial, name) or "") for name in _SEARCHED)
        text = f"{told} {told.replace('_', ' ')}".casefold()
        return all(word in text for word in self.q.casefold().split())

    def ordered(self, trials: Sequence[TrialRow]) -> list[TrialRow]:
        """Return trials in the order asked for; a minus before its name turns it round."""
        found, is_turned = list(trials), self.sort.startswith("-")
        keys = SORT.get(self.sort.removeprefix("-"), ())
        if not keys:
            return found[::-1] if is_turned else found
        for key in keys[:0:-1]:
            found.sort(key=key)
        return sorted(found, key=keys[0], reverse=is_turned)


FAILURE_PARTS = {name: f"fail_{name}" for name in ("cause", "stage", "bodies")}
FAILURE_PARTS["start"] = "start_region"
"""What failures are sorted by, and the fields that hold it."""
_FAILED = {
    "": ("all", None),
    "foretold": ("both fail", (True, True)),
    "wrong_yes": ("only the trial fails", (True, False)),
    "wrong_no": ("only the twin fails", (False, True)),
}
"""Words, and whether the trial fails, and whether the twin."""
FAILED = {name: words for name, (words, _) in _FAILED.items()}
NOT_KNOWN = "-"
"""Selects failures of which a part is not known: an empty value selects all."""


@dataclass(frozen=True, kw_only=True)
class FailureSelection(_Selected):
    """Which failures are shown, and by what they are grouped."""

    failed: str = ""
    """One of ``FAILED``."""
    cause: str = ""
    stage: str = ""
    bodies: str = ""
    start: str = ""
    by: str = ""
    """Names of ``FAILURE_PARTS`` joined by dots."""
    page: str = ""

    @property
    def parts(self) -> tuple[str, ...]:
        """What failures are grouped by; all of ``FAILURE_PARTS`` where nothing is chosen."""
        chosen = self.by.split(".")
        return tuple(name for name in FAILURE_PARTS if name in chosen) or tuple(FAILURE_PARTS)

    def takes(self, trial: TrialRow) -> bool:
        """Say whether a trial is a failure that is selected."""
        if not trial.fail_cause or not super().takes(trial):
            return False
        who = trial.recorded is False, trial.twin is False
        if self.failed and _FAILED.get(self.failed, ("", None))[1] != who:
            return False
        asked = ((getattr(self, name), field) for name, field in FAILURE_PARTS.items())
        return all(wanted in ("", getattr(trial, field) or NOT_KNOWN) for wanted, field in asked)


@dataclass(frozen=True, kw_only=True)
class FailureGroup:
    """Failures of one kind."""

    parts: Mapping[str, str]
    """By name of ``FAILURE_PARTS``; only those that are grouped by."""
    count: int
    recorded: int
    """How many of them failed as recorded."""
    twin: int
    """How many failed in the twin."""


@dataclass(frozen=True, kw_only=True)
class RunState:
    """What the disk says of a run without opening a file."""

    digest: str
    """Of its recordings, replays and labels."""
    results: str
    """Stamp of its results."""
    num_files: int


def state_of(run: RunFolder) -> RunState:
    """Look at every file that numbers follow from: name, size and time of writing."""
    marks = list[str]()
    for folder in (run.episodes_dir, run.derived_dir, run.notes_dir):
        for name, size, written_ns in _files_of(folder):
            is_part = name.endswith(PART)  # still being written: its size says nothing yet
            marks.append(f"{folder.name}/{name} {'' if is_part else f'{size} {written_ns}'}")
    marks = [*sorted(marks), stamp_of(run.path / "protocol.json")]
    digest = hashlib.sha256("\n".join(marks).encode("utf-8", "surrogateescape"))
    results = stamp_of(run.path / RESULTS)
    return RunState(digest=digest.hexdigest(), results=results, num_files=len(marks) - 1)


RESULTS = "results/results.json"


def _files_of(folder: Path) -> Iterator[tuple[str, int, int]]:
    try:
        with os.scandir(folder) as entries:
            for entry in entries:
                try:
                    if not entry.is_dir(follow_symlinks=False):
                        found = entry.stat()
                        yield entry.name, found.st_size, found.st_mtime_ns
                except OSError:  # it went away, or its link leads nowhere
                    yield entry.name, 0, 0
    except OSError:  # not there, or not ours to read
        return


def stamp_of(path: Path) -> str:
    """Return size and time of writing of one file; empty where there is none."""
    try:
        found = path.stat()
    except OSError:
        return ""
    return f"{found.st_size}.{found.st_mtime_ns}"


def index_path(run: RunFolder) -> Path:
    """Where a run's index lies."""
    return run.results_dir / FOLDER / FILE_NAME


class UnusableIndexError(Exception):
    """It is not there, damaged, or of another version."""


@dataclass(frozen=True, kw_only=True)
class _Content:
    version: int
    software: str
    about: dict[str, Any]
    trials: tuple[TrialRow, ...]
    files: tuple[IndexedFile, ...]
    measurements: tuple[Measurement, ...]


_decode = msgspec.msgpack.Decoder(_Content).decode


def written_index(
    trials: Iterable[TrialRow],
    files: Iterable[IndexedFile],
    about: Mapping[str, Any],
    measurements: Iterable[Measurement] = (),
) -> bytes:
    """Return the bytes of an index; what is not valid Unicode, as names of files, is spelt out."""
    content = _Content(
        version=VERSION,
        software=software()["version"],
        about=dict(about),
        trials=tuple(trials),
        files=tuple(files),
        measurements=tuple(replace(each, episodes=()) for each in measurements),
    )
    try:
        return packed(content)
    except UnicodeEncodeError:
        trials, files = tuple(map(_spelt, content.trials)), tuple(map(_spelt, content.files))
        return packed(replace(content, trials=trials, files=files))


Item = TypeVar("Item", TrialRow, IndexedFile)


def _spelt(item: Item) -> Item:
    texts: dict[str, Any] = {n: printable(v) for n, v in vars(item).items() if isinstance(v, str)}
    return replace(item, **texts)


class ReviewIndex:
    """An index that was read."""

    def __init__(self, source: Path | bytes) -> None:
        """Read a file, or its bytes where the run cannot be written.

        Raises:
            UnusableIndexError: When it is not there, damaged, or of another version.
        """
        try:
            content = _decode(source if isinstance(source, bytes) else source.read_bytes())
        except (OSError, ValueError) as error:
            raise UnusableIndexError(str(error)) from error
        if (content.version, content.software) != (VERSION, software()["version"]):
            raise UnusableIndexError("made by another version")
        self._content = content
        self.about = content.about
        """Whatever is not a list of trials or files."""
        self.measurements = content.measurements
        """The numbers of ``results.json``, without the episodes behind them."""

    def is_of(self, state: RunState) -> bool:
        """Say whether the run is as it was read."""
        return bool(self.about["state"] == [state.digest, state.results])

    def trials(
        self, selection: _Selected, *, limit: int | None = None, offset: int = 0
    ) -> tuple[TrialRow, ...]:
        """Return the trials of a selection in its order."""
        found = selection.ordered(list(filter(selection.takes, self._content.trials)))
        return tuple(found[offset : None if limit is None else offset + limit])

    def count(self, selection: Selection) -> int:
        """Return how many trials a selection holds."""
        return sum(map(selection.takes, self._content.trials))

    def totals(self) -> tuple[int, int, int]:
        """Return how many trials there are, how many were recorded, how many were replayed."""
        trials = self._content.trials
        replayed = sum(bool(each.planned_replay or each.executed_replay) for each in trials)
        return len(trials), sum(bool(each.file) for each in trials), replayed

    def trial(self, episode: str) -> TrialRow | None:
        """Return the trial of one recorded episode."""
        return self._by_name.get(episode)

    @cached_property
    def _by_name(self) -> dict[str, TrialRow]:
        trials = self._content.trials
        of_file = {each.file.removesuffix(".mcap"): each for each in trials if each.file}
        return {each.episode: each for each in trials} | of_file

    def neighbours(self, selection: Selection, episode: str) -> tuple[str | None, str | None]:
        """Return the episodes before and after one in a selection; none for one outside of it."""
        names = [None, *(each.episode for each in self.trials(selection) if each.file), None]
        place = names.index(episode) if episode in names else 0
        return (names[place - 1], names[place + 1]) if place else (None, None)

    def values(self, name: str) -> tuple[tuple[str, str, int], ...]:
        """Return what a facet can be: slug, name as recorded, and number of trials."""
        if name not in FACETS:
            raise KeyError(name)
        counts = Counter(getattr(each, name) for each in self._content.trials)
        found: dict[str, tuple[str, str, int]] = {}
        for each in sorted(filter(None, counts)):
            _, first, number = found.get(_slug(each), ("", each, 0))
            found[_slug(each)] = _slug(each), first, number + counts[each]
        return tuple(found.values())

    def failure_groups(self, selection: FailureSelection) -> tuple[FailureGroup, ...]:
        """Return the kinds of failure in a selection, the most frequent first."""
        groups: dict[tuple[str, ...], list[TrialRow]] = {}
        for trial in self.trials(selection):
            kind = tuple(getattr(trial, FAILURE_PARTS[name]) for name in selection.parts)
            groups.setdefault(kind, []).append(trial)
        return tuple(
            FailureGroup(
                parts=dict(zip(selection.parts, kind, strict=True)),
                count=len(trials),
                recorded=sum(each.recorded is False for each in trials),
                twin=sum(each.twin is False for each in trials),
            )
            for kind, trials in sorted(groups.items(), key=lambda item: -len(item[1]))
        )

    def files(
        self, *, broken: bool, limit: int | None = None
    ) -> tuple[tuple[IndexedFile, ...], int]:
        """Return the files that are no trials, and how many there are."""
        found = [each for each in self._content.files if bool(each.error) is broken]
        return tuple(found[:limit]), len(found)
