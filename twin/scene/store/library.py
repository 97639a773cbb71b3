"""Which objects were scanned, which a trial shows, and from what each is drawn.

One answer for renders, pages, replays, plans, Rerun and shared files. Objects that a trial's task
does not have are not in it, whatever else was scanned; those that no scan saw are drawn from the
task's shape, with colours from the trial's own frames before the first motion, and marked.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bridge.episode import streams
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder, check_episode_id
from bridge.errors import GstError
from bridge.task.task_file import Task
from twin.scene.store.folder import read_record

MESH, SDF = "mesh.ply", "sdf.npz"
"""Geometry files in an object's folder."""
TASK_SHAPE = "task file"
"""Source of a shape that no view gave."""
NOT_SCANNED = "not scanned"
FROM_TASK = f"{NOT_SCANNED}: drawn from the task's shape, with colours from before the first motion"


def objects_folder(run: RunFolder) -> Path:
    """Where each object of a run's scene has a folder of its own."""
    return run.scene_dir / "objects"


@dataclass(frozen=True, kw_only=True)
class Library:
    """The objects of a run's scene."""

    folder: Path
    """Where each has a folder of its own."""
    objects: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """What ``scene.json`` says of each."""
    remark: str = ""
    """Why objects are missing."""

    @classmethod
    def of(cls, run: RunFolder, record: Mapping[str, Any] | None) -> "Library":
        """The library that ``scene.json`` lists; an empty one without a scene."""
        known = record or {}
        return cls(
            folder=objects_folder(run),
            objects=known.get("objects", {}),
            remark=known.get("objects_remark", ""),
        )

    def place(self, name: str) -> Path | None:
        """The folder of an object; None of one that was not scanned, whatever lies about there."""
        return self.folder / check_episode_id(name) if name in self.objects else None

    def scanned(self, task: Task | None) -> list[str]:
        """Those of a task that were scanned; of an episode without a task all that were."""
        return [name for name in self.objects if task is None or name in task.objects]

    def not_scanned(self, task: Task | None) -> list[str]:
        """Objects of a task that no scan saw."""
        return [name for name in ([] if task is None else task.objects) if name not in self.objects]

    def notes(self, task: Task | None) -> list[str]:
        """What whoever looks at a picture of a trial has to know."""
        because = f" ({self.remark})" if self.remark else ""
        return [f"{name} was {FROM_TASK}{because}" for name in self.not_scanned(task)]


def not_scanned_in(run: RunFolder, episode: Episode) -> list[str]:
    """Objects of an episode's task that the run's scene does not know; none without a scene."""
    record = read_record(run)
    return [] if record is None else Library.of(run, record).not_scanned(task_of(episode))


def task_of(episode: Episode) -> Task | None:
    """The task of an episode; None where it names none, or its file is not to be had."""
    try:
        return streams.task_file(episode).task()
    except GstError:
        return None
