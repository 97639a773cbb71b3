"""What can go wrong while recording."""

from pathlib import Path

from bridge.errors import BridgeError, UsageError

MAX_NAMED = 4
"""Topics that a sentence names."""


def in_short(words: list[str]) -> str:
    """Join a few of several sentences about topics, and say how many there are besides."""
    more = f"; and {len(words) - MAX_NAMED} more" if len(words) > MAX_NAMED else ""
    return "; ".join(words[:MAX_NAMED]) + more


class LifecycleError(UsageError):
    """A control command does not fit the state the recorder is in."""


class ControlError(UsageError):
    """A control command is malformed."""


class MissingTopicsError(LifecycleError):
    """An episode was not started: the contract of the cell requires topics that are not there."""

    def __init__(self, *, episode: str, missing: list[str]) -> None:
        """Remember what is not there."""
        self.missing = missing
        super().__init__(
            f"{episode} was not started: {in_short(missing)}. The contract requires it. "
            "Start its publisher, or start with --anyway."
        )


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
