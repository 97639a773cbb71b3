"""Commands that publish hardware: RealSense cameras and UR arms."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from bridge.sources.realsense.config import RealSenseConfig
from bridge.sources.ur.config import UrConfig
from bridge.terminal import Output, stop_signals
from bridge.wire.config import DEFAULT_ENDPOINT

OUTPUT = Output()
REALSENSE = RealSenseConfig()
UR = UrConfig()
LOOPBACK = (DEFAULT_ENDPOINT,)
Duration = Annotated[float | None, Parameter(name=("--duration", "--duration-s"))]


def publish_realsense(
    *,
    config: Annotated[RealSenseConfig, Parameter(name="*")] = REALSENSE,
    list: Annotated[bool, Parameter(negative=())] = False,
    duration_s: Duration = None,
    connect: tuple[str, ...] = LOOPBACK,
    zenoh_config: Annotated[Path | None, Parameter(name="--config")] = None,
    output: Output = OUTPUT,
) -> int:
    """Publish RealSense cameras (D435, D405 and others): colour, depth, calibration.

    It runs until SIGINT or SIGTERM; a camera that was unplugged is taken up again.
    Example: robot-gst publish realsense --cell lab --camera side=123622270224

    Args:
        config: Which cameras, and how.
        list: Say what is attached and end.
        duration_s: Stop after this long [s].
        connect: Where the recorder listens.
        zenoh_config: zenoh configuration (JSON5).
        output: How to talk.
    """
    from bridge.sources.realsense.device import describe_device
    from bridge.sources.realsense.publish import attached_devices, choose_cameras, publish_cameras
    from bridge.wire.config import WireConfig
    from bridge.wire.session import open_session

    list_devices = attached_devices()
    if list:
        found = [describe_device(device) for device in list_devices()]
        output.result({"cameras": found}, "\n".join(found) or "no RealSense camera is attached")
        return 0
    choose_cameras(config, list_devices)
    wire = WireConfig(
        connect=connect, config=zenoh_config, shared_memory_mb=config.shared_memory_mb
    )
    with _stopping(duration_s) as stop, open_session(wire) as session:
        counts = publish_cameras(
            session, config, stop=stop, output=output, list_devices=list_devices
        )
    lines = [
        f"{camera}: {sent['color_frames']} colour and {sent['depth_frames']} depth frames sent, "
        f"{sent['color_lost']} and {sent['depth_lost']} lost on the way from the camera"
        for camera, sent in counts.items()
    ]
    output.result({"cameras": counts}, "\n".join(lines))
    return 0


def publish_ur(
    host: str,
    /,
    *,
    config: Annotated[UrConfig, Parameter(name="*")] = UR,
    duration_s: Duration = None,
    connect: tuple[str, ...] = LOOPBACK,
    zenoh_config: Annotated[Path | None, Parameter(name="--config")] = None,
    output: Output = OUTPUT,
) -> int:
    """Publish a UR arm over RTDE: joints, TCP, gripper, URDF, robot and safety mode. Reads only.

    It runs until SIGINT or SIGTERM; a robot that went away is taken up again.
    Example: robot-gst publish ur 192.168.1.10 --cell lab --gripper tool_analog_in:0

    Args:
        host: Name or address of the controller.
        config: What is read, and how.
        duration_s: Stop after this long [s].
        connect: Where the recorder listens.
        zenoh_config: zenoh configuration (JSON5).
        output: How to talk.
    """
    from bridge.sources.ur.publish import describe_counts, publish_arm
    from bridge.wire.config import WireConfig
    from bridge.wire.session import open_session

    wire = WireConfig(connect=connect, config=zenoh_config)
    with _stopping(duration_s) as stop, open_session(wire) as session:
        counts = publish_arm(session, host, config, stop=stop, output=output)
    output.result(counts, describe_counts(counts))
    return 0


@contextmanager
def _stopping(duration_s: float | None) -> Iterator[threading.Event]:
    """An event that is set by a signal, or when the time is over."""
    with stop_signals() as stop:
        timer = None if duration_s is None else threading.Timer(duration_s, stop.set)
        if timer is not None:
            timer.daemon = True
            timer.start()
        try:
            yield stop
        finally:
            if timer is not None:
                timer.cancel()
