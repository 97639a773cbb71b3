"""What a run's trials weighed: the objects that were held, by the joint efforts of each trial.

While the fingers are closed, and the tool is away from where they closed and from where they open,
efforts say what the object of that grasp weighs (``held_mass``). What trials say of one object is
taken together; where they do not agree, it is not used.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from itertools import combinations
from typing import Any

import numpy as np
from scipy.stats import chi2

from bridge.episode import provenance, schema, streams
from bridge.episode.cdr.messages import JointSample
from bridge.episode.executions import executed_events
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.topics import JOINT_STATES
from bridge.errors import GstError, UsageError
from bridge.robots.robot import Robot
from bridge.task.task_file import Task
from twin.calibrate.held_mass import LEVER, Moved, NoWeightError, Which, smoothed, weight_of
from twin.calibrate.motion import Z_95
from twin.replay.execution import stages_as_executed
from twin.replay.grasps import grasped
from twin.replay.observed import find_grips
from twin.replay.rebuilt_scene import MASSES
from twin.robot.model import RobotModel, load_robot
from twin.robot.posture import width_track
from twin.scene.store.calibration import write_part

NEAR_M, ABOVE_M = 0.05, 0.03
"""So far on the hand touches nothing any more, and the object has left what it stood on."""
BEFORE_S, AFTER_S = 0.1, 0.5
"""Left out about a grasp, while the fingers move."""
AGREE = 0.99
"""Of a chi-square distribution: trials that differ by more did not weigh the same thing."""


def calibrate_weights(run: RunFolder) -> tuple[dict[str, Any], str]:
    """Weigh what trials held and write it; UsageError, with the reasons, where none says it."""
    rows, reasons, tasks = list[dict[str, Any]](), dict[str, str](), dict[str, Task]()
    for path in run.episodes():
        try:
            episode = Episode.open(path)
            if episode.info.kind == "trial":
                task = streams.task_file(episode).task()
                tasks[task.name] = task
                rows += weighed(episode, task)
        except GstError as error:
            reasons[path.stem] = str(error)
    if not rows:
        why = "; ".join(f"{name}: {reason}" for name, reason in reasons.items())
        raise UsageError(f"no trial of {run.path} says what it held. {why}".rstrip())
    found: dict[str, dict[str, Any]] = {}
    for name in sorted({row["task"] for row in rows}):
        mine = [row for row in rows if row["task"] == name]
        objects = sorted({row["object"] for row in mine})
        found[name] = {
            key: together([row for row in mine if row["object"] == key]) for key in objects
        }
    notes = [note for name, objects in found.items() for note in unlike(tasks[name], objects)]
    record: dict[str, Any] = {"tasks": found, "notes": notes, "not_determined": reasons}
    record["id"] = provenance.hash_settings(record)
    return record, str(write_part(run, MASSES, record)["calibration_id"])


def weighed(episode: Episode, task: Task) -> list[dict[str, Any]]:
    """What each grasp of a trial says; NoWeightError, with the reasons, where none says anything.

    Seconds count from the episode's first sample.
    """
    urdf = streams.robot_description(episode)
    if urdf is None:
        raise NoWeightError("no robot description was recorded")
    robot, rows, reasons = load_robot(urdf), list[dict[str, Any]](), list[str]()
    stamps_ns, joints, efforts = _readings(episode, robot.record)
    begun_ns = streams.first_stamp_ns(episode) or 0
    moved = smoothed((stamps_ns - begun_ns) * 1e-9, joints, efforts)
    free, grips = _when(episode, robot, moved, begun_ns)
    for held_s, held in grips:
        try:
            name = _object_at(episode, task, begun_ns + round(held_s * 1e9))
            weight = asdict(weight_of(robot, moved, free, held))
        except NoWeightError as error:
            reasons.append(str(error))
            continue
        from_s, to_s = moved.times_s[held][[0, -1]].round(2).tolist()
        source = {"episode": episode.info.id, "sha256": episode.sha256()}
        rows.append({"task": task.name, "object": name, **source, "from_s": from_s, "to_s": to_s})
        rows[-1] |= weight
    if not rows:
        raise NoWeightError("; ".join(reasons) or "the fingers close on nothing")
    return rows


def _readings(episode: Episode, robot: Robot) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stamps, joints and efforts of an arm; no efforts where those of a joint are missing."""
    topics = [t for t in episode.topics_of_type(schema.JOINT_STATE) if t.endswith(JOINT_STATES)]
    samples = [JointSample.from_cdr(message.data) for message in episode.messages(topics)]
    samples = [s for s in samples if set(robot.joints) <= set(s.names) and len(s.position)]
    with_efforts = [s for s in samples if len(s.effort) == len(s.names)]
    if not with_efforts:
        raise NoWeightError("no efforts of the arm's joints were recorded")
    rows = {s.stamp_ns: (s, [s.names.index(name) for name in robot.joints]) for s in with_efforts}
    stamps = sorted(rows)
    values = [(rows[at][0].position[rows[at][1]], rows[at][0].effort[rows[at][1]]) for at in stamps]
    joints, efforts = np.swapaxes(np.array(values), 0, 1)
    return np.array(stamps, dtype=np.int64), joints, efforts


