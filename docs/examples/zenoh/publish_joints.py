"""Publish joints so that robot-gst records them, without robot-gst: zenoh and struct only.

    python publish_joints.py tcp/127.0.0.1:7447 demo 500 100

sends 500 samples on /demo/joint_states at 100 Hz. docs/wire.md explains every step. Numbers after
these are left out of the count, as if those messages had been lost: the recorder reports them.
"""

import json
import math
import struct
import sys
import time
import uuid

import zenoh

NAMES = ("shoulder", "elbow", "wrist")
ENCODING = "application/cdr;sensor_msgs/msg/JointState"


def attachment(sequence: int, source_ns: int, gid: bytes) -> bytes:
    """Number, time of the sample and publisher: 8 + 8 + 1 + 16 = 33 bytes, little endian."""
    return struct.pack("<qqB16s", sequence, source_ns, 16, gid)


class Cdr:
    """ROS 2's serialisation, little endian: each value is aligned to its own size."""

    def __init__(self) -> None:
        """Begin with the 4 bytes that say: CDR, little endian."""
        self.data = bytearray(b"\x00\x01\x00\x00")

    def put(self, form: str, *values: float) -> None:
        """Append numbers of one type, for example "I" or "d"."""
        for value in values:
            self.data += bytes(-(len(self.data) - 4) % struct.calcsize(form))
            self.data += struct.pack("<" + form, value)

    def text(self, value: str) -> None:
        """Append a string: its length with the zero at its end, then both."""
        raw = value.encode() + b"\0"
        self.put("I", len(raw))
        self.data += raw

    def doubles(self, values: tuple[float, ...]) -> None:
        """Append a sequence of float64: how many, then they themselves."""
        self.put("I", len(values))
        self.put("d", *values)


def joint_state(stamp_ns: int, position_rad: tuple[float, ...]) -> bytes:
    """Serialise sensor_msgs/msg/JointState; velocity and effort stay empty."""
    cdr = Cdr()
    cdr.put("i", stamp_ns // 10**9)
    cdr.put("I", stamp_ns % 10**9)
    cdr.text("base_link")
    cdr.put("I", len(NAMES))
    for name in NAMES:
        cdr.text(name)
    cdr.doubles(position_rad)
    cdr.doubles(())
    cdr.doubles(())
    return bytes(cdr.data)


def main() -> None:
    """Connect to the recorder, say that we are there, and publish."""
    endpoint, cell, count, rate_hz = sys.argv[1:5]
    left_out = {int(number) for number in sys.argv[5:]}
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config) as session:
        token = session.liveliness().declare_token(f"{cell}/alive")
        publisher = session.declare_publisher(
            f"{cell}/joint_states",
            encoding=ENCODING,
            congestion_control=zenoh.CongestionControl.DROP,  # a control loop never waits
            priority=zenoh.Priority.REAL_TIME,
        )
        gid, begin_s = uuid.uuid4().bytes, time.monotonic()
        for number in range(int(count)):
            time.sleep(max(0.0, begin_s + number / float(rate_hz) - time.monotonic()))
            now_ns = time.time_ns()
            angle_rad = math.sin(number / 50)
            if number not in left_out:
                data = joint_state(now_ns, (angle_rad, -angle_rad, 0.0))
                publisher.put(data, attachment=attachment(number, now_ns, gid))
        token.undeclare()


if __name__ == "__main__":
    main()
