"""Open what does the work, and import what the work needs while that starts."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from bridge.episode.run_folder import RunFolder
from bridge.errors import UsageError
from bridge.terminal import Output
from twin.crew.pool import Alone, Crew, Runner
from twin.crew.size import default_size
from twin.replay.config import ReplayRunConfig


def replay_run(run: RunFolder, config: ReplayRunConfig, output: Output) -> dict[str, Any]:
    """Replay all trial episodes of a run on what the settings ask for.

    See ``twin.replay.run.trajectories.replay_trajectories``, and what ``runner_for`` raises.

    Raises:
        UsageError: When the folder is no run.
    """
    if not run.episodes_dir.is_dir():
        message = (
            f"{run.path} is not a run: it holds no folder episodes. "
            "Give the folder that episodes/ lies in."
        )
        raise UsageError(message)
    with runner_for(config) as runner:
        # A second, in which a cluster starts its processes.
        from twin.replay.run.trajectories import replay_trajectories  # noqa: PLC0415

        return replay_trajectories(run, config, output, runner)


@contextmanager
def runner_for(config: ReplayRunConfig) -> Iterator[Runner]:
    """Open what does the work: this process, several, or a Ray cluster.

    Raises:
        UsageError: When Ray has no token to show.
        TwinError: When the cluster cannot be reached.
    """
    workers = config.workers or default_size()
    runner: Runner = Alone()
    if config.ray:
        from twin.replay.run.cluster import RayRunner  # noqa: PLC0415  # an extra

        runner = RayRunner(config.ray, workers)
    elif workers > 1:
        runner = Crew(workers)
    with runner:
        yield runner
