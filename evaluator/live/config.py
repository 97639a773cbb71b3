"""How ``evaluate --live`` listens; imports nothing heavy, so that --help is quick."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from bridge.terminal import RARE
from bridge.wire.config import DEFAULT_ENDPOINT


@dataclass(frozen=True, kw_only=True)
class LiveConfig:
    """Which session to follow."""

    live: bool = False
    """Follow the session that is being recorded into RUN, until SIGINT: after every trial say
    whether to stop or to continue, and which start and condition to run next. With --goal also
    for each success rate."""
    recorder: Annotated[str, RARE] = "main"
    """Name of the recorder (--live)."""
    connect: Annotated[tuple[str, ...], RARE] = (DEFAULT_ENDPOINT,)
    """Where the recorder listens (--live)."""
    zenoh_config: Annotated[Path | None, Parameter(name="--config")] = None
    """zenoh configuration (JSON5), for example with access control (--live)."""
