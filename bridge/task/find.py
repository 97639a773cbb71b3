"""Find the task file an episode was recorded with: its own copy, the run's, or a shipped one."""

import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from bridge.data_files import datasets_folder
from bridge.errors import UsageError
from bridge.task.check import nearest
from bridge.task.task_file import ObjectModel, Task, TaskFile
from bridge.whole_file import write_whole

ATTACHMENT = "task.toml"
"""Name of the attachment that holds an episode's task file."""
MEDIA_TYPE = "application/toml"
HASH_DIGITS = 12
"""Of the hash in the name of a second file of one name."""


class MissingTaskError(UsageError):
    """No task file of that name, or not the one that was recorded with."""

    def __init__(self, *, name: str, sha256: str, looked: Sequence[str]) -> None:
        """Remember what was wanted, and where it is not."""
        self.name = name
        which = f" with sha256 {sha256[:HASH_DIGITS]}" if sha256 else ""
        places = "\n".join(f"  {place}" for place in looked)
        super().__init__(
            f"no task named {name!r}{which}. Looked in:\n{places}\n"
            "Put its file into the run's tasks/ folder, or check the name."
        )


@dataclass(frozen=True)
class Attached:
    """What an episode says of its task file."""

    sha256: str = ""
    """Of the file it was recorded with; empty: it does not say."""
    data: bytes | None = None
    origin: str = ""


NOTHING = Attached()


def find_task_file(
    name: str, *, tasks_dir: Path | None = None, attached: Attached = NOTHING
) -> TaskFile:
    """Find a task file by name: the episode's attachment, the run's ``tasks/``, those shipped.

    Where the episode says with which file it was recorded, only that very text will do. The name is
    never read as a path.
    """
    looked: list[str] = []
    wanted = attached.sha256
    if attached.data is not None:
        file = TaskFile(attached.data, f"{ATTACHMENT} in {attached.origin}")
        if wanted == file.sha256 or (not wanted and file.task().name == name):
            return file
        looked.append(f"{file.origin}: damaged, its sha256 is {file.sha256[:HASH_DIGITS]}")
    elif attached.origin:
        looked.append(f"{attached.origin}: carries no {ATTACHMENT}")
    for folder in (tasks_dir, datasets_folder() / "tasks"):
        if folder is None:
            continue
        for path in _named(folder, name):
            file = TaskFile.read(path)
            if wanted in ("", file.sha256):
                return file
            looked.append(f"{path}: another file, its sha256 is {file.sha256[:HASH_DIGITS]}")
        names = sorted({path.name.split(".")[0] for path in folder.glob("*.toml")})
        looked.append(f"{folder}: {', '.join(names) or 'nothing'}.{nearest(name, names)}")
    raise MissingTaskError(name=name, sha256=wanted, looked=looked)


def chosen_task_file(name: str, *, tasks_dir: Path | None = None) -> TaskFile:
    """Return the task file a person names: by its path, else by its name."""
    if name.endswith(".toml"):
        return TaskFile.read(Path(name))
    return find_task_file(name, tasks_dir=tasks_dir)


def _named(folder: Path, name: str) -> Iterator[Path]:
    """The files that may hold a task of this name, its own first; a name leads to no other folder.

    A second one of a name has a part of its hash behind it.
    """
    there = {path.name: path for path in folder.glob("*.toml")}
    if f"{name}.toml" in there:
        yield there[f"{name}.toml"]
    for file_name in sorted(there):
        stem, _, digits = file_name.removesuffix(".toml").rpartition(".")
        if stem == name and len(digits) == HASH_DIGITS:
            yield there[file_name]


def keep_task_file(tasks_dir: Path, name: str, data: bytes) -> Path:
    """Write a task file into a run, and return where it lies.

    A file that is there is never overwritten: another text of the same name gets a part of its
    hash behind the name.
    """
    tasks_dir.mkdir(parents=True, exist_ok=True)
    digits = TaskFile(data, "").sha256[:HASH_DIGITS]
    for path in (tasks_dir / f"{name}.toml", tasks_dir / f"{name}.{digits}.toml"):
        if not path.exists():
            _write_new(path, data)
        if path.read_bytes() == data:
            return path
    raise UsageError(f"{path} is there with another content. Move it away.")


def _write_new(path: Path, data: bytes) -> None:
    """Write a file unless somebody else was quicker."""
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    write_whole(draft, data)
    try:
        os.link(draft, path)
    except FileExistsError:
        pass
    except OSError:  # a file system without hard links
        draft.replace(path)
        return
    draft.unlink(missing_ok=True)


def union_of(files: Iterable[TaskFile]) -> Task | None:
    """Join the objects of several tasks: a scene may hold those of all; None without any.

    Name, stages and success are those of the first.
    """
    joined: Task | None = None
    defined: dict[str, tuple[ObjectModel, str]] = {}
    for file in files:
        task = file.task()
        for key, model in task.objects.items():
            before, origin = defined.setdefault(key, (model, file.origin))
            if before != model:
                raise UsageError(
                    f"object {key!r} is defined differently in {origin} and in {file.origin}: one "
                    "scene cannot hold both. Give them two names, or rebuild the scans apart."
                )
        joined = task if joined is None else _joined(joined, task)
    return joined


def _joined(first: Task, second: Task) -> Task:
    return replace(
        first,
        objects=first.objects | second.objects,
        manipulated=tuple(dict.fromkeys((*first.manipulated, *second.manipulated))),
        containers=tuple(dict.fromkeys((*first.containers, *second.containers))),
        start=first.start | second.start,
    )
