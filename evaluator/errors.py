"""Errors of evaluation that a user can act on."""

from bridge.errors import GstError


class EvaluatorError(GstError):
    """The data does not support what was asked of it."""


class UndefinedStatisticError(EvaluatorError):
    """A statistic has no value on this data; the reason is the message."""

    def __init__(self, *, statistic: str, reason: str) -> None:
        """Remember the statistic's name and the reason."""
        self.statistic = statistic
        self.reason = reason
        super().__init__(f"{statistic} is undefined: {reason}.")
