"""What one topic shows over a whole episode: numbers, times, rate, and whether it decodes."""

from array import array
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bridge.clock import NS_PER_S
from bridge.episode import schema
from bridge.episode.cdr import codec
from bridge.episode.cdr.images import check_image, image_header
from bridge.episode.cdr.messages import (
    CameraInfo,
    CompressedColor,
    DepthImage,
    JointSample,
    PoseSample,
    string_from_cdr,
    transforms_from_cdr,
)
from bridge.episode.contract import Presence, TopicReport
from bridge.episode.health import ContentWatch, HealthFinding, mixed_types, of_event
from bridge.episode.mcap.data_walk import ScannedMessage
from bridge.episode.schema import ROS_TYPES
from bridge.episode.topics import DEPTH_IMAGE, type_of_topic
from bridge.errors import BridgeError, MissingDependencyError
from bridge.task.plan import Plan
from bridge.task.record import parse_record
from bridge.task.verdict import Verdict


class Decoder:
    """Reads messages and forgets them, but for the drop log and the sizes of depth images.

    A topic of the contract must hold what ``docs/episode_format.md`` says. Any other topic of a
    known type need only be valid, and its images readable.
    """

    def __init__(self) -> None:
        """Start without a drop log."""
        self.drop_log: dict[str, int] = {}
        self.unnumbered: dict[str, int] = {}
        """By topic, messages without a number of their publisher's."""
        self.has_drop_log = False
        self.missing: set[str] = set()
        """Sentences on packages without which something was not decoded."""
        self.unused: dict[str, str] = {}
        """Type or encoding of topics that are kept, and that nothing here reads."""
        self.findings: list[HealthFinding] = []
        """What the recorder noticed of clocks, and of itself."""
        self._sizes: dict[str, dict[str, None]] = {}
        """By topic, the sizes of its images."""
        self._info_sizes: dict[str, str] = {}

    def decode(self, topic: str, message: ScannedMessage) -> None:
        """Read one message; raises BridgeError where it is not what topic and type promise."""
        type_name = message.schema.name if message.schema else ""
        encoding, data = message.channel.message_encoding, message.data
        known = schema.schema_for(type_name)
        if encoding == "cdr":
            codec.refuse_other_cdr(type_name, data)
        if encoding == "ros1":
            raise BridgeError("ROS 1 messages; convert the recording with rosbags-convert")
        if known is None or encoding not in ("", known.message_encoding):
            self.unused[topic] = type_name or encoding or "no type"
            return
        is_known = type_of_topic(topic) is not None or type_name == schema.IMAGE
        if type_name in ROS_TYPES and not is_known:
            codec.decode(type_name, data)
            return
        try:
            self._decode_contract(topic, type_name, data)
        except MissingDependencyError as error:
            self.missing.add(str(error))

    def _decode_contract(self, topic: str, type_name: str, data: bytes) -> None:
        if topic.endswith(DEPTH_IMAGE) and type_name in (schema.IMAGE, schema.COMPRESSED_IMAGE):
            before = next(iter(self._sizes.get(topic, ())), None)
            size = self._see_size(topic, DepthImage.from_message(type_name, data).depth_mm.shape)
            if before not in (None, size):
                found = f"a depth image of {size} after one of {before}"
                raise codec.MalformedMessageError(type_name=type_name, found=found)
        elif type_name == schema.IMAGE:
            header = image_header(data)
            check_image(topic, header)
            self._see_size(topic, (header.height, header.width))
        elif type_name == schema.COMPRESSED_IMAGE:
            self._see_size(topic, CompressedColor.from_cdr(data).decoded().shape)
        elif type_name == schema.CAMERA_INFO:
            camera = CameraInfo.from_cdr(data).camera
            self._info_sizes[topic] = f"{camera.width} x {camera.height}"
        elif type_name == schema.DROPS:
            self._add_losses(parse_record(data, name="drops", package="bridge.episode"))
        elif type_name == schema.EVENT:
            self.findings += of_event(parse_record(data, name="event", package="bridge.episode"))
        elif type_name in _DECODERS:
            _DECODERS[type_name](data)
        elif type_name in ROS_TYPES:
            codec.decode(type_name, data)

    def _add_losses(self, record: dict[str, Any]) -> None:
        self.has_drop_log = True
        lost = record["gaps"] + record["queue_drops"] + record.get("shed", 0)
        topic = record["topic"]
        self.drop_log[topic] = self.drop_log.get(topic, 0) + lost
        unnumbered = self.unnumbered.get(topic, 0) + record.get("unnumbered", 0)
        if unnumbered:
            self.unnumbered[topic] = unnumbered

    def _see_size(self, topic: str, shape: tuple[int, ...]) -> str:
        size = f"{shape[1]} x {shape[0]}"
        self._sizes.setdefault(topic, {})[size] = None
        return size

    def size_faults(self) -> list[str]:
        """Sentences on images that are not of the size their camera info says."""
        return [
            f"{topic}: images of {size}, its camera info says {said}"
            for topic, sizes in self._sizes.items()
            if (said := self._info_sizes.get(topic.removesuffix("image") + "info")) is not None
            for size in sizes
            if size != said
        ]


