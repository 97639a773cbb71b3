"""One side of the comparison, recorded or replayed: series, paths, objects and what was said."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import rerun as rr
from jaxtyping import Int

from bridge.geometry.trajectory import PoseTrajectory
from bridge.task.task_file import Task
from bridge.task.verdict import Verdict
from dashboards.recording import Recording
from dashboards.rerun_entities import log_object, model_of
from dashboards.rerun_file import RerunFile
from dashboards.wording import factor_word, verdict_word

GOOD, WARN = "INFO", "WARN"
MIN_CLEARANCE = "clearance_m"
PATH_RADIUS_M = 0.0025
AXES_M = 0.05
RECORDED_WIDTH, REPLAYED_WIDTH = 3.0, 1.5
"""Points; a replay stays visible on the recorded line."""
JOINT_COLORS = (
    *((31, 119, 180), (255, 127, 14), (44, 160, 44)),
    *((214, 39, 40), (148, 103, 189), (140, 86, 75)),
)


@dataclass(frozen=True, kw_only=True)
class Side:
    """Where one recording goes in the view."""

    prefix: str
    """Its entities start with this: ``recorded``, ``replayed/planned/dynamic``."""
    recording: Recording
    color: tuple[int, int, int]
    place_ns: Callable[[Int[np.ndarray, " num_stamps"]], Int[np.ndarray, " num_stamps"]]
    """Carries its stamps to the recorded cell's source time [ns]."""

    @property
    def name(self) -> str:
        """What a legend says: ``recorded``, ``planned dynamic``."""
        return self.prefix.removeprefix("replayed/").replace("/", " ")

    @property
    def width(self) -> float:
        """Width of its lines [points]."""
        return RECORDED_WIDTH if self.recording.derived is None else REPLAYED_WIDTH


def log_side(file: RerunFile, side: Side, task: Task | None) -> None:
    """Log everything of one recording that is a number over time, a pose or a sentence."""
    _log_series(file, side)
    _log_tool(file, side)
    for name, track in side.recording.objects.items():
        entity = f"{side.prefix}/objects/{name}"
        log_object(file, entity, _placed(side, track), model_of(task, name), solid=False)
    _log_said(file, side)
    for problem in side.recording.problems:
        file.note(f"{side.recording.path.name}: {problem}")


def _log_series(file: RerunFile, side: Side) -> None:
    recording, prefix = side.recording, side.prefix
    if recording.joints is not None:
        stamps = side.place_ns(recording.joints.stamps_ns)
        for index, name in enumerate(recording.joints.names):
            file.scalars(
                f"{prefix}/joints/{name}",
                stamps,
                recording.joints.position[:, index],
                name=f"{name}, {side.name}",
                color=JOINT_COLORS[index % len(JOINT_COLORS)],
                width=side.width,
            )
    for leaf, track in (
        ("gripper_width_m", recording.widths),
        (MIN_CLEARANCE, recording.clearance),
    ):
        if track is not None:
            file.scalars(
                f"{prefix}/{leaf}",
                side.place_ns(track.stamps_ns),
                track.position[:, 0],
                name=side.name,
                color=side.color,
                width=side.width,
            )


def _log_tool(file: RerunFile, side: Side) -> None:
    if side.recording.tcp is None:
        return
    track = _placed(side, side.recording.tcp)
    entity = f"{side.prefix}/tcp"
    file.poses(entity, track)
    file.rows(entity, track.stamps_ns[:1], rr.TransformAxes3D.columns(axis_length=[AXES_M]))
    strip = rr.LineStrips3D([track.p_m], radii=[PATH_RADIUS_M], colors=[side.color])
    file.always(f"{side.prefix}/tcp_path", strip)


def _placed(side: Side, track: PoseTrajectory) -> PoseTrajectory:
    return PoseTrajectory(side.place_ns(track.stamps_ns), track.p_m, track.q_wxyz)


def _log_said(file: RerunFile, side: Side) -> None:
    recording, prefix = side.recording, side.prefix
    said = [(int(event["stamp_ns"]), event_text(event), GOOD) for event in recording.events]
    _log_text(file, side, f"{prefix}/events", said)
    verdicts = [
        (stamp, verdict_text(verdict), GOOD if verdict.accepted else WARN)
        for stamp, verdict in recording.verdicts
    ]
    _log_text(file, side, f"{prefix}/verdicts", verdicts)
    stages = [(e["stamp_ns"], e["stage_id"]) for e in recording.events if _starts_stage(e)]
    ends = [(e["stamp_ns"], None) for e in recording.events if e["type"] == "execution_ended"]
    if stages:
        states = sorted([*stages, *ends], key=lambda state: state[0])
        stamps = side.place_ns(np.array([stamp for stamp, _ in states], dtype=np.int64))
        names = [name if name is not None else "ended" for _, name in states]
        file.rows(f"{prefix}/stage", stamps, rr.StateChange.columns(state=names))


def _starts_stage(event: dict[str, Any]) -> bool:
    return event["type"] == "stage_started" and bool(event.get("stage_id"))


def _log_text(file: RerunFile, side: Side, entity: str, said: list[tuple[int, str, str]]) -> None:
    if said:
        stamps = side.place_ns(np.array([stamp for stamp, _, _ in said], dtype=np.int64))
        columns = rr.TextLog.columns(
            text=[text for _, text, _ in said], level=[level for _, _, level in said]
        )
        file.rows(entity, stamps, columns)


def event_text(event: dict[str, Any]) -> str:
    """Write an event as one line: what happened, to which stage and plan, and the remark."""
    parts = [str(event["type"]).replace("_", " ")]
    parts += [str(event[name]) for name in ("stage_id", "plan_id") if event.get(name)]
    text = ", ".join(parts)
    return f"{text}: {event['text']}" if event.get("text") else text


def verdict_text(verdict: Verdict) -> str:
    """Write a verdict as one line, with the first factor that fails and why."""
    text = f"{verdict_word(verdict.accepted)}: {verdict.plan_id}, {verdict.trajectory}"
    text += f", {verdict.mode}, {verdict.engine}"
    name = verdict.first_failing
    if name is not None:
        factor = getattr(verdict, name)
        why = factor.detail or factor.cause
        text += f"; {name} {factor_word(factor)}" + (f" ({why})" if why else "")
    elif verdict.accepted is None and verdict.reason:
        text += f"; {verdict.reason}"
    return text
