import pytest
from hypothesis import given
from hypothesis import strategies as st
from video_messages import video_message

from bridge.episode import protobuf, schema
from bridge.episode.cdr.codec import MalformedMessageError
from bridge.episode.cdr.messages import VideoFrame
from bridge.episode.topics import type_of_topic

NS = 1_700_000_000_123_456_789


@given(st.integers(-(2**40), 2**62), st.text(st.characters(codec="utf-8"), max_size=9), st.binary())
def test_a_frame_comes_back(stamp_ns: int, frame_id: str, data: bytes) -> None:
    frame = VideoFrame.from_protobuf(video_message(stamp_ns, frame_id, data))
    assert frame == VideoFrame(stamp_ns=stamp_ns, frame_id=frame_id, data=data, format="h264")


def test_fields_that_came_later_are_passed_over() -> None:
    newer = video_message(NS, "c", b"x") + protobuf.bytes_field(100, b"an id")
    newer += protobuf.number_field(101, 7) + protobuf.varint(102 << 3 | protobuf.FIXED64) + bytes(8)
    assert VideoFrame.from_protobuf(newer) == VideoFrame.from_protobuf(video_message(NS, "c", b"x"))


@pytest.mark.parametrize(
    ("data", "found"),
    [
        (b"\x08\x01", "field 1 is a number"),
        (b"\x0b", "wire type 3"),
        (b"\x08" + b"\xff" * 11, "more than 64 bits"),
        (protobuf.bytes_field(2, b"\xff\xfe"), "invalid start byte"),
        (protobuf.bytes_field(1, protobuf.bytes_field(1, b"x")), "not made of numbers"),
    ],
)
def test_other_bytes_are_one_error(data: bytes, found: str) -> None:
    with pytest.raises(MalformedMessageError, match=found):
        VideoFrame.from_protobuf(data)


def test_the_preview_topic_carries_video() -> None:
    assert type_of_topic("/cell/cam/a/color/preview") == schema.COMPRESSED_VIDEO
    found = schema.schema_for(schema.COMPRESSED_VIDEO)
    assert found is not None
    assert (found.schema_encoding, found.message_encoding) == ("protobuf", "protobuf")
