"""Which episodes may go when a disk fills: labelled, not flagged, and old, large or over a quota.

An episode that nobody labelled, or that somebody flagged (``label --flag``, or the tag ``keep``),
is never removed; scans and probes have no label, so they stay as well.
"""

import contextlib
import json
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from typing import Any, NamedTuple

from bridge.clock import NS_PER_S, s_from_ns
from bridge.episode.catalogue import list_episodes, read_entry, sidecar_path
from bridge.episode.catalogue_store import Entry, RetentionPolicy
from bridge.episode.run_folder import EPISODE_ID, RunFolder

KEEP_TAG = "keep"
LOG_NAME = "removed.jsonl"
"""In ``notes/``: one line for each episode that was removed, and why."""
DAY_NS = 86_400 * NS_PER_S
BYTES_PER_MB = 1_000_000


class Removal(NamedTuple):
    """An episode that goes, and why."""

    entry: Entry
    reason: str


def may_go(entry: Entry, policy: RetentionPolicy) -> bool:
    """Say whether an episode could be removed at all: labelled, not flagged, and readable.

    Args:
        entry: As the catalogue knows it.
        policy: Which labels may go.
    """
    is_kept = entry.flag or entry.error or KEEP_TAG in entry.tags
    return not is_kept and entry.kind == "trial" and entry.outcome in policy.outcome


def choose(entries: Sequence[Entry], policy: RetentionPolicy, *, now_ns: int) -> list[Removal]:
    """Return what goes, oldest first.

    Args:
        entries: All episodes of a run.
        policy: The limits.
        now_ns: The time [ns since 1970].
    """
    removable = sorted(
        (entry for entry in entries if may_go(entry, policy)),
        key=lambda entry: (entry.start_ns, entry.file),
    )
    gone: list[Removal] = []
    is_limited = policy.older_than_days is not None or policy.larger_than_mb is not None
    for entry in removable if is_limited else ():
        age_days = (now_ns - entry.start_ns) / DAY_NS
        size_mb = entry.size_bytes / BYTES_PER_MB
        if policy.older_than_days is not None and age_days <= policy.older_than_days:
            continue
        if policy.larger_than_mb is not None and size_mb <= policy.larger_than_mb:
            continue
        gone.append(Removal(entry, f"{age_days:.1f} days old, {size_mb:.1f} MB"))
    if policy.quota_mb is None:
        return gone
    going = {removal.entry.file for removal in gone}
    left = sum(entry.size_bytes for entry in entries if entry.file not in going)
    for entry in removable:
        if left <= policy.quota_mb * BYTES_PER_MB:
            break
        if entry.file not in going:
            over_mb = left / BYTES_PER_MB - policy.quota_mb
            gone.append(Removal(entry, f"the run is {over_mb:.1f} MB over its quota"))
            left -= entry.size_bytes
    return gone


def remove(run: RunFolder, removal: Removal, *, now_ns: int) -> bool:
    """Remove an episode's files, its label last, and write down that it is gone.

    The label and the flag are looked at once more: somebody may have changed them meanwhile.

    Args:
        run: The run folder.
        removal: What goes, and why.
        now_ns: The time [ns since 1970].

    Returns:
        False when it must stay after all.
    """
    path = run.episodes_dir / removal.entry.file
    entry = read_entry(run, path)
    before = removal.entry
    is_same = (entry.outcome, entry.tags, entry.error) == (before.outcome, before.tags, "")
    if not is_same or entry.flag:
        return False
    _log(run, removal, now_ns)
    for part in reversed(run.parts(path)):
        part.unlink(missing_ok=True)
    if EPISODE_ID.fullmatch(path.stem):
        sidecar_path(run, path.stem).unlink(missing_ok=True)
    return True


def _log(run: RunFolder, removal: Removal, now_ns: int) -> None:
    run.notes_dir.mkdir(parents=True, exist_ok=True)
    entry = removal.entry
    at = datetime.fromtimestamp(s_from_ns(now_ns), UTC).isoformat(timespec="seconds")
    record: dict[str, Any] = {
        "schema_version": 1,
        "removed_at": at,
        "id": entry.id,
        "task": entry.task,
        "outcome": entry.outcome,
        "start_ns": entry.start_ns,
        "size_bytes": entry.size_bytes,
        "reason": removal.reason,
    }
    with (run.notes_dir / LOG_NAME).open("a") as stream:
        stream.write(json.dumps(record) + "\n")


def keep_quota(
    run: RunFolder, quota_mb: float, *, now_ns: int, say: Callable[[str], None]
) -> list[Removal]:
    """Remove what a quota asks for, after an episode was recorded; never raises.

    Args:
        run: The run folder.
        quota_mb: What its episodes may take [MB].
        now_ns: The time [ns since 1970].
        say: Told of each episode that went, and when nothing may go.
    """
    gone: list[Removal] = []
    with contextlib.suppress(OSError):
        entries = list_episodes(run)
        policy = RetentionPolicy(quota_mb=quota_mb)
        for removal in choose(entries, policy, now_ns=now_ns):
            if remove(run, removal, now_ns=now_ns):
                gone.append(removal)
                say(f"removed {removal.entry.id} ({removal.entry.outcome}): {removal.reason}")
        going = {removal.entry.file for removal in gone}
        left = sum(entry.size_bytes for entry in entries if entry.file not in going)
        if left > quota_mb * BYTES_PER_MB:
            say(
                f"{run.path} holds {left / BYTES_PER_MB:.0f} MB of episodes, quota "
                f"{quota_mb:g} MB: label episodes that may go, or copy them away (robot-gst sync)"
            )
    return gone
