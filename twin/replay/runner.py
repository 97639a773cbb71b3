"""Replay every trajectory of a run: each plan as planned, each execution as recorded."""

import contextlib
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from bridge.episode import schema, streams
from bridge.episode.executions import NO_PLAN, executed_events, whose
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder, refuse_full
from bridge.episode.streams import execution_ns
from bridge.episode.topics import JOINT_STATES, ROBOT_DESCRIPTION
from bridge.errors import GstError, PathNotFoundError, UsageError
from bridge.leaves import load_leaf
from bridge.process_pool import Failed, Runner, runner_of
from bridge.robots.robot import read_robot, robot_of
from bridge.task.scripted_motion import RECORD_NAME
from bridge.task.task_file import Task
from bridge.terminal import Output
from twin.replay.config import ReplayRunConfig
from twin.replay.failure import with_reasons
from twin.replay.job import WITHOUT, ReplayJob, row_of_existing, row_of_failure
from twin.replay.rebuilt_scene import for_task, read_rebuilt_scene, shape_hashes
from twin.replay.run_job import run_job
from twin.replay.scene import localised_starts
from twin.replay.summary import against_recorded, count_verdicts, recorded_labels
from twin.robot.posture import check_joints, width_track
from twin.scene.localise.episode import MOTION_MARGIN_NS
from twin.scene.store.calibration import read_calibration
from twin.scene.store.folder import SCENE_FILE, read_record, scene_hash_of
from twin.scene.store.library import Library


def execution_of(
    events: Iterable[Mapping[str, Any]], plan_id: str
) -> tuple[tuple[int, int] | None, str]:
    """Source times between which a plan was executed whole, and why it cannot be replayed, if so.

    None where it was not executed from beginning to end.
    """
    mine = [event for event in events if event.get("plan_id") == plan_id]
    count = sum(event["type"] == "execution_started" for event in mine)
    start, end = execution_ns(mine, plan_id)
    if start is None or end is None:
        began = f"the execution of {whose(plan_id)} began, and nobody recorded that it ended"
        return None, began if count else ""
    problem = ""
    if count > 1:
        problem = (
            f"{whose(plan_id)} was executed {count} times, and which end belongs to which nobody "
            "can tell; give each execution a plan with an id of its own"
        )
    return (start, end), problem


LABEL = "robot-gst label RUN EPISODE --task NAME"
"""What makes a trial of an episode."""


@dataclass(frozen=True, kw_only=True)
class Preparation:
    """Which episode, for which scene, with which settings."""

    run_path: Path
    episode_id: str
    scene_hash: str | None
    shapes: Mapping[str, str]
    """Hashes of the scene's shapes, see ``twin.replay.rebuilt_scene.shape_hashes``."""
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


@dataclass(frozen=True, kw_only=True)
class Prepared:
    """The replays of one episode, and why there are none, or fewer."""

    jobs: tuple[ReplayJob, ...] = ()
    why_not: str = ""
    was_meant: bool = True
    """Whether it is a trial, or could be one: no scan, no pictures alone."""


def jobs_of(item: Preparation) -> Prepared:
    """Localise the objects of an episode, where that is not there yet, and list its replays.

    One job per plan, and two more for each execution, with a plan or without.
    """
    run, path, config = RunFolder.open(item.run_path), item.episode_path(), item.config
    episode = Episode.open(path)
    plans = streams.plans(episode)
    events = executed_events(episode)
    planned = {plan.id for _, plan in plans}
    started = [event for event in events if event["type"] == "execution_started"]
    executed_ids = dict.fromkeys(str(event.get("plan_id") or NO_PLAN) for event in started)
    without = [name for name in executed_ids if name not in planned]
    nothing = _nothing_to_replay(episode, config.robot, is_planned=bool(plans), moved=bool(without))
    if nothing is not None:
        return nothing
    task = streams.task_file(episode, plans[0][1].task if plans else "").task()
    starts = localised_starts(run, episode, task, scene_hash=item.scene_hash)
    digest = episode.sha256()
    calibration = read_calibration(run)
    replay = for_task(config.replay, calibration, task)
    jobs, why_not = [], ""
    listed = [
        (plan.id, index, stamp_ns, plan.tau[-1].t_ns if plan.tau else 0)
        for index, (stamp_ns, plan) in enumerate(plans)
    ]
    for plan_id, index, stamp_ns, length_ns in [*listed, *((i, WITHOUT, 0, 0) for i in without)]:
        interval, problem = execution_of(events, plan_id)
        start_ns = stamp_ns if interval is None else interval[0]
        common = ReplayJob(
            episode_path=path,
            episode_sha256=digest,
            plan_id=plan_id,
            plan_index=index,
            trajectory="planned",
            start_ns=start_ns,
            end_ns=None if interval is None else interval[1],
            task=task,
            start=starts.at(start_ns - (MOTION_MARGIN_NS if index == WITHOUT else 0)),
            scene_hash=item.scene_hash,
            config=replace(replay, mode="dynamic", samples=config.samples),
            folder=run.derived_dir.resolve(),
            duration_s=(length_ns or (interval[1] - interval[0] if interval else 0)) * 1e-9,
            run_path=run.path,
            shapes=item.shapes,
            calibration_id=None if calibration is None else calibration.calibration_id,
            render=config.render,
            robot=config.robot,
            problem=problem,
        )
        if index != WITHOUT:
            jobs.append(common)
        if common.was_executed:
            # Varied replays say what a plan is worth; what was executed happened once.
            executed = replace(
                common,
                trajectory="executed",
                end=starts.after(plan_id),
                config=replace(common.config, samples=0),
            )
            if index == WITHOUT and not set(task.manipulated) & set(executed.start.Ts_base_object):
                unseen = with_reasons(executed.start.reasons)
                why_not = f"only the robot is replayed; not seen before it moved: {unseen}"
            else:
                jobs.append(executed)
            # Which engine is asked makes no other kinematic replay.
            alone = replace(replay, engine="pybullet", mode="kinematic")
            jobs.append(replace(executed, config=alone))
    return Prepared(jobs=tuple(jobs), why_not=why_not)


