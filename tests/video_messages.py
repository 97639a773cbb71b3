"""Frames of a video as foxglove.CompressedVideo, as a camera sends them."""

from bridge.clock import split_ns
from bridge.episode import protobuf


def video_message(stamp_ns: int, frame_id: str, data: bytes) -> bytes:
    """One H.264 frame (Annex B)."""
    seconds, nanos = split_ns(stamp_ns)
    timestamp = protobuf.number_field(1, seconds) + protobuf.number_field(2, nanos)
    fields = (timestamp, frame_id.encode(), data, b"h264")
    return b"".join(protobuf.bytes_field(number, value) for number, value in enumerate(fields, 1))
