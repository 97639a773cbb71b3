"""The command ``plan``; imports stay late so that --help is quick."""

from pathlib import Path

from bridge.terminal import Output
from twin.plan.config import LivePlanConfig, PlanConfig

OUTPUT = Output()
LIVE_PLAN = LivePlanConfig()
PLAN = PlanConfig()


def plan(
    run: Path,
    /,
    *,
    task: str | None = None,
    dry: bool = False,
    live: bool = False,
    words: PlanConfig = PLAN,
    config: LivePlanConfig = LIVE_PLAN,
    output: Output = OUTPUT,
) -> int:
    """Plan a task from words, have the twin judge the plan, and write it into the run's plans/.

    With --live, plan for a cell that asks over zenoh; stop with Ctrl-C.
    Exit code 2, with what could be meant, where the instruction is not understood whole; 3 where
    the twin accepted no candidate. Nothing is sent to a cell.
    Example: robot-gst plan runs/today --task "put the cube into the box"

    Args:
        run: Run folder; its episodes and its scene say which objects there are, and where.
        task: The instruction, in English where no model is given, or the name or file of a task.
        dry: Say what was understood and write nothing; without it plans go into the run's
            plans/ and their task into tasks/.
        live: Answer a cell's requests.
        words: How an instruction is planned.
        config: Settings of --live; its robot counts without it too.
    """
    from bridge.episode.run_folder import RunFolder
    from bridge.errors import UsageError
    from twin.plan.ground.run_tasks import keep, understand

    if live and (task is not None or dry):
        message = (
            "--live answers a cell, whose requests name their task: leave --task and --dry out."
        )
        raise UsageError(message)
    if live:
        from twin.plan.live import run_planner

        return run_planner(run, config, output, words)
    if task is None:
        message = (
            'say what to plan: robot-gst plan RUN --task "put the cube into the box", or --live to '
            "answer a cell's requests."
        )
        raise UsageError(message)
    folder = RunFolder.open(run)
    if dry and not words.model:
        understood = understand(folder, task)
        output.result({**understood.to_json(), "file": None}, "\n".join(understood.lines()))
        return 0
    from twin.gate.twin_process import judge_of
    from twin.plan.once import begin, plan_once

    begun = begin(folder, task, words, config.robot)
    understood = begun.understood
    if dry:
        output.result({**begun.to_json(), "file": None}, "\n".join(begun.lines()))
        return 0
    if begun.asked is not None and not words.yes:
        _refuse_without_yes("\n".join(begun.lines()))
    judge = judge_of(folder.path, begun.start.problem.scene)
    planned = plan_once(folder, begun, judge, words)
    path = keep(folder, understood)
    data = {**planned.to_json(), "file": None if path is None else str(path)}
    wrote = [] if path is None else [f"wrote {path}"]
    output.result(data, "\n".join([*planned.lines(), *wrote]))
    return 0 if planned.path is not None else 3


def _refuse_without_yes(understood: str) -> None:
    """Read back what a model understood, and go on only with a person's yes."""
    import sys

    from bridge.errors import UsageError
    from bridge.terminal import printable

    sys.stderr.write(f"{printable(understood)}\n")
    if not sys.stdin.isatty():
        message = "what the model understood needs a yes, and nobody is here to ask: add --yes."
        raise UsageError(message)
    if input("Is that meant? [y/N] ").strip().lower() not in ("y", "yes"):
        message = "not meant, so nothing was planned. Say it in other words."
        raise UsageError(message)
