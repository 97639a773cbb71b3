"""Settings of the review pages."""

from dataclasses import dataclass

from bridge.errors import refuse_outside

PORTS = {"port": (0, 65_535)}


@dataclass(frozen=True, kw_only=True)
class DashboardConfig:
    """Where ``robot-gst dashboard`` listens."""

    host: str = "127.0.0.1"
    """Address to listen on; anything but the loopback address asks for a token."""
    port: int = 8600
    """Port to listen on; 0 takes any free one."""

    def __post_init__(self) -> None:
        """Refuse a port that no machine has."""
        refuse_outside(self, PORTS)
