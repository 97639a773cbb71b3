"""Replay every trajectory of a run: each plan as planned, each execution as recorded."""

import multiprocessing
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from typing import Any

from bridge.episode import streams
from bridge.episode.reader import Episode
from bridge.episode.run import RunFolder
from bridge.errors import GstError, UsageError
from bridge.task.task_file import load_task
from bridge.terminal import Output
from twin.replay.config import ReplayRunConfig
from twin.replay.job import ReplayJob, row_of_existing, run_job
from twin.replay.scene import refuse_soft
from twin.replay.starts import localised_starts
from twin.scene.store import scene_hash_of


def replay_run(run: RunFolder, config: ReplayRunConfig, output: Output) -> dict[str, Any]:
    """Replay all trial episodes of a run; replays that are there already are kept.

    Returns:
        ``rows`` (one per trajectory), ``counts`` per trajectory and mode, ``skipped_episodes``
        with reasons, and the scene hash.

    Raises:
        UsageError: When an episode named in the configuration is not in the run.
    """
    scene_hash = _scene_hash(run, output)
    jobs: list[ReplayJob] = []
    skipped: dict[str, str] = {}
    paths = _chosen(run, config)
    with output.progress("localise", len(paths)) as advance:
        for index, episode_id in enumerate(paths):
            try:
                jobs += _jobs_of(run, episode_id, scene_hash, config, output)
            except GstError as error:
                skipped[episode_id] = str(error)
                output.say(f"{episode_id}: {error}")
            advance(index + 1, episode_id)
    rows = []
    with output.progress("replay", len(jobs)) as advance:
        for row in _rows(jobs, config):
            rows.append(row)
            advance(len(rows), f"{row['episode']} {row['trajectory']} {row['mode']}")
            if row["error"]:
                output.say(f"{row['episode']} {row['plan']}: {row['error']}")
    rows.sort(key=lambda row: (row["episode"], row["plan"], row["trajectory"], row["mode"]))
    return {
        "run": str(run.path),
        "scene_hash": scene_hash,
        "counts": count_verdicts(rows),
        "skipped_episodes": skipped,
        "rows": rows,
    }


def _scene_hash(run: RunFolder, output: Output) -> str | None:
    scene_hash = scene_hash_of(run)
    if scene_hash is None:
        output.say(
            "No scene has been rebuilt (scene/scene.json is missing): replays use the task's "
            "shapes and the table plane, and carry no scene hash."
        )
    return scene_hash


def _chosen(run: RunFolder, config: ReplayRunConfig) -> list[str]:
    there = [path.stem for path in run.episodes()]
    unknown = [name for name in config.episode if name not in there]
    if unknown:
        message = (
            f"no episode named {', '.join(unknown)} in {run.episodes_dir}. "
            f"There are: {', '.join(there) or 'none'}."
        )
        raise UsageError(message)
    return list(config.episode) or there


def _jobs_of(
    run: RunFolder,
    episode_id: str,
    scene_hash: str | None,
    config: ReplayRunConfig,
    output: Output,
) -> list[ReplayJob]:
    path = run.episodes_dir / f"{episode_id}.mcap"
    episode = Episode.open(path)
    plans = streams.plans(episode)
    if episode.info.kind != "trial" or not plans:
        output.detail(f"{episode_id}: {episode.info.kind} with {len(plans)} plan(s), not replayed")
        return []
    task_name = episode.info.task or plans[0][1].task
    task = load_task(task_name)
    refuse_soft(task)
    starts = localised_starts(run, episode, task, scene_hash=scene_hash, force=config.relocalise)
    digest = episode.sha256()
    jobs = []
    for index, (stamp_ns, plan) in enumerate(plans):
        interval = streams.executed_interval_ns(episode, plan.id)
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
            config=replace(config.replay, mode="dynamic"),
            folder=run.derived_dir,
        )
        jobs.append(common)
        if interval is not None:
            jobs.append(replace(common, trajectory="executed"))
            kinematic = replace(config.replay, mode="kinematic")
            jobs.append(replace(common, trajectory="executed", config=kinematic))
    return jobs


def _rows(jobs: list[ReplayJob], config: ReplayRunConfig) -> Iterator[dict[str, Any]]:
    todo = []
    for job in jobs:
        row = None if config.force else row_of_existing(job)
        if row is None:
            todo.append(job)
        else:
            yield row
    if config.workers <= 1 or len(todo) <= 1:
        yield from map(run_job, todo)
        return
    # spawn: PyBullet and pinocchio hold memory that must not be forked.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(max_workers=config.workers, mp_context=context) as pool:
        try:
            for future in as_completed([pool.submit(run_job, job) for job in todo]):
                yield future.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def count_verdicts(rows: list[dict[str, Any]]) -> dict[str, dict[str, int]]:
    """Accepted, rejected, undecided and failed per trajectory and mode, and how many in all."""
    counts: dict[str, Counter[str]] = {}
    for row in rows:
        key = f"{row['trajectory']} {row['mode']}"
        if key == "planned dynamic" and not row["executed"]:
            key = "planned dynamic, never executed"
        word = {True: "accepted", False: "rejected", None: "undecided"}[row["accepted"]]
        counts.setdefault(key, Counter())["failed" if row["error"] else word] += 1
        counts[key]["n"] += 1
    words = ("n", "accepted", "rejected", "undecided", "failed")
    return {key: {word: counter[word] for word in words} for key, counter in counts.items()}


def describe_run(summary: dict[str, Any]) -> str:
    """The final table as text."""
    if not summary["rows"]:
        return "No trial with a plan to replay."
    width = max(len(key) for key in summary["counts"])
    lines = [
        f"{'':{width}}  {'n':>5} {'accepted':>9} {'rejected':>9} {'undecided':>9} {'failed':>7}"
    ]
    lines += [
        f"{key:{width}}  {c['n']:>5} {c['accepted']:>9} {c['rejected']:>9} {c['undecided']:>9} "
        f"{c['failed']:>7}"
        for key, c in sorted(summary["counts"].items())
    ]
    rejected = [row for row in summary["rows"] if row["accepted"] is False]
    lines += [
        f"  {row['episode']} {row['plan']} {row['trajectory']} {row['mode']}: {row['reason']}"
        for row in rejected
    ]
    kept = sum(row["skipped"] for row in summary["rows"])
    if kept:
        lines.append(f"{kept} of {len(summary['rows'])} were there already; --force redoes them.")
    return "\n".join(lines)
