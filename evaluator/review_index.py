"""What the review pages show of a run: one SQLite file, so that no page reads the episodes.

``evaluate`` writes it beside its other caches. Whoever shows it compares the state of the run that
it was made from with the present one (``state_of``). It may be deleted at any time.
"""

import hashlib
import json
import os
import sqlite3
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

from bridge.episode.catalogue_query import printable
from bridge.episode.executions import NO_PLAN
from bridge.episode.provenance import software
from bridge.episode.run_folder import PART, RunFolder
from evaluator.cache import FOLDER
from evaluator.result import Interval, Measurement

FILE_NAME = "review_index.sqlite"
VERSION = 6
"""Raise it whenever a column, or what one holds, changes."""
NO_RESULTS = "no results yet"
"""Why there are no numbers of a run that was never evaluated."""


@dataclass(frozen=True, kw_only=True)
class IndexedTrial:
    """One recorded trial beside what the twin said of it; fields as in ``TrialRow``."""

    episode: str
    file: str
    """Name in ``episodes/``; empty for a trial of a table, which has no page."""
    task: str
    condition: str
    policy: str
    start_id: str | None
    recorded: bool | None
    unit: str
    k: int | None
    n: int | None
    plan_id: str | None
    num_plans: int
    num_plans_sent: int
    sim_planned: bool | None
    sim_executed: bool | None
    verdict: bool | None
    p_success: float | None
    first_failing: str | None
    failing_detail: str | None
    failing_cause: str | None
    failed_stage: str
    """The first stage labelled a failure, of a recorded failure; empty otherwise."""
    planned_replay: str | None
    executed_replay: str | None
    began_ns: int
    distance_m: float | None
    """Largest distance of the recorded tool's path from the planned replay's, the lag taken out."""
    lag_s: float | None = None
    """By how much the recorded tool comes later than the planned replay's."""
    fail_cause: str = ""
    """What kind of failure it is (``FailureKind``); empty for one that failed on neither side."""
    fail_stage: str = ""
    fail_bodies: str = ""
    start_region: str = ""
    """Where the object of its task started that is placed most differently."""

    @property
    def had_plan(self) -> bool:
        """Whether what moved the robot had been announced; also where nothing moved it."""
        return self.plan_id != NO_PLAN

    @property
    def twin(self) -> bool | None:
        """What the twin says of the trial: as planned; without a plan, as executed."""
        return self.sim_planned if self.had_plan else self.sim_executed

    @property
    def twin_replay(self) -> str | None:
        """The file that ``twin`` comes from."""
        return self.planned_replay if self.had_plan else self.executed_replay

    @property
    def agrees(self) -> bool | None:
        """Whether the twin and the outcome agree; None when one of them is unknown."""
        if self.twin is None or self.recorded is None:
            return None
        return self.twin == self.recorded


def severity(trial: IndexedTrial) -> tuple[int, float, str]:
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


SHOW = {
    "": "all",
    "disagree": "disagreements",
    "wrong_yes": "wrong yes of the twin",
    "failure": "recorded failures",
    "undecided": "undecided",
}
_SHOW = {
    "disagree": "agrees = 0",
    "wrong_yes": "twin = 1 AND recorded = 0",
    "failure": "recorded = 0",
    "undecided": "agrees IS NULL",
}
SORT = {
    "": "seq",
    "name": "episode",
    "task": "task, condition, policy, seq",
    "start": "start_id, seq",
    "recorded": "recorded, seq",
    "planned": "twin, seq",
    "cause": "ifnull(failing_cause,'~'), seq",
    "distance": "ifnull(-distance_m,1), seq",
    "date": "began_ns, seq",
}
"""Orders of the list; the first is that of ``severity``. Only the column before the first comma
and blank is turned round."""
FACETS = ("task", "condition", "policy")


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

    def order(self) -> str:
        """Return the SQL of the order: that of ``severity``."""
        return SORT[""]

    def _where_facets(self) -> tuple[list[str], list[Any]]:
        chosen = [name for name in FACETS if getattr(self, name)]
        return [f"{name}_slug = ?" for name in chosen], [getattr(self, name) for name in chosen]


