"""What can be wrong with a source."""

from pathlib import Path

from bridge.errors import UsageError


class FolderError(UsageError):
    """An RGB-D folder breaks its contract."""

    def __init__(self, *, path: Path, found: str, hint: str) -> None:
        """Remember the file and what was found in it."""
        self.path = path
        self.found = found
        super().__init__(f"{path}: {found}. {hint}")
