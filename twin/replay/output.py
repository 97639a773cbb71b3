"""A replay as a derived episode, in the schema a recording has."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Int

from bridge.episode import schema
from bridge.episode import topics as named
from bridge.episode.cdr.batch import joint_writer, pose_messages
from bridge.episode.cdr.messages import CompressedColor, PointCloudSample, string_to_cdr
from bridge.episode.executions import NO_PLAN
from bridge.episode.metadata import Derived, EpisodeInfo
from bridge.episode.writer import EpisodeWriter
from bridge.robots.robot import GRIPPER_WIDTH, robot_of
from bridge.task.plan import Plan, Stage
from twin.replay.clearance.bodies import GRIPPER
from twin.replay.result import ReplayResult, stretches_ns

MIN_CLEARANCE = "min_clearance_m"
NODES_PERIOD_NS = 33_000_000
"""Nodes of soft bodies are written at most this often: 30 Hz, about a camera's rate."""


class _Message(NamedTuple):
    stamp_ns: int
    topic: str
    type_name: str
    data: bytes


@dataclass(frozen=True, kw_only=True)
class ReplayOrigin:
    """Where a replay comes from and when its time 0 is."""

    info: EpisodeInfo
    """Of the recorded episode."""
    derived: Derived
    cell: str
    start_ns: int
    """Source time of the recorded execution's start, or of the plan when it was never executed."""
    urdf: str
    stages: tuple[Stage, ...]
    """With the times at which they were executed: the plan's, or the execution's."""
    end_ns: int
    """When, from time 0, the trajectory ended and settling began."""
    divergence: Mapping[str, Any] | None = None
    """The gst divergence v1 record, where there was something to compare with."""
    images: tuple[tuple[str, CompressedColor], ...] = ()
    """Rendered images by camera id."""


def write_replay(path: Path, result: ReplayResult, plan: Plan, origin: ReplayOrigin) -> Path:
    """Write one replay; the writer replaces a part file that an interrupted run left."""
    messages = [*_messages(result, plan, origin), *_events(result, plan, origin)]
    with EpisodeWriter(path) as writer:
        writer.describe(origin.info, derived=origin.derived)
        for message in sorted(messages, key=itemgetter(0)):
            writer.write(
                message.topic,
                message.data,
                type_name=message.type_name,
                log_time_ns=message.stamp_ns,
            )
    return path


def _messages(result: ReplayResult, plan: Plan, origin: ReplayOrigin) -> Iterator[_Message]:
    prefix, start = f"/{origin.cell}", origin.start_ns
    robot = robot_of(origin.urdf)
    yield _Message(start, named.ROBOT_DESCRIPTION, schema.STRING, string_to_cdr(origin.urdf))
    if plan.id != NO_PLAN:
        yield _Message(start, f"{prefix}{named.PLAN}", schema.PLAN, plan.to_json())
    stamps = start + result.stamps_ns
    for topic, names, values in (
        (named.JOINT_STATES, robot.joints, result.joints_rad),
        (named.GRIPPER_STATE, (GRIPPER_WIDTH,), result.width_m[:, None]),
        (named.CLEARANCE, (MIN_CLEARANCE,), result.clearance_m[:, None]),
    ):
        rows: Iterator[bytes] = map(joint_writer(names), stamps.tolist(), values.tolist())
        yield from _stamped(stamps, f"{prefix}{topic}", schema.JOINT_STATE, rows)
    poses = {f"{prefix}{named.TCP_POSE}": result.Ts_base_tcp} | {
        named.object_topic(origin.cell, name, "pose"): Ts
        for name, Ts in result.Ts_base_object.items()
    }
    for topic, Ts in poses.items():
        rows = pose_messages(stamps, robot.base_frame, Ts)
        yield from _stamped(stamps, topic, schema.POSE_STAMPED, rows)
    yield from _nodes(result, origin.cell, start, robot.base_frame)
    yield from _contacts(result, prefix, start)
    for camera_id, image in origin.images:
        topic = named.camera_topic(origin.cell, camera_id, named.RENDERED_IMAGE)
        yield _Message(image.stamp_ns, topic, schema.COMPRESSED_IMAGE, image.to_cdr())
    end = start + int(result.stamps_ns[-1])
    yield _Message(end, f"{prefix}{named.VERDICT}", schema.VERDICT, result.verdict.to_json())
    if origin.divergence is not None:
        data = json.dumps(origin.divergence, separators=(",", ":")).encode()
        yield _Message(end, f"{prefix}{named.DIVERGENCE}", schema.DIVERGENCE, data)


def _nodes(result: ReplayResult, cell: str, start_ns: int, frame_id: str) -> Iterator[_Message]:
    for name, nodes in result.nodes_m.items():
        due_ns = 0
        for t_ns, points in zip(result.stamps_ns.tolist(), nodes, strict=True):
            if t_ns < due_ns:
                continue
            due_ns = t_ns + NODES_PERIOD_NS
            sample = PointCloudSample(stamp_ns=start_ns + t_ns, frame_id=frame_id, points_m=points)
            topic = named.object_topic(cell, name, "nodes")
            yield _Message(sample.stamp_ns, topic, schema.POINT_CLOUD, sample.to_cdr())


def _contacts(result: ReplayResult, prefix: str, start_ns: int) -> Iterator[_Message]:
    """Measured distances below the margin, and what physics says of the fingers."""
    spans: list[tuple[Any, ...]] = [
        (near.start_ns, near.end_ns, near.bodies, near.allowed, near.min_distance_m, "distance")
        for near in result.contacts or ()
    ]
    for name, touches in result.finger_contact.items():
        for first_ns, last_ns in stretches_ns(result.stamps_ns, touches):
            spans.append((first_ns, last_ns, (GRIPPER, name), None, None, "physics"))
    for first_ns, last_ns, bodies, allowed, min_distance_m, source in spans:
        record = {
            "schema_version": 1,
            "stamp_ns": start_ns + first_ns,
            "end_ns": start_ns + last_ns,
            "bodies": list(bodies),
            "allowed": allowed,
            "min_distance_m": min_distance_m,
            "source": source,
        }
        data = json.dumps(record, separators=(",", ":")).encode()
        yield _Message(start_ns + first_ns, f"{prefix}{named.CONTACT}", schema.CONTACT, data)


def _stamped(
    stamps_ns: Int[np.ndarray, " num_steps"], topic: str, type_name: str, rows: Iterator[bytes]
) -> Iterator[_Message]:
    for stamp_ns, data in zip(stamps_ns.tolist(), rows, strict=True):
        yield _Message(stamp_ns, topic, type_name, data)


def _events(result: ReplayResult, plan: Plan, origin: ReplayOrigin) -> Iterator[_Message]:
    """Events: execution and stages."""
    topic = named.cell_topic(origin.cell, named.EVENT)
    end_ns = int(result.stamps_ns[-1])
    events: list[tuple[int, dict[str, object]]] = [(0, {"type": "execution_started"})]
    for stage in origin.stages:
        if stage.t_start_ns <= end_ns:
            events.append((stage.t_start_ns, {"type": "stage_started", "stage_id": stage.id}))
        if stage.t_end_ns <= end_ns:
            events.append((stage.t_end_ns, {"type": "stage_ended", "stage_id": stage.id}))
    events.append((min(end_ns, origin.end_ns), {"type": "execution_ended"}))
    for t_ns, fields in sorted(events, key=lambda event: event[0]):
        stamp = origin.start_ns + t_ns
        record = {"schema_version": 1, "stamp_ns": stamp, "plan_id": plan.id, **fields}
        yield _Message(stamp, topic, schema.EVENT, json.dumps(record).encode())
