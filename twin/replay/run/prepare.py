"""What is to be replayed of one episode: its objects localised, its plans and executions listed.

Each episode is a piece of work of its own, for a process of the pool as for this one.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from bridge.episode import streams
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.task.plan import Plan
from bridge.task.task_file import load_task
from twin.replay.config import ReplayRunConfig
from twin.replay.place.calibrated import calibrated, for_task
from twin.replay.place.starts import localised_starts
from twin.replay.run.executions import execution_of
from twin.replay.work.job import ReplayJob
from twin.scene.store.calibration import read_calibration


@dataclass(frozen=True, kw_only=True)
class Preparation:
    """Which episode, for which scene, with which settings."""

    run_path: Path
    episode_id: str
    scene_hash: str | None
    shapes: Mapping[str, str]
    """Hashes of the scene's shapes, see ``twin.replay.place.rebuilt.shape_hashes``."""
    config: ReplayRunConfig

    def episode_path(self) -> Path:
        """Of the recorded episode."""
        return RunFolder.open(self.run_path).episodes_dir / f"{self.episode_id}.mcap"

    def needed_paths(self) -> tuple[Path, ...]:
        """What a process on another machine must see."""
        return (self.run_path, self.episode_path())

    def cost(self) -> float:
        """How long it takes, compared with others."""
        return float(self.episode_path().stat().st_size)


def jobs_of(item: Preparation) -> list[ReplayJob]:
    """Localise the objects of an episode, where that is not there yet, and list its replays.

    Returns:
        One job per plan, two more where it was executed; none when the episode is not replayed.

    Raises:
        GstError: When the episode or its task cannot be read.
    """
    run, path, config = RunFolder.open(item.run_path), item.episode_path(), item.config
    episode = Episode.open(path)
    plans = streams.plans(episode)
    task_name = replayed_task(episode, plans)
    if task_name is None:
        return []
    task = load_task(task_name)
    starts = localised_starts(
        run, episode, task, scene_hash=item.scene_hash, force=config.relocalise
    )
    digest = episode.sha256()
    calibration = read_calibration(run)
    replay = for_task(calibrated(config.replay, calibration), task)
    jobs, events = [], streams.events(episode)
    for index, (stamp_ns, plan) in enumerate(plans):
        execution = execution_of(events, plan.id)
        interval = execution.interval_ns
        start_ns = stamp_ns if interval is None else interval[0]
        common = ReplayJob(
            episode_path=path,
            episode_sha256=digest,
            plan_id=plan.id,
            plan_index=index,
            trajectory="planned",
            start_ns=start_ns,
            end_ns=None if interval is None else interval[1],
            task=task_name,
            start=starts.at(start_ns),
            scene_hash=item.scene_hash,
            config=replace(replay, mode="dynamic", samples=config.samples),
            folder=run.derived_dir.resolve(),
            duration_s=plan.tau[-1].t_ns * 1e-9 if plan.tau else 0.0,
            run_path=run.path,
            shapes=item.shapes,
            calibration_id=None if calibration is None else calibration.calibration_id,
            render=config.render,
            problem=execution.problem,
        )
        jobs.append(common)
        if common.was_executed:
            executed = replace(common, trajectory="executed", end=starts.after(plan.id))
            jobs.append(executed)
            jobs.append(replace(executed, config=replace(replay, mode="kinematic")))
    return jobs


def replayed_task(episode: Episode, plans: list[tuple[int, Plan]]) -> str | None:
    """Name the task an episode's plans are judged by; None when it is not one to replay."""
    if episode.info.kind != "trial" or not plans:
        return None
    return episode.info.task or plans[0][1].task
