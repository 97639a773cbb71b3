"""The command that publishes a UR arm."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from bridge.sources.source import Duration
from bridge.sources.ur.config import UrConfig
from bridge.terminal import Output
from bridge.wire.config import LOOPBACK

OUTPUT = Output()
UR = UrConfig()


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
    """
    from bridge.sources.source import run_source
    from bridge.sources.ur.publish import UrSource
    from bridge.wire.config import WireConfig

    wire = WireConfig(connect=connect, config=zenoh_config)
    counts = run_source(UrSource(host, config), wire, output, duration_s=duration_s)
    text = (
        f"{counts['samples']} samples sent, {counts['lost']} lost before they got here, "
        f"{counts['connections']} connection{'s' if counts['connections'] != 1 else ''}"
    )
    output.result(counts, text)
    return 0
