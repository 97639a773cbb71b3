"""Replay every trajectory of a run: each plan as planned, each execution as recorded."""

from collections.abc import Iterator
from typing import Any

from bridge.episode.run_folder import RunFolder
from bridge.errors import GstError, PathNotFoundError, UsageError
from bridge.task.task_file import load_task
from bridge.terminal import Output
from twin.crew.pool import Runner
from twin.crew.worker import Failed
from twin.replay.config import ReplayRunConfig
from twin.replay.place.rebuilt import read_place, shape_hashes
from twin.replay.run.kept import there_already
from twin.replay.run.prepare import Preparation, jobs_of
from twin.replay.run.table import against_recorded, count_verdicts, executions_of, recorded_labels
from twin.replay.run.undrawn import describe_undrawn
from twin.replay.work.job import ReplayJob, row_of_failure
from twin.replay.work.relive import run_job
from twin.scene.store.folder import SCENE_FILE, read_record, scene_hash_of


def replay_trajectories(
    run: RunFolder, config: ReplayRunConfig, output: Output, runner: Runner
) -> dict[str, Any]:
    """Replay all trial episodes of a run; replays that are there already are kept.

    Args:
        run: Whose episodes are replayed, and whose ``derived`` folder gets the replays.
        config: Settings.
        output: How to talk.
        runner: What does the work.

    Returns:
        ``rows`` (one per trajectory), ``counts`` per trajectory and mode, ``skipped_episodes``
        with reasons, what was said ``against_recorded`` labels, and the scene hash.

    Raises:
        UsageError: When an episode named in the configuration is not in the run.
        PathNotFoundError: When pictures are asked for and no scene was rebuilt.
    """
    scene_hash = _scene_hash(run, config, output)
    jobs, skipped = _all_jobs(run, scene_hash, config, runner, output)
    _say_what_is_missing(run, jobs, output)
    if config.render:
        tasks = sorted({job.task for job in jobs})
        for remark in describe_undrawn(read_record(run) or {}, tasks):
            output.say(remark)
    rows, todo = there_already(jobs, force=config.force)
    if todo:
        run.derived_dir.mkdir(parents=True, exist_ok=True)  # each node is asked whether it is there
    told: set[tuple[str, str, str]] = set()  # one cause spoils all replays of a plan
    with output.progress("replay", len(todo)) as advance:
        for done, row in enumerate(_replayed(todo, runner, output), start=1):
            rows.append(row)
            advance(done, f"{row['episode']} {row['trajectory']} {row['mode']}")
            what = (row["episode"], row["plan"], row["error"])
            if row["error"] and what not in told:
                told.add(what)
                output.say(f"{row['episode']} {row['plan']}: {row['error']}")
    rows.sort(key=lambda row: (row["episode"], row["plan"], row["trajectory"], row["mode"]))
    executions = executions_of(rows, recorded_labels(run, sorted({row["episode"] for row in rows})))
    return {
        "run": str(run.path),
        "scene_hash": scene_hash,
        "counts": count_verdicts(rows),
        "executions": executions,
        "against_recorded": against_recorded(executions),
        "skipped_episodes": skipped,
        "rows": rows,
    }


def _all_jobs(
    run: RunFolder,
    scene_hash: str | None,
    config: ReplayRunConfig,
    runner: Runner,
    output: Output,
) -> tuple[list[ReplayJob], dict[str, str]]:
    """List what is to be replayed, and the episodes that cannot be, with the reason."""
    names = _chosen(run, config)
    shapes = shape_hashes(run)
    items = [
        Preparation(
            run_path=run.path.resolve(),
            episode_id=name,
            scene_hash=scene_hash,
            shapes=shapes,
            config=config,
        )
        for name in names
    ]
    jobs: dict[str, list[ReplayJob]] = {}
    skipped: dict[str, str] = {}
    with output.progress("localise", len(names)) as advance:
        answers = runner.run(jobs_of, items, Preparation.cost)
        for done, (item, answer) in enumerate(answers, start=1):
            if isinstance(answer, Failed):
                skipped[item.episode_id] = answer.message
                output.detail(answer.trace)
            elif answer:
                jobs[item.episode_id] = answer
            else:
                output.detail(f"{item.episode_id}: no trial with a plan, not replayed")
            advance(done, item.episode_id)
    for episode_id, reason in sorted(skipped.items()):
        output.say(f"{episode_id}: {reason}")
    return [job for name in names for job in jobs.get(name, ())], skipped


def _scene_hash(run: RunFolder, config: ReplayRunConfig, output: Output) -> str | None:
    scene_hash = scene_hash_of(run)
    if scene_hash is None:
        if config.render:
            hint = "--render draws it. Make it: robot-gst rebuild RUN, or leave --render out."
            raise PathNotFoundError(path=run.scene_dir / SCENE_FILE, what="scene", hint=hint)
        output.say(
            "No scene has been rebuilt (scene/scene.json is missing): replays use the task's "
            "shapes and the table plane, and carry no scene hash."
        )
    return scene_hash


def _say_what_is_missing(run: RunFolder, jobs: list[ReplayJob], output: Output) -> None:
    """Tell what the task file stands in for, once for all replays of a task."""
    for task in sorted({job.task for job in jobs}):
        try:
            remarks = read_place(run, load_task(task)).remarks
        except GstError:  # which each of its replays will say
            continue
        for remark in remarks:
            output.say(f"{task}: {remark}")


def _chosen(run: RunFolder, config: ReplayRunConfig) -> list[str]:
    there = [path.stem for path in run.episodes()]
    unknown = [name for name in config.episode if name not in there]
    if unknown:
        message = (
            f"no episode named {', '.join(unknown)} in {run.episodes_dir}. "
            f"There are: {', '.join(there) or 'none'}."
        )
        raise UsageError(message)
    return list(dict.fromkeys(config.episode)) or there


def _replayed(todo: list[ReplayJob], runner: Runner, output: Output) -> Iterator[dict[str, Any]]:
    # An executed replay is compared with the planned one, which must be there before.
    for late in (False, True):
        batch = [job for job in todo if job.needs_planned is late]
        if not batch:
            continue
        for job, answer in runner.run(run_job, batch, ReplayJob.cost):
            if isinstance(answer, Failed):
                output.detail(answer.trace)
                yield row_of_failure(job, answer.message)
            else:
                yield answer
