"""Commands about task files: check them, and write one to start from."""

from dataclasses import asdict
from importlib import resources
from pathlib import Path
from typing import Any

from bridge.terminal import Output

OUTPUT = Output()


def task_check(*files: str, output: Output = OUTPUT) -> int:
    """Say what is wrong with task files, or in words what they ask for.

    Example: robot-gst task check my_task.toml
    Exit code 0 when all are right, else 2.

    Args:
        files: Task files, or names of those that ship with robot-gst.
    """
    from bridge.errors import UsageError
    from bridge.task.check import TaskFileError
    from bridge.task.find import chosen_task_file
    from bridge.task.summary import describe_task

    if not files:
        raise UsageError("task check needs one or more files: robot-gst task check my_task.toml.")
    found: list[dict[str, Any]] = []
    texts = []
    for name in files:
        try:
            file = chosen_task_file(name)
            task = file.task()
        except UsageError as error:
            problems = error.problems if isinstance(error, TaskFileError) else [str(error)]
            found.append({"file": name, "ok": False, "problems": [*problems]})
            texts.append(str(error))
        else:
            found.append({"file": name, "ok": True, "sha256": file.sha256, "task": asdict(task)})
            texts.append(f"{file.origin}: ok\n{describe_task(task)}")
    output.result({"files": found}, "\n\n".join(texts))
    return 0 if all(item["ok"] for item in found) else 2


def task_new(name: str, /, *, folder: Path = Path(), output: Output = OUTPUT) -> int:
    """Write a complete task file with comments, to start from; never overwrites one.

    Example: robot-gst task new cube_onto_block

    Args:
        name: Of the task and of its file, NAME.toml: letters, digits, '_' and '-'.
        folder: Where the file goes; here when not given.
    """
    from bridge.errors import UsageError
    from bridge.task.task_file import TaskFile

    text = resources.files("bridge.task").joinpath("template.toml").read_text()
    text = text.replace("NAME", name)
    path = folder / f"{name}.toml"
    task = TaskFile(text.encode(), str(path)).task()
    try:
        with path.open("x", encoding="utf-8") as stream:
            stream.write(text)
    except FileExistsError as error:
        raise UsageError(f"{path} exists already. Choose another name, or edit it.") from error
    output.result(
        {"file": str(path), "name": task.name},
        f"wrote {path}. Edit it, then: robot-gst task check {path}",
    )
    return 0
