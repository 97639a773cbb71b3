"""Localising the objects of one episode ahead of its replays, as a process of the pool does it."""

from dataclasses import dataclass
from pathlib import Path

from bridge.episode import streams
from bridge.episode.reader import Episode
from bridge.episode.run import RunFolder
from bridge.task.plan import Plan
from bridge.task.task_file import load_task
from twin.replay.place.starts import localised_starts


@dataclass(frozen=True, kw_only=True)
class Preparation:
    """Which episode, and for which scene."""

    run_path: Path
    episode_id: str
    scene_hash: str | None
    force: bool
    """Localise again even when it is there."""

    def episode_path(self) -> Path:
        """Of the recorded episode."""
        return RunFolder.open(self.run_path).episodes_dir / f"{self.episode_id}.mcap"

    def needed_paths(self) -> tuple[Path, ...]:
        """What a process on another machine must see."""
        return (self.run_path, self.episode_path())


def prepare(item: Preparation) -> None:
    """Write what localisation says of an episode, if it is one that is replayed.

    Raises:
        GstError: When the episode or its task cannot be read.
    """
    episode = Episode.open(item.episode_path())
    plans = streams.plans(episode)
    task_name = replayed_task(episode, plans)
    if task_name is not None:
        run, task = RunFolder.open(item.run_path), load_task(task_name)
        localised_starts(run, episode, task, scene_hash=item.scene_hash, force=item.force)


def replayed_task(episode: Episode, plans: list[tuple[int, Plan]]) -> str | None:
    """Name the task an episode's plans are judged by; None when it is not one to replay."""
    if episode.info.kind != "trial" or not plans:
        return None
    return episode.info.task or plans[0][1].task
