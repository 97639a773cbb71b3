"""Where policies are let loose: the starts of recorded trials, and starts drawn from a task."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from bridge.episode import streams
from bridge.episode.catalogue import find_episodes
from bridge.episode.catalogue_query import CatalogueQuery
from bridge.episode.executions import EXECUTION, executed_events
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.topics import GRIPPER_STATE
from bridge.errors import GstError
from bridge.task.task_file import Task
from twin.policies.errors import PolicyError
from twin.policies.identify import response_of
from twin.policies.response import AT_ONCE, Response
from twin.replay.config import ReplayConfig
from twin.replay.rebuilt_scene import for_task, read_rebuilt_scene
from twin.replay.run_job import recorded_start
from twin.replay.scene import ReplayScene, localised_starts
from twin.robot.model import load_robot
from twin.robot.posture import width_track
from twin.scene.store.calibration import read_calibration
from twin.scene.store.folder import scene_hash_of


@dataclass(frozen=True, kw_only=True)
class Start:
    """One state of the cell before anything moves."""

    id: str
    """The recorded ``start_id``; the episode's id where it has none."""
    episode_path: Path
    """Whose cameras, robot and objects it has."""
    scene: ReplayScene
    joints_rad: Float[np.ndarray, " num_joints"]
    width_m: float
    stamp_ns: int
    """Source time at which it was seen."""
    config: ReplayConfig
    """With the calibrated physics of the task."""
    response: Response = AT_ONCE
    """How the cell's controller follows targets."""

    @property
    def task(self) -> Task:
        """What is to be done."""
        return self.scene.task


def trial_episodes(run: RunFolder, task: str) -> list[Episode]:
    """The recorded trials of a task, one for each of its starts."""
    found: dict[str, Episode] = {}
    asked = CatalogueQuery(kind=("trial",), task=(task,) if task else ())
    for trial in find_episodes(run, asked):
        start = f"{trial.task} {trial.start_id or trial.id}"
        if trial.task and start not in found:
            found[start] = Episode.open(run.episodes_dir / trial.file)
    if not found:
        wanted = f"trial of task {task!r}" if task else "trial of a task"
        raise PolicyError(
            f"{run.path} has no {wanted}: a policy starts where one began. Record some, or label "
            "episodes as trials: robot-gst label RUN EPISODE --task NAME."
        )
    return list(found.values())


def open_start(run: RunFolder, episode: Episode) -> Start:
    """Read where a recorded trial began; its objects are localised where they were not yet."""
    urdf = streams.robot_description(episode)
    if urdf is None:
        raise PolicyError(f"{episode.path}: nobody recorded which robot it is (robot_description)")
    task = streams.task_file(episode).task()
    begun_ns = [int(e["stamp_ns"]) for e in executed_events(episode) if e["type"] == EXECUTION[0]]
    stamp_ns = min(begun_ns, default=streams.first_stamp_ns(episode) or episode.start_ns)
    found = localised_starts(run, episode, task, scene_hash=scene_hash_of(run)).at(0)  # at first
    scene = replace(
        read_rebuilt_scene(run, task),
        urdf=urdf,
        Ts_base_object=found.Ts_base_object,
        reasons=found.reasons,
    )
    if scene.missing():
        raise PolicyError(f"{episode.info.id} gives no start: {scene.describe_missing()}")
    robot = load_robot(urdf)
    joints_rad = recorded_start(episode, stamp_ns, robot.joints)
    if joints_rad is None:
        raise PolicyError(f"{episode.info.id} gives no start: nobody recorded where the arm was")
    try:
        widths = width_track(episode, robot.record)
    except GstError as error:
        why = f"nobody says the gripper's width [m] on a topic ...{GRIPPER_STATE}"
        raise PolicyError(f"{episode.info.id} gives no start: {why}") from error
    return Start(
        id=episode.info.start_id or episode.info.id,
        episode_path=episode.path,
        scene=scene,
        joints_rad=joints_rad,
        width_m=float(widths.at(np.array([stamp_ns]))[0, 0]),
        stamp_ns=stamp_ns,
        config=for_task(ReplayConfig(), read_calibration(run), task),
        response=response_of(run, episode, robot),
    )


def drawn_starts(start: Start, count: int, seed: int) -> Iterator[Start]:
    """Other starts of the same cell, objects placed as the task file draws them."""
    if not start.task.start:
        raise PolicyError(f"task {start.task.name!r} says nothing of starts: add [start.OBJECT]")
    for number in range(count):
        rng = np.random.default_rng([seed, number])
        places = {**start.scene.Ts_base_object, **start.task.draw_start(rng)}
        yield replace(
            start, id=f"drawn_{seed}_{number}", scene=replace(start.scene, Ts_base_object=places)
        )
