"""Labels of a second rater: a CSV, or the folder ``reviews/`` of a run with one file per label.

One format: trial_id, rater, time, result, cause. In CSV they are columns, in JSON the keys of
``schemas/review.schema.json``. The last label that a rater gave a trial counts.
"""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

from bridge.errors import PathNotFoundError
from bridge.exchange.table_text import AS_SAVED, TableOptions, read_rows
from bridge.task.record import check_record, parse_record
from bridge.whole_file import write_whole

FOLDER = "reviews"
SCHEMA_VERSION = 1
RESULTS = {True: "success", False: "failure", None: "unknown"}


@dataclass(frozen=True, kw_only=True)
class Review:
    """What one rater said of one trial."""

    trial_id: str
    """Id of the recorded episode, or the trial id of a table."""
    rater: str
    time: str = ""
    """When, as ISO 8601; later labels of one rater replace earlier ones."""
    result: str = "unknown"
    """success, failure or unknown."""
    cause: str = ""
    """Why, in a word or two, where it failed."""

    @property
    def success(self) -> bool | None:
        """Whether the trial succeeded, None where the rater could not tell."""
        return {"success": True, "failure": False}.get(self.result)

    def write(self, run_path: Path) -> Path:
        """Keep the label in a run; an earlier one of the same rater is replaced.

        Raises:
            InvalidRecordError: When it does not fit the schema.
        """
        record = {"schema_version": SCHEMA_VERSION, **asdict(self)}
        check_record(record, name="review")
        path = run_path / FOLDER / f"{_plain(self.trial_id)}.{_plain(self.rater)}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, (json_text(record) + "\n").encode())
        return path


COLUMNS = tuple(field.name for field in fields(Review))


def json_text(record: dict[str, object]) -> str:
    """Write a record of one label, each key on a line."""
    return json.dumps(record, indent=1, ensure_ascii=False)


def _plain(name: str) -> str:
    return "".join(c if c.isalnum() or c in "-_" else "_" for c in name)


def read_reviews(path: Path, options: TableOptions = AS_SAVED) -> list[Review]:
    """Read labels from a CSV, a JSON file, or a folder of them.

    Args:
        path: The file or folder; files of other kinds are passed over.
        options: Columns whose names differ from ours.

    Raises:
        PathNotFoundError: When it is not there.
        TableError: Naming the row of a CSV that is no label.
        InvalidRecordError: When a JSON file does not fit the schema.
    """
    if path.is_dir():
        files = sorted(p for p in path.iterdir() if p.suffix.lower() in (".csv", ".json"))
        return latest([review for file in files for review in read_reviews(file, options)])
    if not path.is_file():
        raise PathNotFoundError(path=path, what="reviews", hint=f"Columns: {', '.join(COLUMNS)}.")
    if path.suffix.lower() == ".json":
        record = parse_record(path.read_bytes(), name="review")
        return [Review(**{name: record[name] for name in COLUMNS if name in record})]
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
            )
        )
    return latest(found)


def latest(reviews: Sequence[Review]) -> list[Review]:
    """Keep each rater's last label of each trial, by time, then by order."""
    kept: dict[tuple[str, str], Review] = {}
    for review in sorted(reviews, key=lambda review: review.time):
        kept[review.trial_id, review.rater] = review
    return list(kept.values())
