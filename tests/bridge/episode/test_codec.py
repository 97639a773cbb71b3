"""Messages of ROS 2 against a CDR encoder written here from the specification; broken bytes."""

import struct
import tracemalloc
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from bridge.episode.cdr import codec
from bridge.episode.schema import CAMERA_INFO, ROS_TYPES, ros_types, schema_text

SIZES = {8: "bB", 16: "hH", 32: "iI", 64: "qQ"}
CODES = {
    "bool": "?",
    **{f"{'u' * c.isupper()}int{bits}": c for bits, cs in SIZES.items() for c in cs},
    "float32": "f",
    "float64": "d",
}
BASE, NAME, ARRAY = 1, 2, 3
"""Kinds of fields."""


def pad(out: bytearray, size: int) -> None:
    out.extend(bytes(-len(out) % size))


def put(out: bytearray, kind: int, about: Any, value: Any, order: str) -> None:
    """Every primitive is aligned to its size, counted from the end of the 4-byte header."""
    if kind == NAME:
        for name, (inner, more) in ros_types().fielddefs[about][1]:
            put(out, inner, more, value[name], order)
    elif kind == BASE and about[0] == "string":
        raw = value.encode() + b"\0"
        put(out, BASE, ("uint32",), len(raw), order)
        out.extend(raw)
    elif kind == BASE:
        pad(out, struct.calcsize(CODES[about[0]]))
        out.extend(struct.pack(order + CODES[about[0]], value))
    else:
        if kind != ARRAY:
            put(out, BASE, ("uint32",), len(value), order)
        for item in value:
            put(out, *about[0], item, order)


def expected(name: str, message: dict[str, Any], order: str = "<") -> bytes:
    out = bytearray()
    put(out, NAME, name, message, order)
    return bytes((0, int(order == "<"), 0, 0)) + bytes(out)


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


def values(kind: int, about: Any) -> st.SearchStrategy[Any]:
    if kind == NAME:
        return messages_of(about)
    if kind == BASE:
        return values_of[about[0]]
    inner, length = about
    least, most = (length, length) if kind == ARRAY else (0, 4)
    return st.lists(values(*inner), min_size=least, max_size=most)


def messages_of(name: str) -> st.SearchStrategy[dict[str, Any]]:
    """Random messages of a type, field by field after its definition."""
    fields = ros_types().fielddefs[name][1]
    return st.fixed_dictionaries({field: values(*about) for field, about in fields})


def same(found: object, sent: object) -> bool:
    if isinstance(sent, dict):
        return found.keys() == sent.keys() and all(same(found[key], sent[key]) for key in sent)
    if isinstance(sent, list):
        return len(found) == len(sent) and all(map(same, found, sent))
    return bool(found == sent)


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.data())
@pytest.mark.parametrize("name", sorted(ROS_TYPES))
def test_random_messages_are_written_and_read_in_both_byte_orders(
    name: str, data: st.DataObject
) -> None:
    message = data.draw(messages_of(name))
    raw = codec.encode(name, message)
    assert raw == expected(name, message)
    assert same(codec.decode(name, raw), message)
    assert same(codec.decode(name, memoryview(raw + b"more")), message)
    assert same(codec.decode(name, expected(name, message, ">")), message)


def test_what_is_left_out_is_zero_or_empty() -> None:
    info = codec.decode(CAMERA_INFO, codec.encode(CAMERA_INFO, {}))
    assert (info["height"], info["distortion_model"], info["roi"]["do_rectify"]) == (0, "", False)
    assert (info["k"].tolist(), info["d"].tolist()) == ([0] * 9, [])


def test_schema_texts_hold_all_that_a_type_is_made_of() -> None:
    text = schema_text("tf2_msgs/msg/TFMessage")
    assert text.startswith("geometry_msgs/TransformStamped[] transforms\n")
    parts = {line.removeprefix("MSG: ") for line in text.splitlines() if line.startswith("MSG: ")}
    assert parts == {
        *("geometry_msgs/TransformStamped", "geometry_msgs/Transform", "geometry_msgs/Vector3"),
        *("geometry_msgs/Quaternion", "std_msgs/Header", "builtin_interfaces/Time"),
    }


def test_a_look_at_a_large_image_copies_nothing() -> None:
    data = codec.encode("sensor_msgs/msg/Image", {"encoding": "16UC1", "data": bytes(50_000_000)})
    tracemalloc.start()
    codec.decode("sensor_msgs/msg/Image", data)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 100_000


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=200), st.sampled_from(sorted(ROS_TYPES)))
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
