"""Places to meet on this machine alone."""

import socket


def free_endpoint() -> str:
    """A zenoh endpoint on the loopback address at which nobody listens."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"
