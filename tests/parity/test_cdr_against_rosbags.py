"""Our CDR and schema texts against rosbags, an independent implementation."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from bridge.episode import cdr
from bridge.episode.ros2_definitions import DEFINITIONS, schema_text

pytestmark = pytest.mark.parity
STORE = get_typestore(Stores.ROS2_HUMBLE)


@pytest.mark.parametrize("name", sorted(DEFINITIONS))
def test_field_lists_are_those_of_ros_2(name: str) -> None:
    ours = get_types_from_msg(DEFINITIONS[name], name)[name]
    assert ours[1] == STORE.fielddefs[name][1]


@pytest.mark.parametrize("name", sorted(DEFINITIONS))
def test_schema_texts_are_complete(name: str) -> None:
    types = get_types_from_msg(schema_text(name), name)
    for part in types:
        assert types[part][1] == STORE.fielddefs[part][1]


names = st.lists(
    st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=9), max_size=5
)
floats = st.lists(st.floats(allow_nan=False), max_size=7)


@settings(max_examples=40, deadline=None)
@given(
    st.integers(-(2**31), 2**31 - 1),
    st.text(max_size=5).map(lambda s: s.replace("\0", "")),
    names,
    floats,
)
def test_joint_states_are_byte_for_byte_those_of_rosbags(
    sec: int, frame: str, joints: list[str], values: list[float]
) -> None:
    header_type = STORE.types["std_msgs/msg/Header"]
    time_type = STORE.types["builtin_interfaces/msg/Time"]
    joint_type = STORE.types["sensor_msgs/msg/JointState"]
    array = np.array(values, dtype=np.float64)
    theirs = STORE.serialize_cdr(
        joint_type(header_type(time_type(sec, 7), frame), joints, array, array, array),
        "sensor_msgs/msg/JointState",
    )
    message = {
        "header": {"stamp": {"sec": sec, "nanosec": 7}, "frame_id": frame},
        "name": joints,
        "position": array,
        "velocity": array,
        "effort": array,
    }
    assert cdr.encode("sensor_msgs/msg/JointState", message) == bytes(theirs)


def test_camera_info_written_by_rosbags_is_read_field_by_field() -> None:
    types = STORE.types
    info = types["sensor_msgs/msg/CameraInfo"](
        types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](3, 4), "cam"),
        480,
        640,
        "plumb_bob",
        np.arange(5.0),
        np.arange(9.0),
        np.arange(9.0),
        np.arange(12.0),
        1,
        2,
        types["sensor_msgs/msg/RegionOfInterest"](1, 2, 3, 4, True),
    )
    data = bytes(STORE.serialize_cdr(info, "sensor_msgs/msg/CameraInfo"))
    message = cdr.decode("sensor_msgs/msg/CameraInfo", data)
    assert (message["height"], message["width"], message["binning_y"]) == (480, 640, 2)
    np.testing.assert_array_equal(message["p"], np.arange(12.0))
    assert message["roi"]["do_rectify"] is True
    assert cdr.encode("sensor_msgs/msg/CameraInfo", message) == data


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=200), st.sampled_from(sorted(DEFINITIONS)))
def test_arbitrary_bytes_are_read_or_refused_but_never_crash(data: bytes, name: str) -> None:
    refused = False
    try:
        message = cdr.decode(name, b"\x00\x01\x00\x00" + data)
    except cdr.MalformedMessageError:
        refused = True
    assert refused or isinstance(message, dict)


def test_a_message_that_claims_a_giant_array_is_refused() -> None:
    data = cdr.ENCAPSULATION_LE + b"\0" * 8 + b"\x01\0\0\0\0\0\0\0" + b"\xff\xff\xff\x7f"
    with pytest.raises(cdr.MalformedMessageError, match="not a valid"):
        cdr.decode("sensor_msgs/msg/JointState", data)