@dataclass(frozen=True, kw_only=True)
class Selection(_Selected):
    """Which trials are listed, and in which order."""

    show: str = ""
    clause: str = ""
    """The first factor that failed in the twin."""
    cause: str = ""
    """And its cause."""
    stage: str = ""
    """The first stage labelled a failure."""
    q: str = ""
    """Words, in whatever order and case."""
    sort: str = ""
    page: str = ""
    """Number of the page, from 1."""

    def takes_group(self, task: str, condition: str, policy: str) -> bool:
        """Say whether a group is selected."""
        return (
            self.task in ("", task)
            and self.condition in ("", condition)
            and self.policy in ("", policy)
        )

    @property
    def page_number(self) -> int:
        """The page asked for; anything but a number asks for the first."""
        digits = self.page if self.page.isascii() and self.page.isdigit() else "1"
        return max(1, int(digits[:9]))

    def where(self) -> tuple[str, list[Any]]:
        """Return the SQL of the filters, and its values."""
        terms, values = self._where_facets()
        if self.show:
            terms.append(_SHOW.get(self.show, "0"))
        if self.clause or self.cause:
            terms.append("twin = 0")
        for name, column in (
            ("clause", "first_failing"),
            ("cause", "failing_cause"),
            ("stage", "failed_stage"),
        ):
            if getattr(self, name):
                terms.append(f"{column} = ?")
                values.append(getattr(self, name))
        for word in self.q.casefold().split():
            terms.append("instr(folded, ?) > 0")
            values.append(word)
        return " AND ".join(terms) or "1", values

    def order(self) -> str:
        """Return the SQL of the order; a minus before its name turns it round."""
        columns = SORT.get(self.sort.removeprefix("-"), SORT[""])
        if not self.sort.startswith("-"):
            return columns
        first, _, rest = columns.partition(", ")
        return f"{first} DESC" + (f", {rest}" if rest else "")


FAILURE_PARTS = {
    "cause": "fail_cause",
    "stage": "fail_stage",
    "bodies": "fail_bodies",
    "start": "start_region",
}
"""What failures are sorted by, and the columns that hold it."""
FAILED = {
    "": "all",
    "foretold": "both fail",
    "wrong_yes": "only the trial fails",
    "wrong_no": "only the twin fails",
}
_FAILED = {
    "foretold": "twin = 0 AND recorded = 0",
    "wrong_yes": "recorded = 0 AND ifnull(twin, 1) = 1",
    "wrong_no": "twin = 0 AND ifnull(recorded, 1) = 1",
}
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

    def where(self, *, but: str = "") -> tuple[str, list[Any]]:
        """Return the SQL of the filters, and its values.

        Args:
            but: One of ``FAILURE_PARTS`` whose filter is left out.
        """
        terms, values = self._where_facets()
        terms.append("fail_cause != ''")
        if self.failed:
            terms.append(_FAILED.get(self.failed, "0"))
        for name, column in FAILURE_PARTS.items():
            wanted = getattr(self, name)
            if wanted and name != but:
                terms.append(f"{column} = ?")
                values.append("" if wanted == NOT_KNOWN else wanted)
        return " AND ".join(terms), values


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
    newest_ns: int
    """When the last of its recordings, replays and labels was written [ns since 1970]."""
    num_files: int


def state_of(run: RunFolder) -> RunState:
    """Look at every file that numbers follow from: name, size and time of writing."""
    marks, newest_ns = list[str](), 0
    for folder in (run.episodes_dir, run.derived_dir, run.notes_dir):
        for name, size, written_ns in _files_of(folder):
            is_part = name.endswith(PART)  # still being written: its size says nothing yet
            marks.append(f"{folder.name}/{name} {'' if is_part else f'{size} {written_ns}'}")
            newest_ns = max(newest_ns, 0 if is_part else written_ns)
    marks.sort()
    marks += [f"{name} {stamp_of(run.path / name)}" for name in ("protocol.json", RESULTS)]
    digest = hashlib.sha256("\n".join(marks).encode("utf-8", "surrogateescape"))
    return RunState(digest=digest.hexdigest(), newest_ns=newest_ns, num_files=len(marks) - 2)


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


_INTEGERS = {"recorded", "k", "n", "sim_planned", "sim_executed", "verdict", "began_ns"}
_INTEGERS |= {"num_plans", "num_plans_sent"}
_BOOLEANS = {"recorded", "sim_planned", "sim_executed", "verdict"}
_COLUMNS = [item.name for item in fields(IndexedTrial)]
_BOOLEAN_PLACES = [index for index, name in enumerate(_COLUMNS) if name in _BOOLEANS]
_FOUND_ONLY = ("twin", "agrees", "task_slug", "condition_slug", "policy_slug", "folded")
_SEARCHED = ("episode", "task", "condition", "policy", "start_id", "failing_cause", "failed_stage")
_FILES = [item.name for item in fields(IndexedFile)]


def _create(db: sqlite3.Connection) -> None:
    kinds = [f"{name} {'INTEGER' if name in _INTEGERS else ''}" for name in _COLUMNS]
    columns = ", ".join(("seq INTEGER PRIMARY KEY", *kinds, *_FOUND_ONLY))
    db.execute(f"CREATE TABLE trials ({columns})")
    db.execute(f"CREATE TABLE files ({', '.join(_FILES)})")
    db.execute("CREATE TABLE documents (name TEXT PRIMARY KEY, content TEXT NOT NULL)")
    db.execute(f"PRAGMA user_version = {VERSION}")


