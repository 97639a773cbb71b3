"""Tokens of rmw_zenoh: its own examples, and whatever else may stand there."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.wire import keys
from bridge.wire.rmw import is_transient_local, parse_token

STRING = "std_msgs::msg::dds_::String_"
STRING_HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
TALKER = (
    "@ros2_lv/2/8b20917502ee955ac4476e0266340d5c/0/10/MP/%/%/talker/%chatter/"
    f"{STRING}/{STRING_HASH}/::,7:,:,:,,"
)


def test_a_publisher_is_read() -> None:
    found = parse_token(TALKER)
    assert found is not None
    assert found.domain == 2
    assert (found.topic, found.dds_type) == ("/chatter", "std_msgs::msg::dds_::String_")
    assert found.session == "8b20917502ee955ac4476e0266340d5c"
    assert not found.transient_local
    assert found.key == f"2/chatter/{STRING}/{STRING_HASH}"
    assert keys.read_key(found.key) == ("/chatter", "std_msgs/msg/String", STRING_HASH)


@pytest.mark.parametrize("kind", ["NN", "MS", "SS", "SC"])
def test_who_publishes_nothing_is_none(kind: str) -> None:
    assert parse_token(TALKER.replace("/MP/", f"/{kind}/")) is None


def test_names_with_slashes_and_later_parts_are_read() -> None:
    found = parse_token(TALKER.replace("%chatter", "%arm%cam%info") + "/zenoh/shm")
    assert found is not None
    assert found.topic == "/arm/cam/info"
    assert found.key == f"2/arm/cam/info/{STRING}/{STRING_HASH}"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("::,10:,:,:,,", False),
        (":1:,1:,:,:,,", True),
        ("2::,5:,:,:,,", False),
        ("1:1:2,10", True),
        ("::,", False),
        ("", None),
        ("::", False),
        (":x:,1", None),
        ("::,-1", None),
        ("::,99999999999999999999", None),
        ("::,١", None),
    ],
)
def test_qualities_of_service(text: str, expected: bool | None) -> None:
    assert is_transient_local(text) is expected


@pytest.mark.parametrize(
    "token",
    [
        "",
        "rec/main/alive",
        TALKER.replace("@ros2_lv", "@other"),
        TALKER.replace("/2/", "/x/", 1),
        TALKER.replace("/MP/", "/XX/"),
        TALKER.replace("%chatter", "chatter"),
        TALKER.replace("%chatter", "%**"),
        TALKER.replace("8b20917502ee955ac4476e0266340d5c", "*"),
        TALKER.rsplit("/", 1)[0],
        TALKER.replace("/0/10/", "//10/"),
    ],
)
def test_anything_else_is_none(token: str) -> None:
    assert parse_token(token) is None


@given(st.lists(st.text("MPNS012%:,@abc*$/", max_size=6), max_size=16))
def test_no_token_raises(parts: list[str]) -> None:
    parse_token("/".join(["@ros2_lv", *parts]))
    parse_token("/".join(parts))
