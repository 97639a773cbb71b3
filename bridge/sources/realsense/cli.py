"""The command that publishes RealSense cameras."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from bridge.sources.realsense.config import RealSenseConfig
from bridge.sources.source import Duration
from bridge.terminal import Output
from bridge.wire.config import LOOPBACK

OUTPUT = Output()
REALSENSE = RealSenseConfig()


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
    """
    from bridge.sources.realsense.device import describe_device
    from bridge.sources.realsense.publish import RealSenseSource, attached_devices
    from bridge.sources.source import run_source
    from bridge.wire.config import WireConfig

    list_devices = attached_devices()
    if list:
        found = [describe_device(device) for device in list_devices()]
        output.result({"cameras": found}, "\n".join(found) or "no RealSense camera is attached")
        return 0
    source = RealSenseSource(config, list_devices)
    wire = WireConfig(
        connect=connect, config=zenoh_config, shared_memory_mb=config.shared_memory_mb
    )
    counts = run_source(source, wire, output, duration_s=duration_s)
    lines = [
        f"{camera}: {sent['color_frames']} colour and {sent['depth_frames']} depth frames sent, "
        f"{sent['color_lost']} and {sent['depth_lost']} lost on the way from the camera"
        for camera, sent in counts.items()
    ]
    output.result({"cameras": counts}, "\n".join(lines))
    return 0
