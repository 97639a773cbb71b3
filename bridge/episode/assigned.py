"""What a person says afterwards that an episode is: a trial of a task, from a start, by a policy.

Kept beside the run in ``notes/``; the recording is not touched. Whoever recorded it, an episode
with such a note is a trial like any other.
"""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from bridge.episode.metadata import EpisodeInfo
from bridge.episode.run_folder import RunFolder
from bridge.errors import EpisodeError, UsageError
from bridge.whole_file import write_whole

TRIAL_SUFFIX = ".trial.json"
"""Of the note under ``notes/``."""
FIELDS = ("task", "start_id", "policy")


def assigned(info: EpisodeInfo, path: Path) -> EpisodeInfo:
    """Apply the note on a recorded episode, where there is one."""
    if path.parent.name != "episodes":
        return info
    note = RunFolder(path.parent.parent).notes_dir / f"{path.stem}{TRIAL_SUFFIX}"
    try:
        data = note.read_bytes()
    except OSError:
        return info
    try:
        record = json.loads(data)
        said = {name: record[name] for name in FIELDS if record.get(name)}
    except (ValueError, AttributeError, RecursionError):
        said = {}
    if "task" not in said or not all(isinstance(value, str) for value in said.values()):
        hint = "Say it again: robot-gst label RUN EPISODE --task NAME."
        raise EpisodeError(path=note, found="no task in it", hint=hint)
    if said["task"] != info.task:
        said["task_sha256"] = ""
    return replace(info, kind="trial", **said)


def assign(
    run: RunFolder,
    path: Path,
    info: EpisodeInfo,
    *,
    task: str,
    start_id: str | None,
    policy: str | None,
) -> Path:
    """Note that an episode is a trial; what is None stays as it was."""
    if info.kind not in ("trial", "imported"):
        raise UsageError(f"{path.stem} is a {info.kind}; trials and imported episodes have tasks.")
    record: dict[str, Any] = {
        "schema_version": 1,
        "task": task,
        "start_id": start_id or info.start_id,
        "policy": policy or info.policy,
    }
    note = run.notes_dir / f"{path.stem}{TRIAL_SUFFIX}"
    note.parent.mkdir(parents=True, exist_ok=True)
    write_whole(note, (json.dumps(record, indent=1) + "\n").encode())
    return note
