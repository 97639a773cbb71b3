"""Errors of the review pages that a user can act on."""

from bridge.errors import GstError


class DashboardError(GstError):
    """The review pages cannot be served."""


class AddressTakenError(DashboardError):
    """The address to listen on belongs to another program, or cannot be bound."""

    def __init__(self, *, host: str, port: int, reason: str) -> None:
        """Remember the address and what the system said."""
        self.host = host
        self.port = port
        super().__init__(
            f"cannot listen on {host} port {port}: {reason}. "
            "Choose another port with --port, or --port 0 for any free one."
        )


class NotHereError(DashboardError):
    """A page, run, episode or camera that does not exist was asked for."""
