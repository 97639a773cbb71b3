"""Errors of the review pages that a user can act on."""

from bridge.errors import GstError


class DashboardError(GstError):
    """The review pages cannot be served."""


class NotHereError(DashboardError):
    """A page, run, episode or camera that does not exist was asked for."""