def written_index(
    trials: Iterable[tuple[IndexedTrial, Mapping[str, str]]],
    files: Iterable[IndexedFile],
    about: Mapping[str, Any],
) -> bytes:
    """Return the bytes of an index."""
    with closing(sqlite3.connect(":memory:")) as db, db:
        _create(db)
        marks = ", ".join("?" * (len(_COLUMNS) + len(_FOUND_ONLY)))
        names = ", ".join((*_COLUMNS, *_FOUND_ONLY))
        db.executemany(
            f"INSERT INTO trials ({names}) VALUES ({marks})",
            (_stored([*vars(t).values(), *_found_by(t, slugs)]) for t, slugs in trials),
        )
        marks = ", ".join("?" * len(_FILES))
        db.executemany(
            f"INSERT INTO files VALUES ({marks})", (_stored(vars(file).values()) for file in files)
        )
        content = json.dumps({**about, "software": software()["version"]}, allow_nan=False)
        db.execute("INSERT INTO documents VALUES ('about', ?)", (content,))
        db.commit()
        return db.serialize()


def _stored(values: Iterable[Any]) -> list[Any]:
    """Spell out what is not valid Unicode, as in names of files."""
    return [
        printable(value) if isinstance(value, str) and not value.isascii() else value
        for value in values
    ]


def _found_by(trial: IndexedTrial, slugs: Mapping[str, str]) -> list[Any]:
    words = " ".join(str(getattr(trial, name) or "") for name in _SEARCHED).replace("_", " ")
    folded = f"{words} {trial.episode} {trial.task} {trial.condition}".casefold()
    return [trial.twin, trial.agrees, *(slugs[name] for name in FACETS), folded]


class UnusableIndexError(Exception):
    """It is not there, damaged, or of another version."""


