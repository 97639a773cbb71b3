"""A controller in its own process: joints at 500 Hz and a camera, and how long each put() took.

Arguments: endpoint, preset of the joints, seconds. Prints "go", then one JSON line with, for each
put() of the joints, when it began (CLOCK_MONOTONIC) and how long it took [s].
"""

import json
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
    endpoint, preset, duration_s = sys.argv[1], sys.argv[2], float(sys.argv[3])
    with open_session(WireConfig(connect=(endpoint,))) as session:
        qos = {"control": Qos.CONTROL, "reliable": Qos.RELIABLE}[preset]
        joints = session.publisher("/child/joint_states", schema.JOINT_STATE, qos=qos)
        camera = session.publisher("/child/cam/a/raw", schema.IMAGE, qos=Qos.CAMERA)
        end_s = time.monotonic() + duration_s

        def film() -> None:
            while time.monotonic() < end_s:
                camera.put(IMAGE, source_ns=session.now_ns())
                time.sleep(1 / 30)

        threading.Thread(target=film, daemon=True).start()
        print("go", flush=True)
        took = []
        due_s = time.monotonic()
        while (begin_s := time.monotonic()) < end_s:
            joints.put(b"j" * 330, source_ns=session.now_ns())
            took.append((begin_s, time.monotonic() - begin_s))
            due_s = max(due_s + PERIOD_S, time.monotonic())
            time.sleep(max(0.0, due_s - time.monotonic()))
        print(json.dumps(took), flush=True)
        os._exit(0)  # a session that is still stalled would wait for its queue


if __name__ == "__main__":
    main()
