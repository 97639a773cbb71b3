"""Texts and hashes of ROS 2 types, against hashes seen on the wire and the files of others."""

import subprocess
import sys
from pathlib import Path

import pytest

from bridge.episode import schema
from bridge.errors import UsageError
from bridge.wire.rmw import ros_schema, type_hash_of

# Printed by `ros2 topic info --verbose` of ROS 2 Jazzy and seen in keys of rmw_zenoh.
STRING_HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"


def write(folder: Path, name: str, text: str) -> None:
    path = folder / "src" / "my_msgs" / "msg" / f"{name}.msg"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def test_the_hash_is_the_one_on_the_wire() -> None:
    assert type_hash_of("std_msgs/msg/String") == STRING_HASH


@pytest.mark.parametrize("name", sorted(schema.ROS_TYPES))
def test_our_own_definitions_have_the_fields_of_ros(name: str) -> None:
    from rosbags.typesys import get_types_from_msg

    found = ros_schema(name)
    assert found is not None
    assert (found.name, found.schema_encoding, found.message_encoding) == (name, "ros2msg", "cdr")
    ours = get_types_from_msg(schema.schema_text(name), name)
    theirs = get_types_from_msg(found.data.decode(), name)
    assert {key: fields for key, (_, fields) in ours.items()} == {
        key: fields for key, (_, fields) in theirs.items()
    }


@pytest.mark.parametrize("name", ["", "String", "a/b", "no_msgs/msg/Such", "../x/y", "a/b/c/d"])
def test_an_unknown_type_is_none(name: str) -> None:
    assert ros_schema(name) is None
    assert type_hash_of(name) is None
    assert ros_schema(name, type_hash=STRING_HASH) is None


def test_an_older_definition_is_found_by_its_hash() -> None:
    from rosbags.typesys import Stores, get_typestore

    old, name = get_typestore(Stores.ROS2_FOXY), "sensor_msgs/msg/PointCloud2"
    changed = [
        each
        for each in old.fielddefs
        if ros_schema(each, type_hash=old.hash_rihs01(each)) is not None
        and type_hash_of(each) != old.hash_rihs01(each)
    ]
    assert changed, "no type of Foxy has changed since"
    name = changed[0]
    newest, older = ros_schema(name), ros_schema(name, type_hash=old.hash_rihs01(name))
    assert newest is not None
    assert older is not None
    assert newest.data != older.data
    assert older.data.decode() == old.generate_msgdef(name, ros_version=2)[0]


def test_a_definition_nobody_knows_is_none() -> None:
    assert ros_schema("std_msgs/msg/String", type_hash="RIHS01_" + "0" * 64) is None


def test_a_type_made_of_an_unknown_one_is_unknown(tmp_path: Path) -> None:
    write(tmp_path, "Grip", "other_msgs/Missing part\n")
    assert ros_schema("my_msgs/msg/Grip", folder=tmp_path) is None


def test_a_folder_that_is_none_is_wrong_use(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="holds no message definitions"):
        ros_schema("a/msg/B", folder=tmp_path)
    write(tmp_path, "Bad", "float64 = = 3\n")
    with pytest.raises(UsageError, match=r"Bad\.msg is not a ROS 2 message definition"):
        ros_schema("a/msg/B", folder=tmp_path)


def test_the_definitions_of_ros_are_loaded_only_when_asked() -> None:
    code = "import sys, bridge.wire.rmw; sys.exit('rosbags.typesys' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
