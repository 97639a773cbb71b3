"""A controller in its own process: joints at 500 Hz and a camera, and how many put() have returned.

Arguments: endpoint, preset of the joints. Prints "go", then a number for each line it reads.
"""

import os
import sys
import threading
import time

from bridge.episode import schema
from bridge.wire.config import WireConfig
from bridge.wire.qos import Qos
from bridge.wire.session import open_session

PERIOD_S = 1 / 500
IMAGE = bytes(640 * 480 * 3)


def main() -> None:
    endpoint, preset = sys.argv[1:3]
    with open_session(WireConfig(connect=(endpoint,))) as session:
        qos = {"control": Qos.CONTROL, "reliable": Qos.RELIABLE}[preset]
        joints = session.publisher("/child/joint_states", schema.JOINT_STATE, qos=qos)
        camera = session.publisher("/child/cam/a/raw", schema.IMAGE, qos=Qos.CAMERA)
        returned = 0

        def film() -> None:
            while True:
                camera.put(IMAGE, source_ns=session.now_ns())
                time.sleep(1 / 30)

        def control() -> None:
            nonlocal returned
            while True:
                joints.put(b"j" * 330, source_ns=session.now_ns())
                returned += 1
                time.sleep(PERIOD_S)

        for work in (film, control):
            threading.Thread(target=work, daemon=True).start()
        print("go", flush=True)
        for _ in sys.stdin:
            print(returned, flush=True)
        os._exit(0)  # a session that is still stalled would wait for its queue


if __name__ == "__main__":
    main()
