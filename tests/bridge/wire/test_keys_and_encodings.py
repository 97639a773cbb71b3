"""Topics, keys, encodings, and the attachment's bytes against zenoh's own serialiser."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.wire.errors import BadTopicError, is_loopback
from bridge.wire.keys import encoding_of, key_from_topic, parse_encoding, read_key
from bridge.wire.publisher import Attachment, decode, encode

PART = st.text("abcXYZ019_-. äß", min_size=1, max_size=8)


@given(st.lists(PART, min_size=1, max_size=5))
def test_a_topic_survives_the_key(parts: list[str]) -> None:
    topic = "/" + "/".join(parts)
    assert read_key(key_from_topic(topic)) == (topic, "", "")


@pytest.mark.parametrize("topic", ["", "joint_states", "/", "/a//b", "/a/", "/a*", "/@x", "/a?b"])
def test_a_topic_that_cannot_travel_is_refused(topic: str) -> None:
    with pytest.raises(BadTopicError, match="cannot be published"):
        key_from_topic(topic)


def test_a_ros_key_gives_topic_type_and_hash() -> None:
    type_hash = "RIHS01_" + "d" * 64
    key = f"0/arm/chatter/std_msgs::msg::dds_::String_/{type_hash}"
    assert read_key(key) == ("/arm/chatter", "std_msgs/msg/String", type_hash)
    old = "7/chatter/std_msgs::msg::dds_::String_/TypeHashNotSupported"
    assert read_key(old) == ("/chatter", "std_msgs/msg/String", "")


def test_encodings_name_the_type() -> None:
    assert encoding_of("gst/Plan", "json") == "application/json;gst/Plan"
    assert parse_encoding("application/json;gst/Plan") == ("gst/Plan", "json")
    assert parse_encoding("zenoh/bytes") == ("", "")


@pytest.mark.parametrize(
    ("endpoint", "expected"),
    [
        ("tcp/127.0.0.1:7447", True),
        ("tcp/[::1]:7447", True),
        ("tcp/localhost:7447", True),
        ("tcp/0.0.0.0:7447", False),
        ("tcp/[::]:7447", False),
        ("tcp/192.168.0.3:7447", False),
    ],
)
def test_loopback_is_recognised(endpoint: str, expected: bool) -> None:
    assert is_loopback(endpoint) is expected


INT64 = st.integers(-(2**63), 2**63 - 1)
GIDS = st.binary(min_size=16, max_size=16)


@given(INT64, INT64, GIDS)
def test_what_is_encoded_is_decoded(sequence: int, source_ns: int, gid: bytes) -> None:
    attachment = Attachment(sequence=sequence, source_ns=source_ns, gid=gid)
    assert decode(encode(attachment)) == attachment


@pytest.mark.parity
def test_the_bytes_are_those_of_the_zenoh_serialiser() -> None:
    from zenoh.ext import Int64, z_serialize

    reference = z_serialize((Int64(7), Int64(-3), bytes(range(16)))).to_bytes()
    assert encode(Attachment(sequence=7, source_ns=-3, gid=bytes(range(16)))) == reference
    assert len(reference) == 33


@given(st.one_of(st.none(), st.binary(max_size=100)))
def test_anything_else_is_no_attachment_and_no_error(data: bytes | None) -> None:
    found = decode(data)
    assert found is None or len(data or b"") == 33


def test_a_wrong_length_field_is_no_attachment() -> None:
    good = encode(Attachment(sequence=1, source_ns=2, gid=bytes(16)))
    assert decode(good[:16] + b"\x0f" + good[17:]) is None