@dataclass(frozen=True)
class ReviewIndex:
    """An index that is read: a file, or its bytes where the run cannot be written."""

    source: Path | bytes
    stamp: str = ""
    """Of the file, when it was opened."""

    @staticmethod
    def open(source: Path | bytes) -> "ReviewIndex":
        """Open an index and look at its version.

        Raises:
            UnusableIndexError: When it is not there, damaged, or of another version.
        """
        index = ReviewIndex(source, stamp_of(source) if isinstance(source, Path) else "")
        if index.about.get("software") != software()["version"]:
            raise UnusableIndexError("made by another version")
        return index

    @property
    def about(self) -> dict[str, Any]:
        """Whatever is not a list of trials or files."""
        return _about(self)

    @property
    def measurements(self) -> tuple[Measurement, ...]:
        """The numbers of ``results.json``, without the episodes behind them."""
        return _measurements(self)

    @contextmanager
    def _reading(self) -> Iterator[sqlite3.Connection]:
        name = ":memory:"
        if not isinstance(self.source, bytes):
            name = f"{self.source.absolute().as_uri()}?mode=ro"
        try:
            with closing(sqlite3.connect(name, uri=True)) as db:
                if isinstance(self.source, bytes):
                    db.deserialize(self.source)
                if db.execute("PRAGMA user_version").fetchone()[0] != VERSION:
                    raise UnusableIndexError("of another version")
                yield db
        except (sqlite3.Error, ValueError) as error:
            raise UnusableIndexError(str(error)) from error

    def trials(
        self, selection: Selection | FailureSelection, *, limit: int = -1, offset: int = 0
    ) -> tuple[IndexedTrial, ...]:
        """Return the trials of a selection in its order."""
        where, values = selection.where()
        text = (
            f"SELECT {', '.join(_COLUMNS)} FROM trials WHERE {where} ORDER BY {selection.order()}"
        )
        with self._reading() as db:
            rows = db.execute(f"{text} LIMIT ? OFFSET ?", (*values, limit, offset))
            return tuple(map(_trial, rows))

    def count(self, selection: Selection) -> int:
        """Return how many trials a selection holds."""
        where, values = selection.where()
        with self._reading() as db:
            found = db.execute(f"SELECT count(*) FROM trials WHERE {where}", values)
            return int(found.fetchone()[0])

    def totals(self) -> tuple[int, int, int]:
        """Return how many trials there are, how many were recorded, how many were replayed."""
        replayed_in = "coalesce(planned_replay, executed_replay)"
        text = f"SELECT count(*), count(nullif(file, '')), count({replayed_in}) FROM trials"
        with self._reading() as db:
            trials, recorded, replayed = db.execute(text).fetchone()
        return trials, recorded, replayed

    def trial(self, episode: str) -> IndexedTrial | None:
        """Return the trial of one recorded episode."""
        text = f"SELECT {', '.join(_COLUMNS)} FROM trials WHERE file = ? OR episode = ? LIMIT 1"
        with self._reading() as db:
            rows = db.execute(text, (f"{episode}.mcap", episode)).fetchall()
        return _trial(rows[0]) if rows else None

    def neighbours(self, selection: Selection, episode: str) -> tuple[str | None, str | None]:
        """Return the episodes before and after one in a selection; none for one outside of it."""
        where, values = selection.where()
        text = (
            "SELECT before, after FROM (SELECT episode, lag(episode) OVER w AS before, "
            f"lead(episode) OVER w AS after FROM trials WHERE file != '' AND {where} "
            f"WINDOW w AS (ORDER BY {selection.order()})) WHERE episode = ?"
        )
        with self._reading() as db:
            found = db.execute(text, (*values, episode)).fetchone()
        return found or (None, None)

    def values(self, name: str) -> tuple[tuple[str, str, int], ...]:
        """Return what a facet can be: slug, name as recorded, and number of trials."""
        if name not in FACETS:
            raise KeyError(name)
        text = f"SELECT {name}_slug, min({name}), count(*) FROM trials WHERE {name} != '' GROUP BY"
        with self._reading() as db:
            return tuple(db.execute(f"{text} {name}_slug ORDER BY 2"))

    def failure_groups(self, selection: FailureSelection) -> tuple[FailureGroup, ...]:
        """Return the kinds of failure in a selection, the most frequent first."""
        where, values = selection.where()
        columns = ", ".join(FAILURE_PARTS[name] for name in selection.parts)
        text = (
            f"SELECT {columns}, count(*), sum(ifnull(recorded, 1) = 0), "
            f"sum(ifnull(twin, 1) = 0), min(seq) FROM trials WHERE {where} "
            f"GROUP BY {columns} ORDER BY count(*) DESC, min(seq)"
        )
        with self._reading() as db:
            return tuple(
                FailureGroup(
                    parts=dict(zip(selection.parts, row, strict=False)),
                    count=row[-4],
                    recorded=row[-3],
                    twin=row[-2],
                )
                for row in db.execute(text, values)
            )

    def failure_values(self, selection: FailureSelection, name: str) -> tuple[tuple[str, int], ...]:
        """Return what one part can be under the other filters, and how often it is."""
        where, values = selection.where(but=name)
        column = FAILURE_PARTS[name]
        text = f"SELECT {column}, count(*) FROM trials WHERE {where} GROUP BY {column}"
        with self._reading() as db:
            return tuple(db.execute(f"{text} ORDER BY count(*) DESC, {column}", values))

    def files(self, *, broken: bool, limit: int = -1) -> tuple[tuple[IndexedFile, ...], int]:
        """Return the files that are no trials, and how many there are."""
        where = f"error {'!=' if broken else '='} ''"
        with self._reading() as db:
            rows = db.execute(f"SELECT * FROM files WHERE {where} LIMIT ?", (limit,)).fetchall()
            number = db.execute(f"SELECT count(*) FROM files WHERE {where}").fetchone()[0]
        names = (dict(zip(_FILES, row, strict=True)) for row in rows)
        return tuple(IndexedFile(**each) for each in names), int(number)


def _trial(row: Sequence[Any]) -> IndexedTrial:
    values = list(row)
    for place in _BOOLEAN_PLACES:
        values[place] = None if values[place] is None else bool(values[place])
    return IndexedTrial(**dict(zip(_COLUMNS, values, strict=True)))


@lru_cache(maxsize=4)
def _about(index: ReviewIndex) -> dict[str, Any]:
    with index._reading() as db:
        found = db.execute("SELECT content FROM documents WHERE name = 'about'").fetchone()
    if found is None:
        raise UnusableIndexError("nothing says what it is of")
    about = json.loads(found[0])
    if not isinstance(about, dict):
        raise UnusableIndexError("of another version")
    return about


@lru_cache(maxsize=4)
def _measurements(index: ReviewIndex) -> tuple[Measurement, ...]:
    return tuple(measurement_of(record) for record in index.about["measurements"])


def plain_record(measurement: Measurement) -> dict[str, Any]:
    """Return a measurement as JSON, without the episodes behind it."""
    record = {name: value for name, value in vars(measurement).items() if value is not None}
    record.pop("episodes")
    if measurement.interval is not None:
        record["interval"] = dict(vars(measurement.interval))
    return record


def measurement_of(record: Mapping[str, Any]) -> Measurement:
    """Read what ``plain_record`` wrote."""
    interval = record.get("interval")
    known = {"value": None, **record}
    measurement = Measurement(**{**known, "interval": None})
    return measurement if interval is None else replace(measurement, interval=Interval(**interval))