def _when(
    episode: Episode, robot: RobotModel, moved: Moved, begun_ns: int
) -> tuple[Which, list[tuple[float, Which]]]:
    """When the arm moves freely; and of each grasp when it holds [s], and when it carries."""
    widths, times_s = width_track(episode, robot.record), moved.times_s
    p_tool_m = robot.Ts_base_tcp(moved.joints[0])[:, :3, 3]
    free, found = np.ones(len(times_s), dtype=bool), []
    for grip in find_grips(widths.stamps_ns, widths.position[:, 0]):
        closing_s, held_s, opening_s = ((at_ns - begun_ns) * 1e-9 for at_ns in grip)
        held = (times_s >= held_s) & (times_s <= opening_s)
        if not held.any():
            continue
        ends_m = p_tool_m[np.flatnonzero(held)[[0, -1]]]
        away = np.linalg.norm(p_tool_m[:, None] - ends_m, axis=2).min(axis=1) > NEAR_M
        free &= away & ((times_s < closing_s - BEFORE_S) | (times_s > opening_s + AFTER_S))
        found.append((held_s, held & away & (p_tool_m[:, 2] > ends_m[0, 2] + ABOVE_M)))
    return free, found


def _object_at(episode: Episode, task: Task, at_ns: int) -> str:
    """What is grasped at an instant, by a plan's stages; else the only one that the task moves."""
    events = executed_events(episode)
    for _, plan in streams.plans(episode):
        start_ns, end_ns = streams.execution_ns(events, plan.id)
        if start_ns is not None and end_ns is not None and start_ns <= at_ns <= end_ns:
            stages = stages_as_executed(plan, events, start_ns)
            name = grasped(replace(plan, stages=stages), at_ns - start_ns)
            if name in task.objects:
                return name
    if len(task.manipulated) != 1:
        raise NoWeightError("nobody said which object was grasped")
    return task.manipulated[0]


def together(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """What trials say of one object: ``value``, its interval, and ``why`` it is not used."""
    masses = np.array([row["mass_kg"] for row in rows])
    weights = (np.array([row["half_kg"] for row in rows]) / Z_95) ** -2.0
    value = float(np.average(masses, weights=weights))
    half = Z_95 * float(max(weights.sum() ** -0.5, LEVER * value))
    apart = float((weights * (masses - value) ** 2).sum()) > chi2.ppf(AGREE, len(rows) - 1)
    why = ""
    if apart:
        said = ", ".join(f"{row['mass_kg']:.3f} kg in {row['episode']}" for row in rows)
        why = f"trials do not agree ({said}): another object, or its look-alike, was held"
    ends = {"low": value - half, "high": value + half, "unit": "kg", "why": why}
    return {"value": value, **ends, "sigma_log": half / Z_95 / value, "sources": list(rows)}


def unlike(task: Task, found: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Name objects of a task that look alike and do not weigh the same."""
    notes = []
    for one, other in combinations(found, 2):
        first, second = (replace(task.objects[key], id="", mass_kg=0.0) for key in (one, other))
        a, b = found[one], found[other]
        if first == second and (a["high"] < b["low"] or b["high"] < a["low"]):
            notes.append(
                f"{one} and {other} of {task.name} look alike and weigh {a['value']:.3f} and "
                f"{b['value']:.3f} kg: where they are mixed up, so are their masses"
            )
    return notes


def describe_weights(record: Mapping[str, Any], calibration_id: str) -> str:
    """Say what each object weighs, and from which seconds of which episodes."""
    lines = [f"masses: calibration {calibration_id}"]
    for task, objects in record["tasks"].items():
        for name, item in objects.items():
            ends = f"[{item['low']:.3f}, {item['high']:.3f}] kg"
            used = f"not used: {item['why']}" if item["why"] else "replays and the gate use it"
            lines.append(f"  {task} {name}: {item['value']:.3f} {ends}, {used}")
            lines += [f"    {_source(row)}" for row in item["sources"]]
    return "\n".join(
        [
            *lines,
            *(f"  {note}" for note in record["notes"]),
            *(f"  {key}: not determined: {why}" for key, why in record["not_determined"].items()),
        ]
    )


def _source(row: Mapping[str, Any]) -> str:
    centre = ", ".join(
        f"{1e3 * value:.0f} +- {1e3 * half:.0f}"
        for value, half in zip(row["centre_m"], row["centre_half_m"], strict=True)
    )
    return (
        f"{row['episode']}, {row['from_s']:.2f} to {row['to_s']:.2f} s: {row['mass_kg']:.3f} +- "
        f"{row['half_kg']:.3f} kg, centre ({centre}) mm from the tool"
    )
