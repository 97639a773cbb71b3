"""Errors of rebuilding and replaying that a user can act on."""

from bridge.errors import GstError


class TwinError(GstError):
    """The twin cannot do what was asked."""
