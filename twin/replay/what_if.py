"""A plan of a trial replayed with something else than it was: friction, force, mass, delay, pose.

The replay is the ordinary one, and so is its episode; it lies in a folder of its own, because a
replay with other physics than the run's counts nowhere.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.episode.run_folder import RunFolder
from bridge.errors import UsageError
from bridge.geometry import se3
from twin.replay.config import ChangeConfig, ReplayRunConfig
from twin.replay.job import ReplayJob
from twin.replay.job_row import row_of_existing
from twin.replay.rebuilt_scene import shape_hashes
from twin.replay.run_job import run_job
from twin.replay.runner import Preparation, jobs_of
from twin.scene.store.folder import scene_hash_of


@dataclass(frozen=True, kw_only=True)
class WhatIf:
    """Which plan of which trial, and what is otherwise."""

    run_path: Path
    episode_id: str
    plan_id: str
    change: ChangeConfig
    folder: Path
    """Where its episode goes."""


def replay_changed(item: WhatIf) -> dict[str, Any]:
    """Replay a plan otherwise than it was; a replay that is there already is kept.

    Returns:
        The row of the replay, as ``replay`` reports it.

    Raises:
        UsageError: The trial has no such plan, or the task no such object.
    """
    run = RunFolder.open(item.run_path)
    preparation = Preparation(
        run_path=run.path.resolve(),
        episode_id=item.episode_id,
        scene_hash=scene_hash_of(run),
        shapes=shape_hashes(run),
        config=ReplayRunConfig(episode=(item.episode_id,)),
    )
    planned = [
        job
        for job in jobs_of(preparation).jobs
        if job.plan_id == item.plan_id and job.trajectory == "planned"
    ]
    if not planned:
        message = f"{item.episode_id} has no plan {item.plan_id!r} that could be replayed."
        raise UsageError(message)
    item.folder.mkdir(parents=True, exist_ok=True)
    job = changed(replace(planned[-1], folder=item.folder.resolve()), item.change)
    return row_of_existing(job) or run_job(job)


def changed(job: ReplayJob, change: ChangeConfig) -> ReplayJob:
    """The same replay with what is otherwise.

    Args:
        job: The nominal one.
        change: Factors and shifts.

    Raises:
        UsageError: When the task has no such object that can be moved.
    """
    task = job.task
    movable = [
        name
        for name, model in task.objects.items()
        if not model.fixed and name not in task.containers
    ]
    if change.object and change.object not in movable:
        message = f"no object {change.object!r} can be moved. There are: {', '.join(movable)}."
        raise UsageError(message)
    physics = job.config.physics
    objects = {
        name: replace(model, mass_kg=model.mass_kg * change.mass) if name in movable else model
        for name, model in task.objects.items()
    }
    return replace(
        job,
        task=replace(task, objects=objects),
        start=replace(
            job.start,
            Ts_base_object=_elsewhere(
                job.start.Ts_base_object, [change.object] if change.object else movable, change
            ),
        ),
        config=replace(
            job.config,
            grip_delay_s=job.config.grip_delay_s + change.grip_delay_s,
            physics=replace(
                physics,
                object_friction=physics.object_friction * change.friction,
                grip_force_N=physics.grip_force_N * change.grip_force,
            ),
        ),
    )


def _elsewhere(
    Ts_base_object: Mapping[str, Float[np.ndarray, "4 4"]], names: list[str], change: ChangeConfig
) -> dict[str, Float[np.ndarray, "4 4"]]:
    turn = se3.rotation_from_vector(np.array([0.0, 0.0, change.turn_rad]))
    moved = dict(Ts_base_object)
    for name in names:
        if name in moved and (change.x_m or change.y_m or change.turn_rad):
            T = moved[name].copy()
            T[:3, :3] = turn @ T[:3, :3]
            T[:2, 3] += (change.x_m, change.y_m)
            moved[name] = T
    return moved
