"""The preview stream of a camera: H.264 frames as ``foxglove.CompressedVideo`` in protobuf."""

from dataclasses import dataclass

from bridge.clock import join_ns, split_ns
from bridge.episode import protobuf, schema
from bridge.episode.cdr import MalformedMessageError
from bridge.media.video import VIDEO_FORMAT


@dataclass(frozen=True, kw_only=True)
class VideoFrame:
    """One frame of a video stream; it may need the frames before it to be shown."""

    stamp_ns: int
    frame_id: str
    data: bytes
    format: str

    @staticmethod
    def from_protobuf(data: bytes) -> "VideoFrame":
        """Read a foxglove.CompressedVideo.

        Raises:
            MalformedMessageError: The bytes are no such message.
        """
        found: dict[int, bytes] = {}
        try:
            for number, value in protobuf.fields(memoryview(data)):
                if 1 <= number <= 4:
                    if isinstance(value, int):
                        raise ValueError(_not_bytes(number))
                    found[number] = bytes(value)
            return VideoFrame(
                stamp_ns=_stamp(found.get(1, b"")),
                frame_id=found.get(2, b"").decode(),
                data=found.get(3, b""),
                format=found.get(4, b"").decode(),
            )
        except ValueError as error:
            raise MalformedMessageError(
                type_name=schema.COMPRESSED_VIDEO, found=str(error)
            ) from error


def _not_bytes(number: int) -> str:
    return f"field {number} is a number"


def _stamp(data: bytes) -> int:
    parts = {1: 0, 2: 0}
    for number, value in protobuf.fields(memoryview(data)):
        if number in parts:
            if not isinstance(value, int):
                message = "the time is not made of numbers"
                raise ValueError(message)
            parts[number] = protobuf.signed(value)
    return join_ns(parts[1], parts[2])


def video_message(stamp_ns: int, frame_id: str, data: bytes) -> bytes:
    """Serialise one H.264 frame (Annex B) as foxglove.CompressedVideo."""
    seconds, nanos = split_ns(stamp_ns)
    timestamp = protobuf.number_field(1, seconds) + protobuf.number_field(2, nanos)
    return b"".join(
        [
            protobuf.bytes_field(1, timestamp),
            protobuf.bytes_field(2, frame_id.encode()),
            protobuf.bytes_field(3, data),
            protobuf.bytes_field(4, VIDEO_FORMAT.encode()),
        ]
    )
