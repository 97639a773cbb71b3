"""The CSV files of ``export csv``: which columns each has, what they mean, and their rows.

RFC 4180: comma, CRLF, quotes doubled. Times are whole nanoseconds and, beside them, seconds with
nine decimals. Numbers are the shortest decimals that read back as the same 64-bit number. An empty
field is unknown.
"""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from bridge.clock import NS_PER_S
from bridge.episode import schema
from bridge.episode.reader import RawMessage
from bridge.episode.records import JointSample, PoseSample
from bridge.geometry import se3
from bridge.task.record import parse_record
from bridge.task.verdict import Verdict

Value = str | int | float | bool | None
Rows = Iterator[tuple[int, list[Value]]]
"""Source time [ns] and the fields after the common ones."""

COMMON = {
    "file": "the episode file, relative to the run",
    "topic": "where it was published",
    "stamp_ns": "when it happened, the source's clock [ns]",
    "stamp_s": "the same in seconds, nine decimals",
    "log_ns": "when it was received [ns]",
}
_JOINT = {
    "joint": "name of the joint",
    "position": "[rad], or [m] for a sliding joint or a width",
    "velocity": "position per second; empty where it was not published",
    "effort": "[Nm], or [N]; empty where it was not published",
}
_POSE = {
    "frame": "the frame the pose is given in",
    **{f"{axis}_m": f"position along {axis} [m]" for axis in "xyz"},
    **{f"q{axis}": f"quaternion of the orientation, {axis}" for axis in "wxyz"},
}
_EVENT = {
    "type": "execution_started, execution_ended, stage_started, gripper, replan, label, mark ...",
    "plan_id": "the plan it belongs to",
    "stage_id": "the stage it belongs to",
    "text": "words of a mark or a label",
    "result": "success, failure or unknown, of a label",
    "k": "successes of a label",
    "n": "out of so many",
    "data": "whatever else was published, as JSON",
}
_FACTORS = ("ik", "clearance", "terminal")
_VERDICT = {
    "plan_id": "the plan judged",
    "trajectory": "planned or executed",
    "mode": "kinematic or dynamic",
    "accepted": "the product of the three factors; empty is undecided",
    **{
        name: meaning
        for factor in _FACTORS
        for name, meaning in (
            (factor, "true, false, or empty where undecided"),
            (f"{factor}_first_t_ns", "first failure, from the start of the trajectory [ns]"),
            (f"{factor}_cause", "why"),
        )
    },
    "p_success": "estimated probability of success",
    "p_low": "lower end of its interval",
    "p_high": "upper end of its interval",
    "engine": "physics engine",
    "seed": "its seed",
    "scene_hash": "the scene it was judged in",
    "reason": "why nothing could be decided",
}
_DROPS_COUNTS = ("received", "gaps", "queue_drops", "shed", "undecodable", "bytes")
_DROPS = {
    "of_topic": "the topic that is counted",
    "second": "which second of the recording",
    "received": "messages",
    "gaps": "messages missing by the source's count",
    "queue_drops": "messages that did not fit the recorder's queues",
    "shed": "messages left out on purpose under overload",
    "undecodable": "messages kept but not readable",
    "bytes": "received bytes",
}


@dataclass(frozen=True, kw_only=True)
class TableKind:
    """One CSV file: its columns and how a message becomes its rows."""

    name: str
    type_name: str
    columns: dict[str, str]
    """Column names and what they mean, after the common ones."""
    rows: Callable[[RawMessage], Rows]
    ending: str = ""
    """Only topics that end so."""
    not_ending: tuple[str, ...] = field(default=())

    def takes(self, topic: str, type_name: str) -> bool:
        """Say whether a topic's messages belong into this file."""
        return (
            type_name == self.type_name
            and topic.endswith(self.ending)
            and not topic.endswith(self.not_ending or ("\0",))
            and not schema.is_truth(topic)
        )


def _joints(message: RawMessage) -> Rows:
    sample = JointSample.from_cdr(message.data)
    for number, name in enumerate(sample.names):
        values: list[Value] = [name]
        for column in (sample.position, sample.velocity, sample.effort):
            values.append(float(column[number]) if number < len(column) else None)
        yield sample.stamp_ns, values


def _poses(message: RawMessage) -> Rows:
    sample = PoseSample.from_cdr(message.data)
    q, p = se3.split(sample.T_frame_body)
    yield sample.stamp_ns, [sample.frame_id, *map(float, p), *map(float, q)]


def _events(message: RawMessage) -> Rows:
    record = parse_record(message.data, name="event", package="bridge.episode")
    outcome = record.get("outcome") or {}
    data = record.get("data")
    yield (
        int(record["stamp_ns"]),
        [
            record["type"],
            record.get("plan_id"),
            record.get("stage_id"),
            record.get("text"),
            *(outcome.get(name) for name in ("result", "k", "n")),
            None if data is None else json.dumps(data, sort_keys=True, separators=(",", ":")),
        ],
    )


def _verdicts(message: RawMessage) -> Rows:
    verdict = Verdict.from_json(message.data)
    values: list[Value] = [verdict.plan_id, verdict.trajectory, verdict.mode, verdict.accepted]
    for name in _FACTORS:
        factor = getattr(verdict, name)
        values += [factor.value, factor.first_t_ns, factor.cause]
    p = verdict.p_success or {}
    values += [p.get("value"), p.get("low"), p.get("high")]
    values += [verdict.engine, verdict.seed, verdict.scene_hash, verdict.reason]
    yield message.publish_time_ns, values


def _drops(message: RawMessage) -> Rows:
    record = parse_record(message.data, name="drops", package="bridge.episode")
    counts = [record.get(name) for name in _DROPS_COUNTS]
    yield message.publish_time_ns, [record["topic"], record["second"], *counts]


TABLES = (
    TableKind(
        name="joints",
        type_name=schema.JOINT_STATE,
        columns=_JOINT,
        rows=_joints,
        not_ending=("/gripper/state",),
    ),
    TableKind(
        name="gripper",
        type_name=schema.JOINT_STATE,
        columns=_JOINT,
        rows=_joints,
        ending="/gripper/state",
    ),
    TableKind(name="poses", type_name=schema.POSE_STAMPED, columns=_POSE, rows=_poses),
    TableKind(name="events", type_name=schema.EVENT, columns=_EVENT, rows=_events),
    TableKind(name="verdicts", type_name=schema.VERDICT, columns=_VERDICT, rows=_verdicts),
    TableKind(name="drops", type_name=schema.DROPS, columns=_DROPS, rows=_drops),
)


def seconds_text(stamp_ns: int) -> str:
    """Seconds with nine decimals, exact."""
    sign, stamp_ns = ("-", -stamp_ns) if stamp_ns < 0 else ("", stamp_ns)
    seconds, rest = divmod(stamp_ns, NS_PER_S)
    return f"{sign}{seconds}.{rest:09d}"


def field_text(value: Value) -> str:
    """One field: empty for unknown, true or false, shortest exact decimals for numbers."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    return repr(value) if isinstance(value, float) else str(value)
