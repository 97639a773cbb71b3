"""Settings of the review pages; imports nothing heavy."""

from dataclasses import dataclass
from pathlib import Path

from cyclopts import Parameter

from bridge.errors import refuse_outside
from bridge.wire.config import LOOPBACK

PORTS = {"port": (0, 65_535)}


@dataclass(frozen=True, kw_only=True)
class DashboardConfig:
    """Where ``robot-gst dashboard`` listens."""

    host: str = "127.0.0.1"
    """Address to listen on; anything but the loopback address asks for a token."""
    port: int = 8600
    """Port to listen on; 0 takes any free one."""
    recorder: str = "main"
    """Name of the recorder that the page Live listens to."""
    connect: tuple[str, ...] = LOOPBACK
    """Where that recorder is; nothing is opened before somebody looks at the page."""
    live_config: Path | None = None
    """zenoh configuration (JSON5) for that, for example with access control."""

    def __post_init__(self) -> None:
        """Refuse a port that no machine has."""
        refuse_outside(self, PORTS)


SHARE_LIMITS = {"max_mb": (0.01, 20.0)}


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class ShareConfig:
    """Which trials go into one file, and how large it may be."""

    trials: tuple[str, ...] = ()
    """Ids of trials; without any the worst disagreements, else the worst failures."""
    out: Path | None = None
    """File to write; RUN/results/shared/trials.html, which the report then names, without it."""
    max_mb: float = 20.0
    """Size of the file; clips get fewer and smaller frames until it fits."""

    def __post_init__(self) -> None:
        """Refuse what no file can be."""
        refuse_outside(self, SHARE_LIMITS)
