"""What can go wrong while recording."""

from pathlib import Path

from bridge.errors import BridgeError, UsageError


class LifecycleError(UsageError):
    """A control command does not fit the state the recorder is in."""


class ControlError(UsageError):
    """A control command is malformed."""


class DiskError(BridgeError):
    """The episode could not be written; only its ``.part`` file is left."""

    def __init__(self, *, part_path: Path, cause: str) -> None:
        """Remember the file that was being written."""
        self.part_path = part_path
        super().__init__(
            f"cannot write {part_path}: {cause}. The recorder stopped; what was written until "
            "then is in that file. Free some space or choose another disk, then record again."
        )
