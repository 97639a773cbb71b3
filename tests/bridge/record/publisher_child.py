"""A cell in its own process with its own account of what it sent."""

import hashlib
import sys
import time
from pathlib import Path

import numpy as np

from bridge.episode import schema
from bridge.episode.cdr.messages import DepthImage, JointSample
from bridge.record.control import RecorderClient
from bridge.wire.clocks import announce
from bridge.wire.config import WireConfig
from bridge.wire.session import open_session


def main() -> None:
    endpoint, account_path, count, period_s = sys.argv[1:5]
    rng = np.random.default_rng(1)
    with (
        open_session(WireConfig(connect=(endpoint,))) as session,
        Path(account_path).open("w") as account,
    ):
        announce(session, "child")
        client = RecorderClient(session)
        if len(sys.argv) > 5:
            client.start(sys.argv[5], {"kind": "trial", "cell": "child"})
        publishers = {
            "/child/joint_states": session.publisher("/child/joint_states", schema.JOINT_STATE),
            "/child/cam/a/depth/image": session.publisher("/child/cam/a/depth/image", schema.IMAGE),
            "/child/odd": session.publisher("/child/odd", "odd_msgs/msg/Odd"),
        }
        for number in range(int(count)):
            stamp_ns = session.now_ns()
            joints = JointSample(
                stamp_ns=stamp_ns,
                names=("a", "b"),
                position=rng.normal(size=2),
                velocity=np.zeros(2),
                effort=np.zeros(0),
            )
            depth = DepthImage(
                stamp_ns=stamp_ns,
                frame_id="a",
                depth_mm=rng.integers(0, 5000, (60, 80)).astype(np.uint16),
            )
            payloads = (joints.to_cdr(), depth.to_cdr(), rng.bytes(number))
            for (topic, publisher), data in zip(publishers.items(), payloads, strict=True):
                digest = hashlib.sha256(data).hexdigest()
                account.write(f"{topic} {number} {digest}\n")
                account.flush()
                publisher.put(data, source_ns=stamp_ns)
            time.sleep(float(period_s))
        if len(sys.argv) > 5:
            client.stop({"result": "success"})


if __name__ == "__main__":
    main()
