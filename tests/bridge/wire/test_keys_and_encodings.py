"""Topics, keys and encodings."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.wire.errors import BadTopicError, is_loopback
from bridge.wire.keys import encoding_of, key_from_topic, parse_encoding, read_key

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
