"""What can go wrong while recording."""

import errno
from pathlib import Path

from bridge.errors import BridgeError, UsageError

MAX_NAMED = 4


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


_WORDS = {
    errno.EIO: "the disk, or the connection to it, is failing",
    errno.EROFS: "the system has stopped writing to this disk, often after an error of it",
    errno.ENOENT: "somebody changed the file or its folder",
    errno.ESTALE: "the folder on the network was removed or replaced",
}


def cause_of(error: OSError) -> str:
    """Say what a disk said, in words a person can act on."""
    said = error.strerror or str(error)
    words = _WORDS.get(error.errno or 0)
    return f"{said} ({words})" if words else said


class FolderTakenError(UsageError):
    """Another recorder writes into the folder."""

    def __init__(self, *, run: Path) -> None:
        """Name the folder."""
        super().__init__(
            f"another recorder records into {run} already. Stop it, or give this one a run folder "
            "of its own."
        )


class NoSpaceError(BridgeError):
    """An episode was not started: the disk has too little space."""

    def __init__(self, *, folder: Path, free_mb: int, wanted_mb: int) -> None:
        """Say how much there was."""
        super().__init__(
            f"{folder} has {free_mb} MB free, and {wanted_mb} MB must be left. Free some space, "
            "choose another disk, or lower --min-free-mb and --footer-mb."
        )


class DiskError(BridgeError):
    """The disk ended a recording."""

    def __init__(self, *, path: Path, cause: str, is_finished: bool) -> None:
        """Name the file, and whether it could be finished."""
        kept = (
            "The episode was finished with all that was written until then"
            if is_finished
            else "What was written until then is in that file; robot-gst recover finishes it"
        )
        super().__init__(
            f"cannot write {path}: {cause}. The recorder stopped. {kept}. "
            "Free some space or choose another disk, then record again."
        )
