"""Opens an episode and sums it up in one line of the catalogue."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from bridge.episode.catalogue.entry import Entry, printable
from bridge.episode.catalogue.labels import outcome_of
from bridge.episode.reader import Episode
from bridge.episode.run import RunFolder
from bridge.errors import GstError

_LARGEST = 2**63 - 1


def read_entry(run: RunFolder, path: Path) -> Entry:
    """Open an episode and sum it up; a broken one is listed with its error."""
    parts: tuple[Path, ...] = (path,)
    name: dict[str, Any] = {"file": printable(path.name), "id": printable(path.stem)}
    try:
        episode = Episode.open(path)
        parts = episode.parts
        info, outcome = episode.info, outcome_of(run, episode)
        messages = sum(topic.count for topic in episode.topics().values())
    except GstError as error:
        return Entry(**name, **_extent(parts), error=printable(str(error)))
    records = episode.metadata_records
    return Entry(
        **name,
        **_extent(parts),
        kind=printable(info.kind),
        task=printable(info.task),
        condition=printable(info.condition),
        policy=printable(info.policy),
        start_id=None if info.start_id is None else printable(info.start_id),
        trial=None if info.trial is None else _fit(info.trial),
        operator=printable(info.operator),
        robot=printable(info.robot),
        cell=printable(info.cell),
        stand_in=info.stand_in,
        tags=tuple(printable(str(tag)) for tag in info.tags),
        outcome=printable(outcome.result) if outcome else "unknown",
        start_ns=_fit(episode.start_ns),
        duration_s=episode.duration_s,
        messages=messages,
        lost=_declared_lost(records.get("drops")),
        recovered="recovered" in records,
    )


def _extent(parts: tuple[Path, ...]) -> dict[str, Any]:
    sizes = [part.stat().st_size for part in parts if part.is_file()]
    return {"size_bytes": sum(sizes), "parts": len(parts)}


def _declared_lost(drops: dict[str, Any] | None) -> int | None:
    if drops is None:
        return None
    counts: Iterable[Any] = (drops.get(name, 0) for name in ("gaps", "queue_drops", "shed"))
    found = [count for count in counts if isinstance(count, int)]
    return _fit(sum(found)) if len(found) == 3 else None


def _fit(number: int) -> int:
    """Clamp to what a database column holds; other programs write what they like."""
    return max(-_LARGEST, min(_LARGEST, number))
