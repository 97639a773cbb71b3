"""What can go wrong on the wire, in sentences a user can act on."""

import re

from bridge.errors import BridgeError, UsageError

_WITH_CERTIFICATES = ("tls/", "quic/", "wss/")
_ADDRESS = re.compile(r"^[a-z0-9_-]+/(\[[0-9a-f:]+\]|[^:/]+)")
_BEHIND_HASH = re.compile(r"#[^\s,\])]*")
_SOURCE_LINE = re.compile(r"\s+at /\S+\.rs:\d+\.?\]?")


class WireError(BridgeError):
    """The session could not do what was asked."""


class NoPeerError(WireError):
    """Nobody listens at the endpoints we should connect to."""

    def __init__(self, *, endpoints: tuple[str, ...]) -> None:
        """Name the endpoints that were tried."""
        where = " or ".join(public(endpoint) for endpoint in endpoints)
        refused = ""
        if any(endpoint.startswith(_WITH_CERTIFICATES) for endpoint in endpoints):
            refused = " Or it refused us: it may want a certificate, given with --config."
        super().__init__(
            f"no zenoh peer at {where}; "
            f"start robot-gst record RUN first or pass --connect with its address.{refused}"
        )


class PortTakenError(WireError):
    """Another process listens where we should."""

    def __init__(self, *, endpoint: str) -> None:
        """Name the endpoint that is in use."""
        super().__init__(
            f"{public(endpoint)} is in use by another process, perhaps a second recorder or a "
            "zenoh router. Stop it, or pass --listen with another port (for example "
            "tcp/127.0.0.1:7448)."
        )


class WireConfigError(UsageError):
    """The endpoints or the zenoh configuration file cannot be used."""


class BadTopicError(UsageError):
    """A topic name cannot travel on zenoh."""

    def __init__(self, *, topic: str, found: str) -> None:
        """Name the topic."""
        super().__init__(
            f"topic {topic!r} cannot be published: {found}. "
            "A topic starts with one slash, has no empty parts and none of * $ ? #."
        )


class RemoteError(WireError):
    """The other side refused a request; the message is its own."""


class NoReplyError(WireError):
    """Nobody answered a request in time."""

    def __init__(self, *, key: str, timeout_s: float) -> None:
        """Name what was asked and how long we waited."""
        super().__init__(
            f"nobody answered on {key} (waited at most {timeout_s:g} s). "
            "Is the other side running, and is its name spelled as it was started?"
        )


def cause_of(error: Exception) -> str:
    """The first sentence of a zenoh error without source paths and endpoint settings."""
    return public(_SOURCE_LINE.sub("", str(error))).strip().rstrip(".")


def public(text: str) -> str:
    """Leave out the settings that may follow an endpoint's ``#``: keys can stand there."""
    return _BEHIND_HASH.sub("", text)


def is_loopback(endpoint: str) -> bool:
    """Say whether an endpoint can only be reached from this machine."""
    if endpoint.startswith("unix"):
        return True
    found = _ADDRESS.match(endpoint)
    return bool(found) and found.group(1) in ("127.0.0.1", "localhost", "[::1]")  # type: ignore[union-attr]
