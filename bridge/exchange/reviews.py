"""Labels of a second rater: a CSV, or the folder ``reviews/`` of a run with one file per label.

One format: trial_id, rater, time, result, cause, note, flag. In CSV they are columns, in JSON the
keys of ``schemas/review.schema.json``. The last label that a rater gave a trial counts.
"""

import fcntl
import hashlib
import json
import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from functools import lru_cache
from pathlib import Path

from bridge.errors import BridgeError, GstError, PathNotFoundError
from bridge.exchange.table_text import AS_SAVED, TableOptions, read_rows
from bridge.task.record import check_record, parse_record
from bridge.whole_file import write_whole

FOLDER = "reviews"
SCHEMA_VERSION = 1
RESULTS = {True: "success", False: "failure", None: "unknown"}
OPERATOR = "recorded label"
"""Not a rater's name: how tables call the outcome that the recording was labelled with."""
UNRATED = "unrated"
"""The result of a review that holds only a flag or a note."""
UNSAVED = ""
"""The version of a label that is not there."""


@dataclass(frozen=True, kw_only=True)
class Review:
    """What one rater said of one trial."""

    trial_id: str
    """Id of the recorded episode, or the trial id of a table."""
    rater: str
    time: str = ""
    """When, as ISO 8601; later labels of one rater replace earlier ones."""
    result: str = "unknown"
    """success, failure, unknown, or unrated."""
    cause: str = ""
    """Why, in a word or two, where it failed."""
    note: str = ""
    flag: bool = False

    @property
    def success(self) -> bool | None:
        """Whether the trial succeeded, None where the rater could not tell."""
        return {"success": True, "failure": False}.get(self.result)

    @property
    def says(self) -> tuple[str, str, str, bool]:
        """What the rater said, whenever it was."""
        return self.result, self.cause, self.note, self.flag

    def write(self, run_path: Path) -> Path:
        """Keep the label in a run; an earlier one of the same rater is replaced."""
        path = _path(run_path, self.trial_id, self.rater)
        path.parent.mkdir(parents=True, exist_ok=True)
        record = {"schema_version": SCHEMA_VERSION, **asdict(self)}
        check_record(record, name="review")
        write_whole(path, (json.dumps(record, indent=1, ensure_ascii=False) + "\n").encode())
        return path


COLUMNS = tuple(field.name for field in fields(Review))


@dataclass(frozen=True, kw_only=True)
class SavedReview:
    """A label as it lies in a run, and which version of it."""

    review: Review | None
    """None where there is none."""
    version: str = UNSAVED


class ReviewConflictError(BridgeError):
    """A label was changed elsewhere since it was read."""

    def __init__(self, *, saved: SavedReview) -> None:
        """Remember the label that is there now."""
        self.saved = saved
        now = "is gone" if saved.review is None else f"now says {saved.review.result}"
        super().__init__(
            f"This label was changed elsewhere since you read it: it {now}. "
            "Look at it, then answer again to replace it."
        )


def saved_review(run_path: Path, trial_id: str, rater: str) -> SavedReview:
    """Return the label that a rater gave a trial in the run's own files."""
    path = _path(run_path, trial_id, rater)
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return SavedReview(review=None)
    return SavedReview(review=_of_json(data), version=hashlib.sha256(data).hexdigest()[:16])


def save_review(
    run_path: Path, trial_id: str, rater: str, review: Review | None, *, seen: str
) -> SavedReview:
    """Save a label, or take it away, unless somebody else changed it meanwhile.

    It is on disk when this returns. Processes and threads that save at once wait for each other.
    """
    path = _path(run_path, trial_id, rater)
    path.parent.mkdir(parents=True, exist_ok=True)
    with _one_at_a_time(path.parent) as folder:
        saved = saved_review(run_path, trial_id, rater)
        if saved.version != seen:
            now = saved.review
            if (now.says if now else None) == (review.says if review else None):
                return saved
            raise ReviewConflictError(saved=saved)
        if review is None:
            path.unlink(missing_ok=True)
        else:
            review.write(run_path)
        os.fsync(folder)  # the name in the folder, too
        return saved_review(run_path, trial_id, rater)


@contextmanager
def _one_at_a_time(folder: Path) -> Iterator[int]:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield descriptor
    finally:
        os.close(descriptor)


def _path(run_path: Path, trial_id: str, rater: str) -> Path:
    return run_path / FOLDER / f"{_plain(trial_id)}.{_plain(rater)}.json"


def _plain(name: str) -> str:
    """A name that is safe in a file's name, and another one for each other name."""
    plain = re.sub(r"[^A-Za-z0-9_-]", "_", name)[:80]
    if plain == name:
        return plain
    return f"{plain}-{hashlib.sha256(name.encode('utf-8', 'surrogatepass')).hexdigest()[:12]}"


def read_reviews(path: Path, options: TableOptions = AS_SAVED) -> list[Review]:
    """Read labels from a CSV, a JSON file, or a folder of them."""
    if path.is_dir():
        return latest([r for file in _files(path) for r in read_reviews(file, options)])
    if not path.is_file():
        raise PathNotFoundError(path=path, what="reviews", hint=f"Columns: {', '.join(COLUMNS)}.")
    if path.suffix.lower() == ".json":
        return [_of_json(path.read_bytes())]
    found = []
    for row in read_rows(path, ("trial_id", "rater", "result"), COLUMNS, options):
        for name in ("trial_id", "rater"):
            if not row.text(name):
                raise row.refuse(f"{name} is empty", f"Every label needs a {name}")
        found.append(
            Review(
                trial_id=row.text("trial_id"),
                rater=row.text("rater"),
                time=row.text("time"),
                result=RESULTS[row.answer("result")],
                cause=row.text("cause"),
                note=row.text("note"),
                flag=row.answer("flag") is True,
            )
        )
    return latest(found)


def _of_json(data: bytes) -> Review:
    record = parse_record(data, name="review")
    return Review(**{name: record[name] for name in COLUMNS if name in record})


def _files(folder: Path) -> list[Path]:
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in (".csv", ".json"))


def readable_reviews(run_path: Path) -> tuple[list[Review], list[str]]:
    """Return the labels in a run, and what is wrong with the files that hold none.

    Files that did not change since the last call are not read again.
    """
    found: list[Review] = []
    problems = []
    folder = run_path / FOLDER
    for path in _files(folder) if folder.is_dir() else ():
        try:
            status = path.stat()
            found += _read(path, status.st_ino, status.st_mtime_ns, status.st_size)
        except FileNotFoundError:  # taken away meanwhile
            continue
        except GstError as error:
            problems.append(f"{path.name}: {error}")
    return latest(found), problems


@lru_cache(maxsize=100_000)
def _read(path: Path, _inode: int, _mtime_ns: int, _size: int) -> tuple[Review, ...]:
    return tuple(read_reviews(path))


def latest(reviews: Sequence[Review]) -> list[Review]:
    """Keep each rater's last label of each trial, by time, then by order."""
    kept: dict[tuple[str, str], Review] = {}
    for review in sorted(reviews, key=lambda review: review.time):
        kept[review.trial_id, review.rater] = review
    return list(kept.values())
