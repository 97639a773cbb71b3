"""What the benchmark's cell publishes: every message can be made again from its number and stamp.

So the publisher keeps no copies and computes no hashes, and whoever reads the episode can still
compare every byte with what was sent.
"""

import json
import struct
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Literal

import numpy as np

from bridge.clock import split_ns
from bridge.episode import schema
from bridge.episode.cdr import codec
from bridge.episode.cdr.messages import JointSample
from record.frames import add_noise, enlarge, native_frames

_STAMP = struct.Struct("<iI")
_STAMP_AT = 4  # behind the encapsulation header
_NUMBER = struct.Struct("<d")
_SENTINEL = 12345.678


@dataclass(frozen=True, kw_only=True)
class CellSpec:
    """The size and kind of the data."""

    streams: Literal["all", "cameras", "joints"] = "all"
    width: int = 640
    height: int = 480
    depth: Literal["noisy", "easy"] = "noisy"
    pool: int = 15
    """Distinct frames per camera, repeated in turn."""
    seed: int = 1
    camera_hz: float = 30.0
    joint_hz: float = 500.0
    gripper_hz: float = 100.0

    def to_text(self) -> str:
        """For a command line."""
        return json.dumps(asdict(self))

    @staticmethod
    def from_text(text: str) -> "CellSpec":
        """Read it back."""
        return CellSpec(**json.loads(text))


class Stream:
    """One topic: its messages by number."""

    def __init__(self, topic: str, type_name: str, rate_hz: float, messages: list[bytes]) -> None:
        """Keep the messages to send in turn; their stamps are patched."""
        self.topic = topic
        self.type_name = type_name
        self.period_ns = round(1e9 / rate_hz)
        self.is_image = type_name == schema.IMAGE
        self.is_color = self.is_image and "/color/" in topic
        self._messages = [bytearray(message) for message in messages]
        self._number_at = -1 if self.is_image else messages[0].index(_NUMBER.pack(_SENTINEL))

    def message(self, sequence: int, stamp_ns: int) -> bytearray:
        """The message of this number; the same buffer comes again, so use it at once."""
        data = self._messages[sequence % len(self._messages)]
        _STAMP.pack_into(data, _STAMP_AT, *split_ns(stamp_ns))
        if self._number_at >= 0:
            _NUMBER.pack_into(data, self._number_at, float(sequence))
        return data


def streams_of(spec: CellSpec) -> list[Stream]:
    """Every stream of the cell."""
    joints = [] if spec.streams == "cameras" else list(_joint_streams(spec))
    return joints + ([] if spec.streams == "joints" else list(_camera_streams(spec)))


def _joint_streams(spec: CellSpec) -> Iterator[Stream]:
    topics = (("joint_states", 6, spec.joint_hz), ("gripper/state", 1, spec.gripper_hz))
    for name, count, rate_hz in topics:
        sample = JointSample(
            stamp_ns=0,
            names=tuple(f"joint_{index}" for index in range(count)),
            position=np.array([_SENTINEL] + [0.5] * (count - 1)),
            velocity=np.linspace(0, 1, count),
            effort=np.zeros(count),
        )
        yield Stream(f"/bench/{name}", schema.JOINT_STATE, rate_hz, [sample.to_cdr()])


def _camera_streams(spec: CellSpec) -> Iterator[Stream]:
    colors, depths = native_frames(2 * spec.pool)
    rng = np.random.default_rng(spec.seed)
    for number, camera in enumerate(("a", "b")):
        part = slice(number, None, 2)
        shown = [enlarge(frame, spec.width, spec.height) for frame in colors[part]]
        measured = [enlarge(frame, spec.width, spec.height) for frame in depths[part]]
        if spec.depth == "noisy":
            measured = [add_noise(frame, rng) for frame in measured]
        for what, encoding, frames in (("color", "rgb8", shown), ("depth", "16UC1", measured)):
            messages = [_image_cdr(frame, encoding, camera) for frame in frames]
            topic = f"/bench/cam/{camera}/{what}/image"
            yield Stream(topic, schema.IMAGE, spec.camera_hz, messages)


def _image_cdr(frame: np.ndarray, encoding: str, frame_id: str) -> bytes:
    height, width = frame.shape[:2]
    message = {
        "header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": frame_id},
        "height": height,
        "width": width,
        "encoding": encoding,
        "is_bigendian": 0,
        "step": frame.nbytes // height,
        "data": frame.tobytes(),
    }
    return codec.encode(schema.IMAGE, message)
