"""Which episodes to list, and in what order."""

from dataclasses import dataclass
from datetime import datetime
from typing import Any, Literal

from bridge.errors import UsageError, refuse_outside

Order = Literal["name", "start", "duration", "size", "messages", "lost", "task", "outcome"]
_COLUMNS: dict[str, str] = {
    "name": "file",
    "start": "start_ns",
    "duration": "duration_s",
    "size": "size_bytes",
}


@dataclass(frozen=True, kw_only=True)
class CatalogueQuery:
    """Filters; an episode must pass all that are given. One given twice takes either value."""

    kind: tuple[str, ...] = ()
    """scan, trial, probe or imported."""
    task: tuple[str, ...] = ()
    """Id of the task file."""
    condition: tuple[str, ...] = ()
    """without_replanning or with_replanning."""
    policy: tuple[str, ...] = ()
    """Name of the planner or policy."""
    operator: tuple[str, ...] = ()
    """Who was there."""
    outcome: tuple[str, ...] = ()
    """success, failure or unknown."""
    tag: tuple[str, ...] = ()
    """A tag; of several, all must be there."""
    since: str | None = None
    """Begun at or after this time, for example 2026-03-01 or 2026-03-01T14:30 (local)."""
    until: str | None = None
    """Begun before this time."""
    lost: bool | None = None
    """Only with declared losses, or recovered after a crash; --no-lost only those without."""
    error: bool | None = None
    """Only those that cannot be read; --no-error only the others."""
    sort: Order = "name"
    """Order of the list."""
    reverse: bool = False
    """Largest or latest first."""
    limit: int | None = None
    """At most this many."""

    def __post_init__(self) -> None:
        """Refuse what cannot be asked."""
        refuse_outside(self, {"limit": (0, float("inf"))})
        for name in ("since", "until"):
            _instant_ns(name, getattr(self, name))

    def to_sql(self) -> tuple[str, list[Any]]:
        """Return what follows ``SELECT ... FROM episodes``, and its parameters."""
        terms: list[str] = []
        values: list[Any] = []
        for name in ("kind", "task", "condition", "policy", "operator", "outcome"):
            wanted = getattr(self, name)
            if wanted:
                terms.append(f"{name} IN ({', '.join('?' * len(wanted))})")
                values += wanted
        for tag in self.tag:
            terms.append("has_tag(tags, ?)")
            values.append(tag)
        for name, sign in (("since", ">="), ("until", "<")):
            instant_ns = _instant_ns(name, getattr(self, name))
            if instant_ns is not None:
                terms.append(f"start_ns {sign} ?")
                values.append(instant_ns)
        if self.lost is not None:
            terms.append(f"(ifnull(lost, 0) > 0 OR recovered) = {int(self.lost)}")
        if self.error is not None:
            terms.append(f"(error != '') = {int(self.error)}")
        where = f"WHERE {' AND '.join(terms)} " if terms else ""
        direction = "DESC" if self.reverse else "ASC"
        column = _COLUMNS.get(self.sort, self.sort)
        text = f"{where}ORDER BY {column} {direction}, file {direction}"
        if self.limit is not None:
            text += " LIMIT ?"
            values.append(self.limit)
        return text, values


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
