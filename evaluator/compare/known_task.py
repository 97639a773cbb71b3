"""The task file a trial was recorded with, where there is one."""

from functools import cache
from pathlib import Path

from bridge.episode import streams
from bridge.episode.reader import Episode
from bridge.task.find import MissingTaskError, find_task_file
from bridge.task.task_file import Task


def recorded_task(episode: Episode) -> Task | None:
    """Load the task an episode was recorded with; None where its file is nowhere."""
    try:
        return streams.task_file(episode).task()
    except MissingTaskError:
        return None


@cache
def task_sha256(name: str, tasks_dir: Path) -> str:
    """Hash the file of that name in a run's ``tasks/`` or among the shipped; "-" without one.

    What an episode carries is a part of the episode, and of its hash.
    """
    try:
        return find_task_file(name, tasks_dir=tasks_dir).sha256
    except MissingTaskError:
        return "-"
