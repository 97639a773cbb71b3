"""The family of errors whose message a user can act on.

Every error states what was found, where, and what to do. ``exit_code`` is the status the command
line ends with (see the architecture page): 1 failed or broken file, 2 wrong use, 3 a threshold.
"""

from collections.abc import Mapping
from pathlib import Path


class GstError(Exception):
    """Base of all errors that are the user's business; anything else is a bug."""

    exit_code = 1


class BridgeError(GstError):
    """Something went wrong between the wire and the episode."""


class UsageError(GstError):
    """The command was called with something that cannot be right."""

    exit_code = 2


class OptionError(UsageError):
    """A number given on the command line or in a settings file is outside its range."""

    def __init__(self, *, name: str, value: int | float, allowed: str) -> None:
        """Name the option as it is spelt on the command line."""
        option = "--" + name.replace("_", "-")
        super().__init__(f"{option} {value:g} makes no sense; it must be {allowed}.")


def refuse_outside(
    settings: object, allowed: Mapping[str, tuple[int | float, int | float]]
) -> None:
    """Check numbers of a settings record against what is allowed, ends included."""
    for name, (least, most) in allowed.items():
        value = getattr(settings, name)
        if value is not None and not least <= value <= most:
            top = "" if most == float("inf") else f" and at most {most:g}"
            raise OptionError(name=name, value=value, allowed=f"at least {least:g}{top}")


class MissingDependencyError(GstError):
    """An optional package is not installed."""

    def __init__(self, *, package: str, extra: str, purpose: str) -> None:
        """Name the package and the extra that brings it."""
        super().__init__(
            f"{package} is not installed, and {purpose} needs it. "
            f"Install the extra: pip install 'robot-gst[{extra}]'."
        )


class PathNotFoundError(UsageError):
    """A file or folder named by the user is not there."""

    def __init__(self, *, path: Path, what: str, hint: str) -> None:
        """Name what was looked for."""
        super().__init__(f"{what} not found: {path}. {hint}")


class EpisodeError(BridgeError):
    """An episode file breaks its contract."""

    def __init__(self, *, path: Path, found: str, hint: str) -> None:
        """Name the file and what was found in it."""
        super().__init__(f"{path}: {found}. {hint}")


class SchemaVersionError(EpisodeError):
    """A record was written by a newer major version than this reader knows."""

    def __init__(self, *, path: Path, name: str, found: int, known: int) -> None:
        """Name the record, not the file alone."""
        super().__init__(
            path=path,
            found=f"{name} has schema version {found}, this reader knows {known}",
            hint="Upgrade robot-gst, or re-record with the older version.",
        )


class UndefinedStatisticError(GstError):
    """A statistic has no value on this data; the reason is the message."""

    def __init__(self, *, statistic: str, reason: str) -> None:
        """Remember the reason."""
        self.reason = reason
        super().__init__(f"{statistic} is undefined: {reason}.")


class InvalidRecordError(BridgeError):
    """A JSON record (plan, verdict, event ...) does not fit its schema."""

    def __init__(self, *, name: str, where: str, found: str) -> None:
        """Name the record and the offending place."""
        super().__init__(
            f"{name} is invalid at {where or 'the top level'}: {found}. "
            "See docs/episode_format.md for its schema."
        )
