"""Our CDR and schema texts against rosbags, an independent implementation."""

import tracemalloc
from collections.abc import Mapping

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from bridge.episode.cdr import codec
from bridge.episode.cdr.codec import PRIMITIVES, fields_of
from bridge.episode.schema import DEFINITIONS, schema_text

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
    assert codec.encode("sensor_msgs/msg/JointState", message) == bytes(theirs)


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
    message = codec.decode("sensor_msgs/msg/CameraInfo", data)
    assert (message["height"], message["width"], message["binning_y"]) == (480, 640, 2)
    np.testing.assert_array_equal(message["p"], np.arange(12.0))
    assert message["roi"]["do_rectify"] is True
    assert codec.encode("sensor_msgs/msg/CameraInfo", message) == data


values_of = {
    "bool": st.booleans(),
    "string": st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=9),
    "float32": st.floats(width=32, allow_nan=False),
    "float64": st.floats(allow_nan=False),
} | {
    f"{sign}int{bits}": st.integers(
        0 if sign else -(2 ** (bits - 1)), 2 ** (bits if sign else bits - 1) - 1
    )
    for sign in ("", "u")
    for bits in (8, 16, 32, 64)
}


def messages_of(name: str) -> st.SearchStrategy[dict[str, object]]:
    """Random messages of a type, field by field after its definition."""
    made = {}
    for field in fields_of(name):
        one = values_of.get(field.type_name)
        one = messages_of(field.type_name) if one is None else one
        if field.length is None:
            made[field.name] = one
        elif field.type_name == "uint8":
            made[field.name] = st.binary(max_size=9)
        else:
            least, most = (field.length, field.length) if field.length else (0, 4)
            made[field.name] = st.lists(one, min_size=least, max_size=most)
    return st.fixed_dictionaries(made)


def to_rosbags(name: str, message: Mapping[str, object]) -> object:
    """Build the class of rosbags from our dict."""
    values = []
    for field in fields_of(name):
        value = message[field.name]
        if field.type_name in PRIMITIVES and field.length is not None:
            if field.type_name == "uint8":
                value = np.frombuffer(bytes(value), np.uint8)
            else:
                value = np.array(value, dtype=PRIMITIVES[field.type_name])
        elif "/" in field.type_name:
            inner = field.type_name
            if field.length is None:
                value = to_rosbags(inner, value)
            else:
                value = [to_rosbags(inner, item) for item in value]
        values.append(value)
    return STORE.types[name](*values)


def same(ours: object, theirs: object) -> bool:
    if isinstance(ours, dict):
        return all(same(value, getattr(theirs, key)) for key, value in ours.items())
    if isinstance(ours, list):
        return len(ours) == len(theirs) and all(map(same, ours, theirs))
    if isinstance(ours, memoryview):
        return ours == theirs.tobytes()
    if isinstance(ours, np.ndarray):
        return np.array_equal(ours, theirs)
    return type(ours) is type(theirs) and ours == theirs


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.data(), st.booleans())
@pytest.mark.parametrize("name", sorted(DEFINITIONS))
def test_random_messages_of_rosbags_are_read_in_both_byte_orders(
    name: str, data: st.DataObject, little_endian: bool
) -> None:
    message = data.draw(messages_of(name))
    raw = bytes(STORE.serialize_cdr(to_rosbags(name, message), name, little_endian=little_endian))
    decoded = codec.decode(name, raw)
    assert same(decoded, STORE.deserialize_cdr(raw, name))
    if little_endian:
        assert codec.encode(name, message) == raw
        assert same(codec.decode(name, memoryview(raw)), STORE.deserialize_cdr(raw, name))


def test_a_look_at_a_large_image_copies_nothing() -> None:
    data = codec.encode("sensor_msgs/msg/Image", {"encoding": "16UC1", "data": bytes(50_000_000)})
    tracemalloc.start()
    codec.decode("sensor_msgs/msg/Image", data)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 100_000


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=200), st.sampled_from(sorted(DEFINITIONS)))
def test_arbitrary_bytes_are_read_or_refused_but_never_crash(data: bytes, name: str) -> None:
    refused = False
    try:
        message = codec.decode(name, b"\x00\x01\x00\x00" + data)
    except codec.MalformedMessageError:
        refused = True
    assert refused or isinstance(message, dict)


def test_a_message_that_claims_a_giant_array_is_refused() -> None:
    data = codec.ENCAPSULATION_LE + b"\0" * 8 + b"\x01\0\0\0\0\0\0\0" + b"\xff\xff\xff\x7f"
    with pytest.raises(codec.MalformedMessageError, match="not a valid"):
        codec.decode("sensor_msgs/msg/JointState", data)