def _nothing_to_replay(
    episode: Episode, robot: str, *, is_planned: bool, moved: bool
) -> Prepared | None:
    """Say why nothing of an episode can be replayed; None where something can."""
    info = episode.info
    if info.kind not in ("trial", "imported"):
        return Prepared(why_not=f"a {info.kind}", was_meant=False)
    joints = [t for t in episode.topics_of_type(schema.JOINT_STATE) if t.endswith(JOINT_STATES)]
    if info.kind == "imported":
        if episode.record(RECORD_NAME):
            return Prepared(why_not="replayed as an imported motion", was_meant=False)
        hint = f": {LABEL}" if joints else ""
        why_not = f"nobody said of which task it is a trial{hint}"
        return Prepared(why_not=why_not, was_meant=bool(joints))
    if is_planned:
        return None
    if not info.task:
        return Prepared(why_not=f"a trial of no task: {LABEL}")
    if not joints:
        return Prepared(
            why_not=f"neither plans nor joint states (a topic ending in {JOINT_STATES})"
        )
    try:
        urdf = read_robot(robot).description() if robot else streams.robot_description(episode)
        if urdf is None:
            known = f"record {ROBOT_DESCRIPTION}, attach robot.urdf, or name it: --robot FILE.toml"
            return Prepared(why_not=f"nobody said which robot it is; {known}")
        described = robot_of(urdf)
        check_joints(streams.joint_track(episode), f"episode {info.id}", described)
        width_track(episode, described)
    except GstError as error:
        return Prepared(why_not=str(error))
    return None if moved else Prepared(why_not="nothing moved: its joints stay where they were")


def there_already(
    jobs: Sequence[ReplayJob], *, force: bool
) -> tuple[list[dict[str, Any]], list[ReplayJob]]:
    """Rows of the replays that were made before, and the jobs that are still to do."""
    rows, todo, kept = [], [], list[Path]()
    for job in jobs:
        row = None if force else row_of_existing(job)
        if row is None:
            todo.append(job)
        else:
            rows.append(row)
            kept.append(job.path())
    _count_again(kept)
    return rows, todo


def _count_again(kept: Sequence[Path]) -> None:
    """Make kept files the newest of their trajectory, for the newest is the one that counts."""
    newest: dict[str, int] = {}
    for entry in os.scandir(kept[0].parent) if kept else ():
        trajectory = entry.name.rsplit(".", 3)[0]  # engine and settings are left out
        newest[trajectory] = max(newest.get(trajectory, 0), entry.stat().st_mtime_ns)
    for path in kept:
        with contextlib.suppress(OSError):  # a folder that is only read keeps its order
            if path.stat().st_mtime_ns < newest[path.name.rsplit(".", 3)[0]]:
                os.utime(path)


def runner_for(config: ReplayRunConfig) -> Runner:
    """What replays: this process, several, or a Ray cluster."""
    if config.ray:
        runner: Runner = load_leaf("cluster", "runner")(config.ray)
        return runner
    return runner_of(config.workers)


