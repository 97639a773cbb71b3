"""Semantics as a stage of ``rebuild``."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bridge.task.task_file import Task
from bridge.terminal import Output
from twin.scene.foundation.consult import consult
from twin.scene.frames.choice import FrameChoice
from twin.scene.frames.training_view import TrainingView
from twin.scene.gaussians.cloud import concatenate
from twin.scene.gaussians.moved import moved_cloud
from twin.scene.objects.parts import TakenApart
from twin.scene.semantics.add import add_semantics
from twin.scene.semantics.lift import Viewpoint
from twin.scene.semantics.store import BACKGROUND_KEY
from twin.scene.settings import ModelConfig


def write_scene_semantics(
    folder: Path,
    apart: TakenApart,
    views: Sequence[TrainingView],
    threads: int,
    output: Output,
    *,
    models: ModelConfig | None = None,
    choices: Sequence[FrameChoice] = (),
    task: Task | None = None,
) -> dict[str, Any]:
    """Say what is what in a scene that was taken apart.

    Args:
        folder: The scene folder.
        apart: The scene.
        views: What it was fitted to.
        threads: For drawing; 0: all cores.
        output: How to talk.
        models: Large models to ask beside the default segmenter; None: none.
        choices: Training frames that these look at.
        task: Names what they look for.

    Returns:
        ``{"semantics": ...}`` for ``scene.json``.

    Raises:
        UsageError: When a model cannot be used.
    """
    objects = {} if apart.parts is None else apart.parts.objects
    placed = {key: moved_cloud(item.cloud, item.T_base_object) for key, item in objects.items()}
    cloud = concatenate([apart.background, *placed.values()])
    output.say(f"name what is in the scene: {len(cloud)} Gaussians, {len(objects)} objects known")
    asked = consult(models or ModelConfig(), choices, cloud, task, output, threads=threads)
    with output.progress("name things", 100) as advance:
        record = add_semantics(
            folder,
            apart.background,
            placed,
            [Viewpoint(camera=v.half.camera, T_base_camera=v.T_base_color) for v in views],
            masks=asked.findings.masks,
            features=asked.findings.features,
            surfaces_m=apart.surfaces_m(),
            threads=threads,
            advance=advance,
        )
    rows = {BACKGROUND_KEY: len(apart.background)}
    rows |= {key: len(part) for key, part in placed.items()}
    record |= asked.give_vectors(folder, rows, cloud, output, threads=threads)
    labels = ", ".join(item["label"] for item in record["instances"])
    output.say(
        f"{len(record['instances'])} things ({record['source']}): {labels}"
        if labels
        else f"no things named: {record['remark']}"
    )
    return {"semantics": record}
