"""What a run's list says of each episode, and which episodes somebody asks for."""

import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

UNLABELLED = "nobody labelled it"
"""Why the outcome of a trial is unknown that has no label."""
LABEL_SUFFIX = ".outcome.json"
"""Of the sidecar under ``notes/`` that holds a label given after the fact."""
UNSETTLED_NS = 2_000_000_000
"""A file changed this recently may change again within one tick of the disk's clock [ns]."""


@dataclass(frozen=True, kw_only=True)
class Entry:
    """One line of ``robot-gst ls``. ``error`` is set when the files could not be read."""

    file: str
    id: str
    kind: str = ""
    task: str = ""
    instruction: str = ""
    condition: str = ""
    policy: str = ""
    start_id: str | None = None
    trial: int | None = None
    operator: str = ""
    robot: str = ""
    cell: str = ""
    stand_in: bool = False
    tags: tuple[str, ...] = ()
    outcome: str = "unknown"
    """success, failure or unknown; a label given after the fact wins."""
    cause: str = ""
    """Why the outcome is unknown, where somebody said so."""
    start_ns: int = 0
    """First log time [ns]."""
    duration_s: float = 0.0
    messages: int = 0
    size_bytes: int = 0
    lost: int | None = None
    """Messages the recorder logged as dropped; None when nobody counted."""
    recovered: bool = False
    """Its writer was killed, so its tail is missing."""
    presence: str = ""
    """Topics that broke the contract, fell silent, or whose losses nobody can see."""
    error: str = ""


def stamp_of(files: Iterable[Path | str], now_ns: int) -> str:
    """Return size, times and inode of each file; "" when one changed a moment ago."""
    marks = []
    for file in files:
        try:
            found = os.stat(file)  # noqa: PTH116  # half the time of the method, for many files
        except OSError:
            marks.append("-")
            continue
        if abs(now_ns - found.st_mtime_ns) < UNSETTLED_NS:
            return ""
        marks.append(f"{found.st_size}.{found.st_mtime_ns}.{found.st_ctime_ns}.{found.st_ino}")
    return " ".join(marks)


def printable(text: str) -> str:
    """Spell out what is no valid Unicode, so that it can be stored and shown."""
    return text.encode("utf-8", "backslashreplace").decode()


_SEARCHED = (
    *("id", "kind", "task", "condition", "policy", "operator", "cell", "robot", "outcome"),
    *("instruction", "tags", "cause", "presence", "error"),
)


@dataclass(frozen=True, kw_only=True)
class CatalogueQuery:
    """Filters; an episode must pass all that are given. One given twice takes either value."""

    kind: tuple[str, ...] = ()
    """scan, trial, retry, probe or imported."""
    task: tuple[str, ...] = ()
    """Id of the task file."""
    outcome: tuple[str, ...] = ()
    """success, failure or unknown."""
    text: str = ""
    """These words, in whatever case, in name, task, cell, operator, tags, cause ..."""

    def takes(self, entry: Entry) -> bool:
        """Whether an entry passes all filters."""
        folded = "\n".join(str(getattr(entry, name)) for name in _SEARCHED).casefold()
        return (
            (not self.kind or entry.kind in self.kind)
            and (not self.task or entry.task in self.task)
            and (not self.outcome or entry.outcome in self.outcome)
            and all(word in folded for word in self.text.casefold().split())
        )
