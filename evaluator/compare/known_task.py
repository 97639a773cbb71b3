"""The task file an episode names, where there is one."""

from functools import cache

from bridge.errors import GstError
from bridge.task.task_file import Task, load_task
from evaluator.measurements import slug


@cache
def known_task(name: str) -> Task | None:
    """Load a task by the name an episode gives; None for an unknown one.

    A name from a file is never read as a path.
    """
    if not name or slug(name) != name:
        return None
    try:
        return load_task(name)
    except GstError:
        return None
