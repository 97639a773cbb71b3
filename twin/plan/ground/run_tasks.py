"""What a run says an instruction can be about, and the task that comes of it."""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from bridge.episode import streams
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.errors import BridgeError, UsageError
from bridge.task.find import chosen_task_file, keep_task_file, union_of
from bridge.task.summary import describe_task
from bridge.task.task_file import TaskFile
from twin.plan.ground.derive import derive_task
from twin.plan.ground.goals import Grounding
from twin.plan.ground.grammar import ground
from twin.plan.ground.vocabulary import vocabulary_of
from twin.scene.store.folder import read_record

MAX_NAME = 400
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*|\S+\.toml")
"""What can only be a task's name or its file: an instruction has more than one word."""


@dataclass(frozen=True, kw_only=True)
class UnderstoodTask:
    """The task that is planned, and how an instruction became it."""

    file: TaskFile
    grounding: Grounding | None

    def lines(self) -> list[str]:
        """Everything for a person: what was understood, then the task."""
        head = [] if self.grounding is None else [*self.grounding.lines(), ""]
        return [*head, describe_task(self.file.task())]

    def to_json(self) -> dict[str, Any]:
        """The same as data."""
        task = self.file.task()
        return {
            "task": task.name,
            "sha256": self.file.sha256,
            "instruction": task.instruction,
            "derived": task.derived,
            "stages": list(task.stages),
            "success": list(task.success),
            "grounding": msgspec.to_builtins(self.grounding),
        }


def names_task(words: str) -> bool:
    """Whether words are a task's name or its file, and no instruction."""
    return len(words) <= MAX_NAME and _NAME.fullmatch(words) is not None


def understand(run: RunFolder, words: str) -> UnderstoodTask:
    """Find the task a person names, or make one of their instruction; nothing is written."""
    if names_task(words):
        file = chosen_task_file(words, tasks_dir=run.tasks_dir)
        file.task()
        return UnderstoodTask(file=file, grounding=None)
    base = task_files_of(run)
    task = union_of(base)
    assert task is not None  # noqa: S101  # there is at least one file
    grounding = ground(words, vocabulary_of(task, instances_of(run)))
    return UnderstoodTask(file=derive_task(grounding, _shown(grounding, base)), grounding=grounding)


def _shown(grounding: Grounding, base: Sequence[TaskFile]) -> Sequence[TaskFile]:
    """The smallest task with all that an instruction is about: its episodes show just its objects.

    With several tasks in a run no episode shows the objects of all; only an instruction about
    objects of several tasks needs them.
    """
    text = json.dumps([[dict(goal) for goal in grounding.goals], grounding.order])
    about = {key for file in base for key in file.task().objects if f'"{key}"' in text}
    holding = [file for file in base if about <= set(file.task().objects)]
    return base if not holding else [min(holding, key=lambda file: len(file.task().objects))]


def keep(run: RunFolder, understood: UnderstoodTask) -> Path | None:
    """Write a derived task into the run's ``tasks/``; return its path, None for a named one."""
    if understood.grounding is None:
        return None
    return keep_task_file(run.tasks_dir, understood.file.task().name, understood.file.data)


def task_files_of(run: RunFolder) -> list[TaskFile]:
    """The task files that say which objects a run's scene holds: those of its episodes.

    Files derived from an instruction count only where there is nothing else: their objects are
    those of others.
    """
    found: dict[str, TaskFile] = {}
    problems: list[str] = []
    for path in run.episodes():
        try:
            episode = Episode.open(path)
            if episode.info.task:
                file = streams.task_file(episode)
                found.setdefault(file.sha256, file)
        except (BridgeError, UsageError) as error:
            problems.append(str(error))
    files = sorted(found.values(), key=lambda file: file.task().name)
    own = [file for file in files if file.task().derived is None]
    if not files:
        why = f" {problems[0]}" if problems else ""
        message = (
            f"nothing in {run.path} says which objects there are: no episode was recorded with a "
            f"task.{why} Record some: robot-gst record {run.path} --task TASK."
        )
        raise UsageError(message)
    return own or files


def shown_task_file(run: RunFolder, episode: str) -> TaskFile:
    """The task file whose objects an episode shows; no name: the newest recorded with a task."""
    files = task_files_of(run)
    known = {file.sha256: file for file in files}
    for path in run.episodes()[::-1]:
        if len(files) > 1 and episode in ("", path.stem):
            try:
                return known[streams.task_file(Episode.open(path)).sha256]
            except (BridgeError, UsageError, KeyError):
                continue  # another one may name its task
    return files[0]


def instances_of(run: RunFolder) -> Sequence[Mapping[str, Any]]:
    """What a run's scene says its objects look like; nothing where there is none."""
    semantics: Mapping[str, Any] = (read_record(run) or {}).get("semantics") or {}
    return list(semantics.get("instances", ()))
