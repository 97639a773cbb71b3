"""The twin as an EnvHub folder, which LeRobot loads: an ``env.py`` that says whose twin it is."""

import os
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv

from bridge.episode.run_folder import RunFolder
from bridge.errors import UsageError
from bridge.whole_file import write_whole
from twin.policies.environment import TwinEnv
from twin.policies.errors import PolicyError
from twin.policies.starts import trial_episodes

SCRIPT = '''"""The twin of {name}, as LeRobot's EnvHub and Gymnasium load it."""

from twin.policies.hub import vector_env

RUN = ({beside!r}, {recorded!r})
"""Where the run is from here, and where it was."""
SETTINGS = {{
{settings}
}}
"""Of robot_gst/Twin-v0. Tasks: {tasks}."""


def make_env(n_envs=1, use_async_envs=False, cfg=None):
    """Return a vector of environments; the task of ``cfg`` counts where it has one."""
    return vector_env(__file__, RUN, SETTINGS, n_envs, use_async_envs, cfg)
'''


def write_env(run: RunFolder, folder: Path) -> dict[str, Any]:
    """Write the folder of a run that has a scene and trials; what there is stays."""
    path = folder / "env.py"
    if path.exists():
        raise UsageError(f"{path} is there: change it, or choose another folder")
    env = TwinEnv(run.path)
    settings = {
        "task": env.task,
        "cameras": list(env.cameras),
        "size": None,
        "control": "joint_position",
        "rate_hz": 10.0,
        "latency_s": 0.0,
        "max_s": 30.0,
    }
    tasks = list(dict.fromkeys(episode.info.task for episode in trial_episodes(run, "")))
    found = {"tasks": tasks, "cameras": settings["cameras"], "file": str(path)}
    recorded = run.path.resolve()
    text = SCRIPT.format(
        name=recorded.name,
        beside=os.path.relpath(recorded, folder.resolve()),
        recorded=str(recorded),
        settings="\n".join(f"    {name!r}: {value!r}," for name, value in settings.items()),
        tasks=", ".join(tasks),
    )
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(path, text.encode())
    return found


def vector_env(
    script: str,
    run: Sequence[str],
    settings: Mapping[str, Any],
    n_envs: int,
    use_async_envs: bool,
    cfg: Any = None,
) -> VectorEnv:
    """Open a run as often as is asked for, as LeRobot's evaluation takes it.

    Args:
        script: The ``env.py``.
        run: Where its run may be, the first from its folder.
        use_async_envs: Each in a process of its own.
        cfg: LeRobot's, or None; of it the task is taken.
    """
    places = [Path(script).parent / place for place in run]
    path = next((place for place in places if (place / "episodes").is_dir()), None)
    if path is None:
        where = " nor in ".join(map(os.path.normpath, places))
        raise PolicyError(f"{script}: its run is neither in {where}. Change RUN in it.")
    task = getattr(cfg, "task", None) or settings["task"]
    make = partial(TwinEnv, path, render_mode="rgb_array", **{**settings, "task": task})
    makers, mode = [make] * n_envs, AutoresetMode.SAME_STEP
    if use_async_envs:  # what this process has begun, threads above all, is none of theirs
        return AsyncVectorEnv(makers, autoreset_mode=mode, context="spawn")
    return SyncVectorEnv(makers, autoreset_mode=mode)
