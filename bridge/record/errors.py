"""What can go wrong while recording."""

from pathlib import Path

from bridge.errors import BridgeError, UsageError


class LifecycleError(UsageError):
    """A control command does not fit the state the recorder is in."""


class ControlError(UsageError):
    """A control command is malformed."""


class NoSpaceError(BridgeError):
    """An episode was not started: the disk has too little space."""

    def __init__(self, *, folder: Path, free_mb: int, wanted_mb: int) -> None:
        """Remember how much there was."""
        self.folder = folder
        super().__init__(
            f"{folder} has {free_mb} MB free, and {wanted_mb} MB must be left. Free some space, "
            "choose another disk, or lower --min-free-mb and --footer-mb."
        )


class DiskError(BridgeError):
    """The disk ended a recording."""

    def __init__(self, *, path: Path, cause: str, is_finished: bool) -> None:
        """Remember the file, and whether it could be finished."""
        self.path = path
        self.is_finished = is_finished
        kept = (
            "The episode was finished with all that was written until then"
            if is_finished
            else "What was written until then is in that file; robot-gst recover finishes it"
        )
        super().__init__(
            f"cannot write {path}: {cause}. The recorder stopped. {kept}. "
            "Free some space or choose another disk, then record again."
        )
