"""How an RGB-D folder is turned into messages. Imports nothing heavy."""

import re
from dataclasses import dataclass

from bridge.errors import UsageError, refuse_outside

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")


@dataclass(frozen=True, kw_only=True)
class FolderConfig:
    """How a folder is turned into messages."""

    cell: str = "kitchen"
    """Name of the cell in topics: /<cell>/cam/<camera>/color/image."""
    camera: str = "kinect"
    """Name of the camera in topics and frames."""
    rate_hz: float = 30.0
    """Frames per second; stamps are this far apart."""
    max_frames: int | None = None
    """Stop after so many frames."""

    def __post_init__(self) -> None:
        """Refuse names that cannot be part of a topic, and a rate that is none."""
        for what, name in (("cell", self.cell), ("camera", self.camera)):
            if not _NAME.fullmatch(name):
                raise UsageError(
                    f"{what} name {name!r} cannot be part of a topic. "
                    "Use letters, digits and '_', starting with a letter."
                )
        refuse_outside(self, {"rate_hz": (0.001, 1000), "max_frames": (1, 10**9)})
