"""Is an episode whole? Every CRC, every record, every stream, and what it declares lost."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from bridge.episode import schema
from bridge.episode.reader import Episode, RawMessage
from bridge.episode.records import (
    CameraInfo,
    CompressedColor,
    DepthImage,
    JointSample,
    PoseSample,
    string_from_cdr,
    transforms_from_cdr,
)
from bridge.errors import BridgeError
from bridge.media.color import decode_color
from bridge.task.plan import Plan
from bridge.task.record import parse_record
from bridge.task.verdict import Verdict

MAX_LISTED = 20


@dataclass(kw_only=True)
class TopicCheck:
    """What was found on one topic."""

    messages: int = 0
    sequence_gaps: int = 0
    undecodable: int = 0
    first_fault: str = ""
    next_sequence: int | None = None


@dataclass(kw_only=True)
class CheckReport:
    """What was found in one file. ``exit_code``: 0 clean, 1 broken, 3 declared losses."""

    path: Path
    messages: int = 0
    topics: dict[str, TopicCheck] = field(default_factory=dict)
    faults: list[str] = field(default_factory=list)
    declared_losses: int = 0

    @property
    def exit_code(self) -> int:
        """Status of the ``check`` command."""
        if self.faults:
            return 1
        return 3 if self.declared_losses else 0

    @property
    def summary(self) -> str:
        """One word."""
        return {0: "clean", 1: "broken", 3: "losses declared"}[self.exit_code]


def check_episode(path: Path) -> CheckReport:
    """Read every message with CRCs on and decode every type this project knows."""
    report = CheckReport(path=path)
    try:
        episode = Episode.open(path)
        kind = episode.info.kind
        _ = episode.outcome, episode.derived  # raises when they cannot be read
        declared = {topic: item.count for topic, item in episode.topics().items()}
        for message in episode.messages():
            _check_message(report, message)
    except BridgeError as error:
        report.faults.append(str(error))
        return report
    _check_counts(report, declared)
    if kind != "imported":
        _check_contract(report, episode)
    _add_ledger(report, episode)
    return report


def _check_message(report: CheckReport, message: RawMessage) -> None:
    topic = report.topics.setdefault(message.topic, TopicCheck())
    topic.messages += 1
    report.messages += 1
    if topic.next_sequence is not None and message.sequence > topic.next_sequence:
        topic.sequence_gaps += message.sequence - topic.next_sequence
    topic.next_sequence = message.sequence + 1
    decode = _DECODERS.get(message.type_name)
    if decode is None:
        return
    try:
        decode(message.data)
    except BridgeError as error:
        topic.undecodable += 1
        if not topic.first_fault:
            topic.first_fault = f"{message.topic}: {error}"
            if len(report.faults) < MAX_LISTED:
                report.faults.append(topic.first_fault)


def _check_counts(report: CheckReport, declared: dict[str, int]) -> None:
    for topic, count in declared.items():
        found = report.topics[topic].messages if topic in report.topics else 0
        if found != count:
            report.faults.append(f"{topic}: the summary says {count} messages, {found} were read")


def _check_contract(report: CheckReport, episode: Episode) -> None:
    if "episode" not in episode.metadata_records:
        report.faults.append("no 'episode' metadata record: who made it and for what is unknown")
    for topic, item in episode.topics().items():
        expected = schema.type_of_topic(topic)
        if expected is not None and item.count and item.type_name not in (expected, ""):
            allowed = {expected, schema.COMPRESSED_IMAGE} if "/depth/image" in topic else {expected}
            if item.type_name not in allowed:
                report.faults.append(f"{topic} carries {item.type_name}, expected {expected}")


def _add_ledger(report: CheckReport, episode: Episode) -> None:
    for message in episode.messages(topic for topic in episode.topics_of_type(schema.DROPS)):
        try:
            record = parse_record(message.data, name="drops", package="bridge.episode")
        except BridgeError:
            continue  # already listed as undecodable
        report.declared_losses += record["gaps"] + record["queue_drops"]


_DECODERS: dict[str, Callable[[bytes], object]] = {
    schema.JOINT_STATE: JointSample.from_cdr,
    schema.COMPRESSED_IMAGE: lambda data: decode_color(CompressedColor.from_cdr(data).data),
    schema.IMAGE: DepthImage.from_cdr,
    schema.CAMERA_INFO: CameraInfo.from_cdr,
    schema.TF_MESSAGE: transforms_from_cdr,
    schema.POSE_STAMPED: PoseSample.from_cdr,
    schema.STRING: string_from_cdr,
    schema.PLAN: Plan.from_json,
    schema.VERDICT: Verdict.from_json,
    schema.LOCALISATION: lambda data: parse_record(data, name="localisation"),
    schema.EVENT: lambda data: parse_record(data, name="event", package="bridge.episode"),
    schema.DROPS: lambda data: parse_record(data, name="drops", package="bridge.episode"),
}
