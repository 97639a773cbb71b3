"""The policy of plans to which a vision-language model adds, and where that model may be."""

from urllib.parse import urlsplit

from bridge.errors import UsageError

MODEL_POLICY = "model"
"""The policy of plans that keep what a vision-language model added to the stages."""


def server_of(url: str) -> tuple[str, str, int, str]:
    """Scheme, host, port and path of a model server's base address."""
    try:
        parts = urlsplit(url)
        host, port = parts.hostname or "", parts.port
    except ValueError as error:
        raise UsageError(f"the model's address cannot be read: {error}.") from error
    if parts.scheme not in ("http", "https") or not host:
        raise UsageError("the model's address must begin with http:// or https:// and name a host.")
    if "@" in parts.netloc or parts.query or parts.fragment:
        raise UsageError(
            "the model's address must hold no user, query or fragment. Put the key into the "
            "environment variable instead."
        )
    return parts.scheme, host, port or (443 if parts.scheme == "https" else 80), parts.path
