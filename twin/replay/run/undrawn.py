"""What pictures of replays will lack, said before they are drawn."""

from collections.abc import Iterable, Mapping
from typing import Any

from bridge.task.task_file import load_task


def describe_undrawn(record: Mapping[str, Any], tasks: Iterable[str]) -> list[str]:
    """Say in a sentence each what the rebuilt scene has no Gaussians of.

    Args:
        record: The content of ``scene.json``.
        tasks: Tasks whose objects the replays move.
    """
    said = []
    for name in tasks:
        missing = [key for key in load_task(name).objects if key not in record.get("objects", {})]
        if missing:
            because = record.get("objects_remark")
            reason = f" ({because})" if because else ""
            said.append(f"{', '.join(missing)}: not in the scene, not in pictures{reason}")
    robot = record.get("robot", {})
    if not robot.get("links"):
        reason = f" ({robot['remark']})" if robot.get("remark") else ""
        said.append(f"robot: not in the scene, not in pictures{reason}")
    return said
