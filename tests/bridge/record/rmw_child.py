"""A ROS 2 node as rmw_zenoh makes one, without ROS 2: its keys, tokens, attachments and caches."""

import json
import struct
import sys
import uuid
from typing import Any

import zenoh
from rosbags.typesys import Stores, get_typestore
from zenoh.ext import CacheConfig, Int64, declare_advanced_publisher, z_serialize

TYPESTORE = get_typestore(Stores.ROS2_JAZZY)
STRING = "std_msgs/msg/String"
GID = uuid.uuid5(uuid.NAMESPACE_DNS, "rmw child").bytes


def attachment(form: int, number: int, stamp_ns: int) -> bytes | None:
    if form == 33:
        return z_serialize((Int64(number), Int64(stamp_ns), GID)).to_bytes()
    if form == 77:
        return b"".join(
            (
                b"\x0fsequence_number" + struct.pack("<q", number),
                b"\x10source_timestamp" + struct.pack("<q", stamp_ns),
                b"\x0asource_gid\x10" + GID,
            )
        )
    return None


def open_client(endpoint: str) -> Any:
    config = zenoh.Config()
    for key, value in {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "scouting/multicast/enabled": False,
        "timestamping/enabled": True,  # rmw_zenoh's own session file has it on
    }.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def main() -> None:
    endpoint, form, count, *flags = sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), *sys.argv[4:]
    name = "my_msgs::msg::dds_::Grip_" if "unknown" in flags else "std_msgs::msg::dds_::String_"
    type_hash = TYPESTORE.hash_rihs01(STRING)
    if "other-hash" in flags or "unknown" in flags:
        type_hash = "RIHS01_" + "5" * 64
    key = f"0/chatter/{name}/{type_hash}"
    latched = "latched" in flags or "old-latched" in flags
    with open_client(endpoint) as session:
        zid = str(session.info.zid())
        sent: list[tuple[bytes, bytes | None]] = []
        if "latched" in flags:
            publisher = declare_advanced_publisher(
                session, key, cache=CacheConfig(max_samples=100), publisher_detection=True
            )
        else:
            publisher = session.declare_publisher(key)
        if "old-latched" in flags:

            def answer(query: Any) -> None:
                with query:
                    for data, note in sent:
                        query.reply(key, data, attachment=note)

            session.declare_queryable(f"{zid}/{key}", answer)
        qos = f":{'1' if latched else ''}:,{count}:,:,:,,"
        token = session.liveliness().declare_token(
            f"@ros2_lv/0/{zid}/0/1/MP/%/%/talker/%chatter/{name}/{type_hash}/{qos}"
        )
        number = 0
        for _ in sys.stdin:
            for _ in range(count):
                message = TYPESTORE.types[STRING](data=f"hello {number}")
                data = bytes(TYPESTORE.serialize_cdr(message, STRING))
                note = attachment(form, number, 1_000 + number)
                sent.append((data, note))
                publisher.put(data, attachment=note)
                number += 1
            print("sent", flush=True)
        token.undeclare()


if __name__ == "__main__":
    main()
