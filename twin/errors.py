"""Errors of rebuilding and replaying that a user can act on."""

from pathlib import Path

from bridge.errors import GstError


class TwinError(GstError):
    """The twin cannot do what was asked."""


class UnreadableFileError(TwinError):
    """A file is damaged, from a newer version, or of another kind."""

    hint = "Make it again: robot-gst rebuild RUN --force."

    def __init__(self, *, path: Path, found: str, hint: str = "") -> None:
        """Remember what is wrong with the file."""
        self.found = found
        super().__init__(f"{path}: {found}. {hint or self.hint}")