def replay_run(
    run: RunFolder,
    config: ReplayRunConfig,
    output: Output,
    imported: tuple[list[dict[str, Any]], dict[str, str]] = ([], {}),  # by ``replay_imported``
) -> dict[str, Any]:
    """Replay all trial episodes of a run; replays that are there already are kept.

    Returns ``rows`` (one per trajectory), ``counts`` per trajectory and mode, ``skipped_episodes``
    that could not be read and ``nothing_to_replay`` in others, with reasons, replays of
    ``imported`` recordings, what was said ``against_recorded`` labels, and the scene hash.
    """
    run.refuse_empty()
    with runner_for(config) as runner:
        scene_hash = _scene_hash(run, config, output)
        jobs, skipped, prepared = _all_jobs(run, scene_hash, config, runner, output)
        motions, unusable = imported
        skipped |= unusable
        _say_what_is_missing(run, jobs, output)
        if config.render:
            for note in describe_undrawn(run, _tasks(jobs)):
                output.say(note)
        rows, todo = there_already(jobs, force=config.force)
        if todo:
            refuse_full(run.derived_dir)  # and make it: each node is asked whether it is there
        told: set[tuple[str, str, str]] = set()  # one cause spoils all replays of a plan
        with output.progress("replay", len(todo)) as advance:
            for done, row in enumerate(_replayed(todo, runner, output), start=1):
                rows.append(row)
                advance(done, f"{row['episode']} {row['trajectory']} {row['mode']}")
                what = (row["episode"], row["plan"], row["error"])
                if row["error"] and what not in told:
                    told.add(what)
                    output.say(f"{row['episode']} {row['plan']}: not evaluated: {row['error']}")
        rows.sort(key=lambda row: (row["episode"], row["plan"], row["trajectory"], row["mode"]))
        labels = recorded_labels(run, sorted({row["episode"] for row in rows}))
        return {
            "run": str(run.path),
            "scene_hash": scene_hash,
            "counts": count_verdicts(rows),
            "against_recorded": against_recorded(rows, labels),
            "skipped_episodes": skipped,
            "nothing_to_replay": {
                name: each.why_not
                for name, each in prepared.items()
                if each.why_not and (each.was_meant or not (rows or motions))
            },
            "imported": motions,
            "rows": rows,
        }


def _all_jobs(
    run: RunFolder, scene_hash: str | None, config: ReplayRunConfig, runner: Runner, output: Output
) -> tuple[list[ReplayJob], dict[str, str], dict[str, Prepared]]:
    """List what is to be replayed, what cannot be read, and what there is of each other episode."""
    names = chosen_episodes(run, config)
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
    jobs: dict[str, Prepared] = {}
    skipped: dict[str, str] = {}
    with output.progress("localise", len(names)) as advance:
        answers = runner.run(jobs_of, items, Preparation.cost)
        for done, (item, answer) in enumerate(answers, start=1):
            if isinstance(answer, Failed):
                skipped[item.episode_id] = answer.message
                output.detail(answer.trace)
            else:
                jobs[item.episode_id] = answer
            advance(done, item.episode_id)
    for episode_id, reason in sorted(skipped.items()):
        output.say(f"{episode_id}: {reason}")
    found = [job for name in names if name in jobs for job in jobs[name].jobs]
    return found, skipped, {name: jobs[name] for name in names if name in jobs}


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
    for task in _tasks(jobs):
        try:
            notes = read_rebuilt_scene(run, task).notes
        except GstError:  # which each of its replays will say
            continue
        for note in notes:
            output.say(f"{task.name}: {note}")


def _tasks(jobs: Iterable[ReplayJob]) -> list[Task]:
    """The tasks that are replayed, each once: two versions of a file are two tasks."""
    found = sorted((job.task for job in jobs), key=lambda task: task.name)
    return [task for index, task in enumerate(found) if task not in found[:index]]


def chosen_episodes(run: RunFolder, config: ReplayRunConfig) -> list[str]:
    """Ids of the episodes that are wanted; all where none is named."""
    there = [path.stem for path in run.episodes()]
    unknown = [name for name in config.episode if name not in there]
    if unknown:
        raise UsageError(
            f"no episode named {', '.join(unknown)} in {run.episodes_dir}. "
            f"There are: {', '.join(there) or 'none'}."
        )
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


def describe_undrawn(run: RunFolder, tasks: Iterable[Task]) -> list[str]:
    """Name what no scan saw, and what pictures lack."""
    record = read_record(run) or {}
    library = Library.of(run, record)
    found = [note for task in tasks for note in library.notes(task)]
    robot = record.get("robot", {})
    if not robot.get("links"):
        reason = f" ({robot['remark']})" if robot.get("remark") else ""
        found.append(f"robot: not in the scene, not in pictures{reason}")
    return found
