"""What can be wrong with a RealSense camera."""

from pathlib import Path

from bridge.errors import BridgeError, UsageError


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
