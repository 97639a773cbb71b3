"""Which messages share a chunk, and which chunks are worth compressing.

A reader of one small topic must not unpack images, and bytes that are packed already (JPEG, PNG,
H.264) cost CPU time without getting smaller. So each large stream has chunks of its own and all
small topics share theirs (the recorder study, sections 1.1 and 1.6).
"""

from bridge.episode import schema
from bridge.episode.mcap.format import Buffer, Payload

LARGE_BYTES = 1 << 16
"""A topic with a message of this size counts as a large stream from then on."""

_LARGE_TYPES = frozenset(
    {
        schema.IMAGE,
        schema.COMPRESSED_IMAGE,
        "foxglove.CompressedImage",
        "foxglove.CompressedVideo",
        "foxglove.RawImage",
    }
)
_PACKED_TYPES = frozenset(
    {schema.COMPRESSED_IMAGE, "foxglove.CompressedImage", "foxglove.CompressedVideo"}
)
_DEPTH_ENCODINGS = (b"16UC1\0", b"mono16\0", b"32FC1\0")
_HEAD_BYTES = 512
"""An encoding's name stands near the front of an image message."""


def is_large(type_name: str, length: int) -> bool:
    """Say whether a message of this many bytes belongs to a stream with chunks of its own."""
    return type_name in _LARGE_TYPES or length >= LARGE_BYTES


def first_bytes(data: Payload) -> bytes:
    """Return the front of a message, enough to see its encoding."""
    if isinstance(data, Buffer):
        return bytes(memoryview(data).cast("B")[:_HEAD_BYTES])
    return b"".join(first_bytes(piece) for piece in data[:4])[:_HEAD_BYTES]


def is_worth_compressing(type_name: str, front: bytes) -> bool:
    """Judge a stream by its type and the front of its first message: zstd for depth and unknown.

    Raw colour is left as it is: zstd takes a quarter off it for more CPU time than JPEG.
    """
    if type_name in _PACKED_TYPES:
        return b"compressedDepth rvl" in front
    if type_name == schema.IMAGE:
        return any(encoding in front for encoding in _DEPTH_ENCODINGS)
    return True
