"""The command that runs the stand-in cell."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from bridge.sources.standin.settings import SessionConfig
from bridge.terminal import Output
from bridge.wire.config import LOOPBACK

OUTPUT = Output()
STANDIN = SessionConfig()


def publish_standin(
    *,
    config: Annotated[SessionConfig, Parameter(name="*")] = STANDIN,
    connect: Annotated[tuple[str, ...], Parameter(help="Where the recorder listens.")] = LOOPBACK,
    zenoh_config: Annotated[
        Path | None, Parameter(name="--config", help="zenoh configuration (JSON5).")
    ] = None,
    output: Output = OUTPUT,
) -> int:
    """Run the stand-in cell: a simulated laboratory that records a scan, then trials.

    It needs a recorder (robot-gst record RUN) and, with replanning, a gate (robot-gst gate RUN).
    SIGINT or SIGTERM finish the open episode.
    Example: robot-gst publish standin --trials 3 --seed 1
    Scan only: robot-gst publish standin --trials 0
    Soft toys: robot-gst publish standin --task sloth_into_basket --conditions without_replanning
    """
    from bridge.sources.source import run_source
    from bridge.sources.standin.session import StandinSource, describe
    from bridge.wire.config import WireConfig

    wire = WireConfig(connect=connect, config=zenoh_config)
    summary = run_source(StandinSource(config), wire, output)
    output.result(summary, describe(summary))
    return 0
