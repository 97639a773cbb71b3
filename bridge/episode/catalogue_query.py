"""What a run's list says of each episode, and which episodes somebody asks for."""

import os
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

from bridge.errors import UsageError, refuse_outside
from bridge.terminal import RARE

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


Order = Literal["name", "start", "duration", "size", "messages", "lost", "task", "outcome"]
_COLUMNS: dict[str, str] = {
    "name": "file",
    "start": "start_ns",
    "duration": "duration_s",
    "size": "size_bytes",
}


_EXACT = ("kind", "task", "condition", "policy", "operator", "cell", "robot", "outcome")
_SEARCHED = (*_EXACT, "id", "instruction", "tags", "cause", "presence", "error")


@dataclass(frozen=True, kw_only=True)
class CatalogueQuery:
    """Filters; an episode must pass all that are given. One given twice takes either value."""

    kind: tuple[str, ...] = ()
    """scan, trial, retry, probe or imported."""
    task: tuple[str, ...] = ()
    """Id of the task file."""
    condition: tuple[str, ...] = ()
    """without_replanning or with_replanning."""
    policy: tuple[str, ...] = ()
    """Name of the planner or policy."""
    operator: Annotated[tuple[str, ...], RARE] = ()
    """Who was there."""
    cell: tuple[str, ...] = ()
    """Name of the cell."""
    robot: Annotated[tuple[str, ...], RARE] = ()
    """Which robot."""
    outcome: tuple[str, ...] = ()
    """success, failure or unknown."""
    tag: tuple[str, ...] = ()
    """A tag; of several, all must be there."""
    text: str | None = None
    """These words, in whatever case, in name, task, instruction, tags, cause ..."""
    since: str | None = None
    """Begun at or after this time, for example 2026-03-01 or 2026-03-01T14:30 (local)."""
    until: str | None = None
    """Begun before this time."""
    lost: bool | None = None
    """Only with dropped messages, or recovered after a crash; --no-lost only those without."""
    error: bool | None = None
    """Only those that cannot be read; --no-error only the others."""
    sort: Order = "name"
    """Order of the list."""
    reverse: Annotated[bool, RARE] = False
    """Largest or latest first."""
    limit: int | None = None
    """At most this many."""

    def __post_init__(self) -> None:
        """Refuse what cannot be asked."""
        refuse_outside(self, {"limit": (0, float("inf"))})
        _ = self._begun_ns

    @cached_property
    def _begun_ns(self) -> tuple[int | None, int | None]:
        """Not before the first, and before the second."""
        return _instant_ns("since", self.since), _instant_ns("until", self.until)

    def takes(self, entry: Entry) -> bool:
        """Whether an entry passes all filters."""
        since_ns, until_ns = self._begun_ns
        is_lossy = bool(entry.lost) or entry.recovered
        return (
            all(
                getattr(entry, name) in (getattr(self, name) or [getattr(entry, name)])
                for name in _EXACT
            )
            and set(self.tag) <= set(entry.tags)
            and (since_ns is None or entry.start_ns >= since_ns)
            and (until_ns is None or entry.start_ns < until_ns)
            and (self.text is None or _holds(entry, self.text))
            and self.lost in (None, is_lossy)
            and self.error in (None, bool(entry.error))
        )

    def sort_key(self, entry: Entry) -> tuple[bool, Any, str]:
        """What an entry is ordered by, where the answers of several runs are put together."""
        value = getattr(entry, _COLUMNS.get(self.sort, self.sort))
        return value is not None, value, entry.file


def _instant_ns(name: str, text: str | None) -> int | None:
    if text is None:
        return None
    try:
        return round(datetime.fromisoformat(text).timestamp() * 1e6) * 1000
    except (ValueError, OverflowError, OSError) as error:
        raise UsageError(
            f"--{name} {text!r} is no date or time. "
            "Write it like 2026-03-01 or 2026-03-01T14:30, with +01:00 behind it if not local."
        ) from error


def _holds(entry: Entry, words: str) -> bool:
    """Whether all words are there, in any order and case."""
    folded = "\n".join(map(str, (getattr(entry, name) for name in _SEARCHED))).casefold()
    return all(word in folded for word in words.casefold().split())
