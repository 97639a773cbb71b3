"""What a study takes over from a run of the same session: a posterior of trials not its own.

Trials that say what nobody measured must not be those it is judged by, and must be from the same
laboratory. Both are checked by what the calibration says of its sources, before anything is made.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from bridge.episode.run_folder import RunFolder
from bridge.errors import UsageError
from bridge.sources.standin.settings import SessionConfig
from bridge.task.protocol import SEEDS_PER_SESSION, Protocol, StudyTask
from bridge.whole_file import write_whole
from twin.scene.store.calibration import CALIBRATION_FILE, read_calibration


@dataclass(frozen=True, kw_only=True)
class Learned:
    """A calibration that a study may use."""

    content: bytes
    words: str

    @property
    def sha256(self) -> str:
        """Of the file."""
        return hashlib.sha256(self.content).hexdigest()

    def named_in(self, protocol: Protocol) -> Protocol:
        """The protocol that says what was taken over."""
        return replace(protocol, calibration_sha256=self.sha256, calibration_from=self.words)

    def put_into(self, run: RunFolder) -> None:
        """Put it where the gate and the replays of a study look."""
        path = run.scene_dir / CALIBRATION_FILE
        if path.is_file():
            if path.read_bytes() != self.content:
                message = f"{path} is there and is another one. Use a new folder for the study."
                raise UsageError(message)
            return
        run.scene_dir.mkdir(parents=True, exist_ok=True)
        write_whole(path, self.content)


def learned_in(run: RunFolder, protocol: Protocol) -> Learned:
    """Read what a run learned, and check that a study may use it."""
    path, known = run.scene_dir / CALIBRATION_FILE, read_calibration(run)
    again = f"robot-gst calibrate {run.path} --posterior"
    record = {} if known is None else known.record
    if known is None or "posterior" not in record:
        raise UsageError(f"{run.path} has no posterior: {again}")
    if record.get("physics") is not None:
        raise UsageError(
            f"{path} has identified physics, which does not say from which starts: weigh the "
            "trials in a run folder without it."
        )
    tasks = record["posterior"].get("tasks")
    if tasks is None:
        raise UsageError(f"{path} weighs all tasks together, by an older version: {again}")
    counts = []
    for task in protocol.tasks:
        if task.task not in tasks:
            raise UsageError(f"{run.path} has no usable trial of {task.task}: record some there.")
        sources = tasks[task.task]["sources"]
        for name, source in sources.items():
            _check(f"{run.path.name}/{name}", source, task)
        counts.append(f"{task.task} {len(sources)}")
    words = f"run {run.path.name}, calibration {known.calibration_id}, trials: {', '.join(counts)}"
    return Learned(content=path.read_bytes(), words=words)


def _check(name: str, source: Mapping[str, Any], task: StudyTask) -> None:
    seed, cell = source["start_seed"], SessionConfig().cell
    if source["cell"] != cell:
        raise UsageError(
            f"{name} was recorded in cell {source['cell']!r}, the study's is {cell!r}."
        )
    if seed is None:
        raise UsageError(f"{name} does not say from which start it began.")
    if seed // SEEDS_PER_SESSION != task.session_seed:
        raise UsageError(
            f"{name} is from session {seed // SEEDS_PER_SESSION}, another laboratory than the "
            f"study's, session {task.session_seed} (--seed)."
        )
    if source["task_sha256"] != task.task_sha256:
        raise UsageError(f"{name} was recorded with another version of task {task.task}.")
    if seed in {task.start_seed(start) for start in range(task.starts)}:
        raise UsageError(
            f"{name} began from start {seed % SEEDS_PER_SESSION} of {task.task}, one of the "
            "study's own: choose others with --first-start."
        )
