"""The start that the planner's tests plan from."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scripted_plans import scene_of_test

from bridge.data_files import datasets_folder
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.writer import EpisodeWriter
from bridge.task.find import ATTACHMENT, MEDIA_TYPE
from bridge.task.task_file import TaskFile
from twin.plan.problem import Problem
from twin.plan.shapes import shapes_of
from twin.replay.scene import ReplayScene
from twin.robot.model import load_robot

CUBE = TaskFile.read(datasets_folder() / "tasks" / "cube_into_box.toml")
HOME = np.array([-0.263, -1.709, 1.365, -1.227, -1.571, 1.308])


def write_episode(path: Path, file: TaskFile = CUBE, kind: Any = "scan") -> None:
    """An episode of which nothing but its task was recorded."""
    with EpisodeWriter(path) as writer:
        name = file.task().name
        writer.describe(EpisodeInfo(id=path.stem, kind=kind, task=name, task_sha256=file.sha256))
        writer.attach(ATTACHMENT, file.data, media_type=MEDIA_TYPE, log_time_ns=1)


def problem_of_test(scene: ReplayScene | None = None) -> Problem:
    scene = scene_of_test() if scene is None else scene
    return Problem(
        scene=replace(scene, start_rad=HOME),
        robot=load_robot(scene.urdf),
        shapes=shapes_of(None, scene.task),
    )
