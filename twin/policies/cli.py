"""The command ``robot-gst rollout``; imports stay late so that --help is quick."""

from pathlib import Path

from bridge.terminal import Output
from twin.policies.config import RolloutConfig

OUTPUT = Output()


def export_env(run: Path, folder: Path, /, *, output: Output = OUTPUT) -> int:
    """Write a folder whose env.py gives the twin of a run to LeRobot, and to Gymnasium.

    Example: robot-gst export env runs/monday envs/monday

    Args:
        run: Run folder with a rebuilt scene and trials.
        folder: Where env.py goes; what it gives can be changed in it.
    """
    from bridge.episode.run_folder import RunFolder
    from twin.policies.hub import write_env

    found = write_env(RunFolder.open(run), folder)
    tasks, cameras = (", ".join(found[key]) for key in ("tasks", "cameras"))
    output.result(found, f"{found['file']}: {tasks}; cameras {cameras}")
    return 0


def rollout(run: Path, /, *, config: RolloutConfig, output: Output = OUTPUT) -> int:
    """Let a policy act in the twin from recorded starts, and compare with the cell.

    Writes RUN/rollouts.csv, which ``robot-gst evaluate`` reads. Exit code 2 where a rollout says
    nothing of the policy, with the reason.
    Example: robot-gst rollout runs/monday --policy ws://127.0.0.1:8000 --map droid.toml
    Example: robot-gst rollout runs/monday --policy my_policy:make --check
    In the cell: robot-gst rollout runs/monday --policy ws://127.0.0.1:8000 --name pi0 --cell lab

    Args:
        run: Run folder.
    """
    from bridge.episode.run_folder import RunFolder
    from twin.policies.check import check_policy, describe_check
    from twin.policies.runs import describe_rollouts, roll_out_run

    folder = RunFolder.open(run)
    if config.cell:
        from twin.policies.runner import serve_cell

        count = serve_cell(config, output)
        output.result({"trials": count}, f"{count} trials of {config.name or config.policy}")
        return 0
    if config.check:
        found = check_policy(folder, config)
        output.result(found, describe_check(found))
        return 0
    with folder.alone_in(folder.derived_dir):
        summary = roll_out_run(folder, config, output)
    output.result(summary, describe_rollouts(summary))
    return 2 if any(row["problem"] for row in summary["rows"]) else 0
