"""Where a session connects and listens. Imports nothing heavy, so that commands can show it."""

from dataclasses import dataclass
from pathlib import Path

LOOPBACK = ("tcp/127.0.0.1:7447",)
"""The recorder listens here; loopback, so nobody outside this machine can reach it."""


@dataclass(frozen=True, kw_only=True)
class WireConfig:
    """How to open a zenoh session."""

    mode: str = "client"
    """client, peer or router; the recorder is the router, everyone else a client of it."""
    connect: tuple[str, ...] = LOOPBACK
    """Endpoints to connect to."""
    listen: tuple[str, ...] = ()
    """Endpoints to listen on."""
    config: Path | None = None
    """A zenoh configuration file (JSON5) to start from, for example with access control."""
    shared_memory_mb: int = 0
    """Shared memory for the images this session publishes [MB]; 0 sends them over the network."""
    connect_timeout_s: float = 3.0
    """Give up when no endpoint has answered after this long [s]."""
