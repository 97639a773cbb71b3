"""Semantics as a stage of ``rebuild``."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bridge.terminal import Output
from twin.scene.objects import moved_cloud
from twin.scene.parts import TakenApart
from twin.scene.semantics.add import add_semantics
from twin.scene.semantics.lift import Viewpoint
from twin.scene.training_view import TrainingView


def write_scene_semantics(
    folder: Path, apart: TakenApart, views: Sequence[TrainingView], threads: int, output: Output
) -> dict[str, Any]:
    """Say what is what in a scene that was taken apart.

    Returns:
        ``{"semantics": ...}`` for ``scene.json``.
    """
    objects = {} if apart.parts is None else apart.parts.objects
    record = add_semantics(
        folder,
        apart.background,
        {key: moved_cloud(item.cloud, item.T_base_object) for key, item in objects.items()},
        [Viewpoint(camera=v.half.camera, T_base_camera=v.T_base_color) for v in views],
        threads=threads,
    )
    labels = ", ".join(item["label"] for item in record["instances"])
    output.say(
        f"{len(record['instances'])} things ({record['source']}): {labels}"
        if labels
        else f"no things named: {record['remark']}"
    )
    return {"semantics": record}
