"""Which RealSense cameras are published, and how. Imports nothing heavy."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from bridge.episode.topics import refuse_bad_name
from bridge.errors import BridgeError, UsageError, refuse_outside


class CameraNotFoundError(UsageError):
    """No camera with the serial number is attached."""

    def __init__(self, *, wanted: str, found: list[str]) -> None:
        """Remember what was looked for and list what is there."""
        listed = ", ".join(found) or "none"
        super().__init__(
            f"no RealSense camera {wanted}; attached: {listed}. "
            "Check the cable, the USB port and the udev rules (docs/recording.md)."
        )


class CameraStreamError(BridgeError):
    """A camera is attached but cannot send what was asked for."""

    def __init__(self, *, camera: str, found: str, hint: str) -> None:
        """Remember the camera and what was found."""
        super().__init__(f"camera {camera}: {found}. {hint}")


class MountsError(UsageError):
    """The file that says where cameras are breaks its contract."""

    def __init__(self, *, path: Path, found: str) -> None:
        """Remember the file and what was found in it."""
        super().__init__(
            f"{path}: {found}. Expected "
            '{"NAME": {"parent": FRAME, "p_m": [x, y, z], "q_wxyz": [w, x, y, z]}}.'
        )


Size = Literal["640x480", "848x480", "1280x720"]
DEFAULT_CAMERA = "camera"


@dataclass(frozen=True, kw_only=True)
class RealSenseConfig:
    """Which cameras are published, and how."""

    cell: str = "cell"
    """Name of the cell in topics: /CELL/cam/CAMERA/color/image."""
    camera: tuple[str, ...] = ()
    """NAME=SERIAL, once for each camera; without it the only attached one is named camera."""
    size: Size = "640x480"
    """Width and height of colour and depth images."""
    fps: int = 30
    """Frames per second."""
    color: Literal["jpeg", "raw"] = "jpeg"
    """Compress colour here, or leave it to the recorder."""
    quality: int = 90
    """JPEG quality, with --color jpeg."""
    mounts: Path | None = None
    """JSON file that says where the colour cameras are: {"NAME": {"parent": FRAME, "p_m": [x, y,
    z], "q_wxyz": [w, x, y, z]}}, the transform T_parent_color."""
    shared_memory_mb: int = 0
    """Shared memory for images to a recorder on this machine [MB]; 0: over the network."""

    def __post_init__(self) -> None:
        """Refuse names that cannot be part of a topic, and one camera twice."""
        refuse_bad_name("cell", self.cell)
        wanted = self.serials()
        if len(wanted) < len(self.camera) or len(set(wanted.values())) < len(wanted):
            raise UsageError(
                f"--camera {' '.join(self.camera)} names a camera twice. "
                "Give each name and each serial number once."
            )
        refuse_outside(self, {"fps": (1, 300), "quality": (1, 100), "shared_memory_mb": (0, 65536)})

    def serials(self) -> dict[str, str]:
        """Map camera names to serial numbers; empty when none was given."""
        wanted = {}
        for item in self.camera:
            name, _, serial = item.partition("=")
            if not serial:
                raise UsageError(
                    f"--camera {item} has no serial number. Write NAME=SERIAL, for example "
                    "side=123622270224; robot-gst publish realsense --list shows what is attached."
                )
            refuse_bad_name("camera", name)
            wanted[name] = serial
        return wanted

    def pixels(self) -> tuple[int, int]:
        """Width and height [px]."""
        width, height = self.size.split("x")
        return int(width), int(height)
