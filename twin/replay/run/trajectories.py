"""Replay every trajectory of a run: each plan as planned, each execution as recorded."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from bridge.episode import streams
from bridge.episode.reader import Episode
from bridge.episode.run import RunFolder
from bridge.errors import GstError, PathNotFoundError, UsageError
from bridge.task.task_file import load_task
from bridge.terminal import Advance, Output
from twin.replay.config import ReplayRunConfig
from twin.replay.crew.pool import Alone, Crew, Runner
from twin.replay.crew.worker import Failed, do
from twin.replay.place.calibrated import calibrated, for_task
from twin.replay.place.rebuilt import read_place, shape_hashes
from twin.replay.place.starts import localised_starts
from twin.replay.run.executions import execution_of
from twin.replay.run.prepare import Preparation, prepare, replayed_task
from twin.replay.run.table import against_recorded, count_verdicts, executions_of, recorded_labels
from twin.replay.run.undrawn import describe_undrawn
from twin.replay.work.job import ReplayJob, row_of_existing, row_of_failure
from twin.replay.work.relive import run_job
from twin.scene.store.calibration import read_calibration
from twin.scene.store.folder import SCENE_FILE, read_record, scene_hash_of


def replay_run(run: RunFolder, config: ReplayRunConfig, output: Output) -> dict[str, Any]:
    """Replay all trial episodes of a run; replays that are there already are kept.

    Returns:
        ``rows`` (one per trajectory), ``counts`` per trajectory and mode, ``skipped_episodes``
        with reasons, what was said ``against_recorded`` labels, and the scene hash.

    Raises:
        UsageError: When an episode named in the configuration is not in the run.
        PathNotFoundError: When pictures are asked for and no scene was rebuilt.
    """
    scene_hash = _scene_hash(run, config, output)
    with runner_for(config) as runner:
        jobs, skipped = _all_jobs(run, scene_hash, config, runner, output)
        _say_what_is_missing(run, jobs, output)
        if config.render:
            tasks = sorted({job.task for job in jobs})
            for remark in describe_undrawn(read_record(run) or {}, tasks):
                output.say(remark)
        rows, todo = _there_already(jobs, config)
        run.derived_dir.mkdir(parents=True, exist_ok=True)  # Ray asks each node whether it is there
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


@contextmanager
def runner_for(config: ReplayRunConfig) -> Iterator[Runner]:
    """Open what does the work: this process, several, or a Ray cluster.

    Raises:
        UsageError: When Ray has no token to show.
        TwinError: When the cluster cannot be reached.
    """
    runner: Runner = Alone()
    if config.ray:
        from twin.replay.crew.cluster import RayRunner  # noqa: PLC0415  # an extra

        runner = RayRunner(config.ray, config.workers)
    elif config.workers > 1:
        runner = Crew(config.workers)
    with runner:
        yield runner


def _all_jobs(
    run: RunFolder,
    scene_hash: str | None,
    config: ReplayRunConfig,
    runner: Runner,
    output: Output,
) -> tuple[list[ReplayJob], dict[str, str]]:
    """List what is to be replayed, and the episodes that cannot be, with the reason."""
    names = _chosen(run, config)
    jobs: list[ReplayJob] = []
    ahead = not isinstance(runner, Alone)
    relocalise = config.relocalise and not ahead
    shapes = shape_hashes(run)
    with output.progress("localise", len(names)) as advance:
        skipped = _prepare(run, names, scene_hash, config, runner, advance) if ahead else {}
        for index, episode_id in enumerate(name for name in names if name not in skipped):
            answer = do(
                lambda name: _jobs_of(
                    run, name, scene_hash, shapes, config, output, relocalise=relocalise
                ),
                episode_id,
            )
            if isinstance(answer, Failed):
                skipped[episode_id] = answer.message
                output.detail(answer.trace)
            else:
                jobs += answer
            if not ahead:
                advance(index + 1, episode_id)
    for episode_id, reason in sorted(skipped.items()):
        output.say(f"{episode_id}: {reason}")
    return jobs, skipped


def _prepare(
    run: RunFolder,
    names: list[str],
    scene_hash: str | None,
    config: ReplayRunConfig,
    runner: Runner,
    advance: Advance,
) -> dict[str, str]:
    """Localise many episodes side by side; returns those that failed, with the reason."""
    items = [
        Preparation(
            run_path=run.path.resolve(),
            episode_id=name,
            scene_hash=scene_hash,
            force=config.relocalise,
        )
        for name in names
    ]
    failed = {}
    answers = runner.run(prepare, items, lambda item: item.episode_path().stat().st_size)
    for done, (item, answer) in enumerate(answers, start=1):
        if isinstance(answer, Failed):
            failed[item.episode_id] = answer.message
        advance(done, item.episode_id)
    return failed


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


def _jobs_of(
    run: RunFolder,
    episode_id: str,
    scene_hash: str | None,
    shapes: Mapping[str, str],
    config: ReplayRunConfig,
    output: Output,
    *,
    relocalise: bool,
) -> list[ReplayJob]:
    path = run.episodes_dir.resolve() / f"{episode_id}.mcap"  # for processes elsewhere
    episode = Episode.open(path)
    plans = streams.plans(episode)
    task_name = replayed_task(episode, plans)
    if task_name is None:
        output.detail(f"{episode_id}: {episode.info.kind} with {len(plans)} plan(s), not replayed")
        return []
    task = load_task(task_name)
    starts = localised_starts(run, episode, task, scene_hash=scene_hash, force=relocalise)
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
            scene_hash=scene_hash,
            config=replace(replay, mode="dynamic", samples=config.samples),
            folder=run.derived_dir.resolve(),
            duration_s=plan.tau[-1].t_ns * 1e-9 if plan.tau else 0.0,
            run_path=run.path.resolve(),
            shapes=shapes,
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


def _there_already(
    jobs: list[ReplayJob], config: ReplayRunConfig
) -> tuple[list[dict[str, Any]], list[ReplayJob]]:
    """Rows of the replays that were made before, and the jobs that are still to do."""
    rows, todo = [], []
    for job in jobs:
        row = None if config.force else row_of_existing(job)
        if row is None:
            todo.append(job)
        else:
            rows.append(row)
    return rows, todo


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