_DECODERS: dict[str, Callable[[bytes], object]] = {
    schema.JOINT_STATE: JointSample.from_cdr,
    schema.TF_MESSAGE: transforms_from_cdr,
    schema.POSE_STAMPED: PoseSample.from_cdr,
    schema.STRING: string_from_cdr,
    schema.PLAN: Plan.from_json,
    schema.VERDICT: Verdict.from_json,
    schema.CONTACT: lambda data: parse_record(data, name="contact"),
    schema.DIVERGENCE: lambda data: parse_record(data, name="divergence"),
    schema.LOCALISATION: lambda data: parse_record(data, name="localisation"),
    schema.CLOCKS: lambda data: parse_record(data, name="clocks", package="bridge.episode"),
}


YEAR_NS = 31_556_952 * NS_PER_S
LATEST_NS, MOST_YEARS = 230 * YEAR_NS, 10
"""No recorder of today says later, or records for so long."""
_WRAP = 1 << 32
_FAR_BACK = 32
"""A number so far behind the one before it is none that came late: its publisher began anew."""


def missing_numbers(sequences: array) -> int:  # type: ignore[type-arg]
    """Count missing sequence numbers; a late one is not missing, and a restart is no gap."""
    numbers = np.array(sequences, dtype=np.int64)
    steps = (np.diff(numbers) + _WRAP // 2) % _WRAP - _WRAP // 2
    places = np.cumsum(np.concatenate([numbers[:1], steps]))
    runs = np.split(places, np.flatnonzero(steps < -_FAR_BACK) + 1)
    return sum(int(np.ptp(run)) + 1 - len(np.unique(run)) for run in runs if len(run))


@dataclass(kw_only=True)
class TopicCheck:
    """What was found on one topic."""

    messages: int = 0
    type_name: str = ""
    rate_hz: float = 0.0
    """Mean over the topic's own time, 0 for fewer than two messages."""
    sequence_gaps: int = 0
    """Numbers missing between those that are there."""
    declared_losses: int = 0
    """Gaps, queue drops and shed messages the drop log lists."""
    time_steps_back: int = 0
    """Messages whose log time is before that of the one before."""
    undecodable: int = 0
    first_fault: str = ""
    unnumbered: int = 0
    """Messages that carry no number, so that losses among them cannot be seen."""
    presence: TopicReport | None = None
    """When it was there, and what its contract says of that; of recordings only."""


@dataclass(kw_only=True)
class TopicWatch:
    """Follows one topic through an episode."""

    topic: str
    result: TopicCheck = field(default_factory=TopicCheck)
    contents: dict[str, ContentWatch] = field(default_factory=dict)
    """By type."""
    odd: list[int] = field(default_factory=list)
    """When messages came whose times cannot be."""
    sequences: array = field(  # type: ignore[type-arg]
        default_factory=lambda: array("L")
    )
    presence: Presence = field(default_factory=Presence)
    last_ns: dict[int, int] = field(default_factory=dict)
    """By channel: two definitions of a topic may lie in different chunks, in another order."""

    def see(self, message: ScannedMessage, decoder: Decoder) -> None:
        """Take the next message in the order of the file."""
        head, result = message.head, self.result
        result.messages += 1
        name = result.type_name = message.schema.name if message.schema else ""
        content = self.contents.get(name)
        if content is None:
            content = self.contents[name] = ContentWatch(self.topic, name)
        if content.is_of_use:
            content.see(message.data, head.log_time_ns)
        if max(head.log_time_ns, head.publish_time_ns) > LATEST_NS:
            self.odd.append(head.log_time_ns)
        self.sequences.append(head.sequence)
        if head.log_time_ns < self.last_ns.get(head.channel_id, 0):
            result.time_steps_back += 1
        self.last_ns[head.channel_id] = head.log_time_ns
        self.presence.see(head.log_time_ns)
        try:
            decoder.decode(self.topic, message)
        except BridgeError as error:
            result.undecodable += 1
            if not result.first_fault:
                result.first_fault = str(error)

    def findings(self, *, is_derived: bool) -> Iterator[HealthFinding]:
        """What its messages hold; a replay may stand still, and its images with it."""
        for content in () if is_derived else self.contents.values():
            yield from content.findings.values()
        span = {"first_ns": self.presence.first_ns, "last_ns": self.presence.last_ns}
        yield from mixed_types(self.topic, self.contents, **span)
        years = (span["last_ns"] - span["first_ns"]) // YEAR_NS
        if self.odd or years > MOST_YEARS:
            text = f"{len(self.odd)} times after the year 2200" if self.odd else f"{years} years"
            yield HealthFinding(name="odd_times", about=self.topic, text=text, **span)

    def finish(self) -> TopicCheck:
        """Work out what needs all messages."""
        result = self.result
        result.sequence_gaps = missing_numbers(self.sequences)
        span_s = (self.presence.last_ns - self.presence.first_ns) * 1e-9
        if result.messages > 1 and span_s > 0:
            result.rate_hz = (result.messages - 1) / span_s
        return result
