"""Decode every message of a kind this project knows, as strictly as the file promised."""

from collections.abc import Callable
from typing import Any

from bridge.episode import cdr, schema
from bridge.episode.check_file import ScannedMessage
from bridge.episode.records import (
    CameraInfo,
    CompressedColor,
    DepthImage,
    JointSample,
    PoseSample,
    string_from_cdr,
    transforms_from_cdr,
)
from bridge.episode.ros2_definitions import DEFINITIONS
from bridge.episode.video import VideoFrame
from bridge.errors import MissingDependencyError
from bridge.media.color import decode_color
from bridge.task.plan import Plan
from bridge.task.record import parse_record
from bridge.task.verdict import Verdict


class Decoder:
    """Reads messages and forgets them, but for the ledger and the sizes of depth images.

    A topic of the contract must hold what ``docs/episode_format.md`` says. Any other topic of a
    known type need only be valid: a camera of another maker may send raw colour or a distorted
    lens.
    """

    def __init__(self) -> None:
        """Start without a ledger."""
        self.ledger: dict[str, int] = {}
        """Losses declared by topic."""
        self.has_ledger = False
        self.missing: set[str] = set()
        """Sentences on packages without which something was not decoded."""
        self._depth_sizes: dict[str, tuple[int, int]] = {}
        self._info_sizes: dict[str, tuple[int, int]] = {}

    def decode(self, topic: str, message: ScannedMessage) -> None:
        """Read one message.

        Raises:
            BridgeError: When it is not what its topic and type promise.
        """
        type_name = message.schema.name if message.schema else ""
        encoding, data = message.channel.message_encoding, message.data
        known = schema.schema_for(type_name)
        if known is None or encoding not in ("", known.message_encoding):
            return
        if schema.type_of_topic(topic) is None and type_name in DEFINITIONS:
            cdr.validate(type_name, data)
            return
        try:
            self._decode_contract(topic, type_name, data)
        except MissingDependencyError as error:
            self.missing.add(str(error))

    def _decode_contract(self, topic: str, type_name: str, data: bytes) -> None:
        if topic.endswith("/depth/image") and type_name in (schema.IMAGE, schema.COMPRESSED_IMAGE):
            height, width = DepthImage.from_message(type_name, data).depth_mm.shape
            before = self._depth_sizes.setdefault(topic, (width, height))
            if before != (width, height):
                found = (
                    f"a depth image of {width} x {height} after one of {before[0]} x {before[1]}"
                )
                raise cdr.MalformedMessageError(type_name=type_name, found=found)
        elif type_name == schema.IMAGE:
            cdr.validate(type_name, data)
        elif type_name == schema.CAMERA_INFO:
            camera = CameraInfo.from_cdr(data).camera
            self._info_sizes[topic] = (camera.width, camera.height)
        elif type_name == schema.DROPS:
            self._add_losses(parse_record(data, name="drops", package="bridge.episode"))
        elif type_name in _DECODERS:
            _DECODERS[type_name](data)
        elif type_name in DEFINITIONS:
            cdr.validate(type_name, data)

    def _add_losses(self, record: dict[str, Any]) -> None:
        self.has_ledger = True
        lost = record["gaps"] + record["queue_drops"] + record.get("shed", 0)
        self.ledger[record["topic"]] = self.ledger.get(record["topic"], 0) + lost

    def size_faults(self) -> list[str]:
        """Sentences on depth images that are not of the size their camera info says."""
        faults = []
        for topic, size in self._depth_sizes.items():
            said = self._info_sizes.get(topic.removesuffix("image") + "info")
            if said is not None and said != size:
                faults.append(
                    f"{topic}: images of {size[0]} x {size[1]}, "
                    f"its camera info says {said[0]} x {said[1]}"
                )
        return faults


def _color(data: bytes) -> object:
    image = CompressedColor.from_cdr(data)
    if not image.format.lower().strip().startswith(_KNOWN_COLORS):
        return image
    return decode_color(image.data)


_KNOWN_COLORS = ("jpeg", "jpg", "png", "rgb8; jpeg", "bgr8; jpeg", "rgb8; png", "bgr8; png")
_DECODERS: dict[str, Callable[[bytes], object]] = {
    schema.JOINT_STATE: JointSample.from_cdr,
    schema.COMPRESSED_IMAGE: _color,
    schema.COMPRESSED_VIDEO: VideoFrame.from_protobuf,
    schema.TF_MESSAGE: transforms_from_cdr,
    schema.POSE_STAMPED: PoseSample.from_cdr,
    schema.STRING: string_from_cdr,
    schema.PLAN: Plan.from_json,
    schema.VERDICT: Verdict.from_json,
    schema.SAMPLE: lambda data: parse_record(data, name="sample"),
    schema.CONTACT: lambda data: parse_record(data, name="contact"),
    schema.DIVERGENCE: lambda data: parse_record(data, name="divergence"),
    schema.LOCALISATION: lambda data: parse_record(data, name="localisation"),
    schema.EVENT: lambda data: parse_record(data, name="event", package="bridge.episode"),
}
