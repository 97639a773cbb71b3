"""Small episodes with a plan that predicts objects, replays that move them, and localisations."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import small_plans

from bridge.episode import schema
from bridge.episode.cdr.messages import PoseSample
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.writer import EpisodeWriter
from bridge.geometry import se3
from bridge.task.plan import Plan, Stage

START_NS = 10_000_000_000
STEP_NS = 100_000_000
PLAN_ID = "p1"
IN_BOX_M = (0.5, 0.2, 0.026)
"""A cube of 40 mm on the box's floor of 6 mm."""


def posed(p_m: tuple[float, float, float], yaw_rad: float = 0.0) -> np.ndarray:
    q = np.array([np.cos(yaw_rad / 2), 0.0, 0.0, np.sin(yaw_rad / 2)])
    return se3.transform_from(q, np.array(p_m))


def pose_record(T: np.ndarray) -> dict[str, list[float]]:
    q, p = se3.split(T)
    return {"p_m": p.tolist(), "q_wxyz": q.tolist()}


def plan_of(stages: dict[str, dict[str, np.ndarray]]) -> Plan:
    """A plan whose stages predict these poses; each lasts a second."""
    return small_plans.plan_of(
        PLAN_ID,
        condition="with_replanning",
        stages=tuple(
            Stage(
                id=name,
                text=name,
                predicted_objects={key: pose_record(T) for key, T in poses.items()},
                t_start_ns=index * 10 * STEP_NS,
                t_end_ns=(index + 1) * 10 * STEP_NS,
            )
            for index, (name, poses) in enumerate(stages.items())
        ),
    )


@dataclass
class Seen:
    """What was localised: object, phase, pose or None, and perhaps its soft shape."""

    records: list[dict[str, Any]] = field(default_factory=list)

    def add(
        self,
        name: str,
        T: np.ndarray | None,
        *,
        phase: str = "end",
        extents_m: tuple[float, ...] | None = None,
    ) -> "Seen":
        stamp_ns = START_NS - STEP_NS if phase == "start" else START_NS + 100 * STEP_NS
        record: dict[str, Any] = {
            "schema_version": 1,
            "stamp_ns": stamp_ns,
            "object": name,
            "found": T is not None,
            "T_base_object": None if T is None else pose_record(T),
            "method": "test",
            "reason": None if T is not None else "hidden behind the box",
            "phase": phase,
            "plan_id": PLAN_ID if phase == "end" else None,
        }
        if extents_m is not None and T is not None:
            record["soft_shape"] = {
                "centroid_m": T[:3, 3].tolist(),
                "axes": np.eye(3).tolist(),
                "extents_m": list(extents_m),
                "extents_sigma_m": [0.005] * 3,
            }
        self.records.append(record)
        return self


def recorded_episode(
    path: Path,
    plan: Plan,
    *,
    task: str = "cube_into_box",
    condition: str = "with_replanning",
    tool_m: tuple[float, float, float] | None = (0.4, 0.0, 0.4),
    seen: Seen | None = None,
) -> Episode:
    """A recorded trial: its plan, when it was executed, where the tool ended."""
    with EpisodeWriter(path) as writer:
        writer.describe(EpisodeInfo(id=path.stem, kind="trial", task=task, condition=condition))
        data = plan.to_json()
        writer.write("/cell/plan", data, type_name=schema.PLAN, log_time_ns=START_NS - STEP_NS)
        for kind, stamp in (("execution_started", 0), ("execution_ended", 50 * STEP_NS)):
            _event(writer, kind, START_NS + stamp)
        if tool_m is not None:
            _pose(writer, "tcp", posed(tool_m), START_NS + 50 * STEP_NS)
        for record in [] if seen is None else seen.records:
            live = {key: value for key, value in record.items() if key not in ("phase", "plan_id")}
            _localisation(writer, live)
    return Episode.open(path)


def localised_episode(path: Path, seen: Seen) -> Episode:
    with EpisodeWriter(path) as writer:
        writer.describe(EpisodeInfo(id=path.stem, kind="trial"))
        for record in seen.records:
            _localisation(writer, record)
    return Episode.open(path)


def replay_episode(path: Path, plan: Plan, moved: dict[str, list[np.ndarray]]) -> Episode:
    """A replay: each object at the given poses, one for the end of each second from 0 on."""
    with EpisodeWriter(path) as writer:
        writer.describe(EpisodeInfo(id=path.stem, kind="trial"))
        for name, poses in moved.items():
            for second, T in enumerate(poses):
                _pose(writer, f"object/{name}", T, START_NS + second * 10 * STEP_NS)
        for stage in plan.stages:
            _event(writer, "stage_ended", START_NS + stage.t_end_ns, stage_id=stage.id)
    return Episode.open(path)


def _event(writer: EpisodeWriter, kind: str, stamp_ns: int, **fields: str) -> None:
    record = {"schema_version": 1, "stamp_ns": stamp_ns, "type": kind, "plan_id": PLAN_ID, **fields}
    writer.write("/cell/event", record, type_name=schema.EVENT, log_time_ns=stamp_ns)


def _localisation(writer: EpisodeWriter, record: dict[str, Any]) -> None:
    writer.write(
        "/cell/localisation",
        record,
        type_name=schema.LOCALISATION,
        log_time_ns=int(record["stamp_ns"]),
    )


def _pose(writer: EpisodeWriter, name: str, T: np.ndarray, stamp_ns: int) -> None:
    sample = PoseSample(stamp_ns=stamp_ns, frame_id="base_link", T_frame_body=T)
    writer.write(
        f"/cell/{name}/pose", sample.to_cdr(), type_name=schema.POSE_STAMPED, log_time_ns=stamp_ns
    )
