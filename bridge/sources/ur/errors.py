"""What can be wrong between us and a UR controller."""

from bridge.errors import BridgeError


class ControllerError(BridgeError):
    """The controller is not there, not ready, or gone."""

    def __init__(self, *, where: str, found: str, hint: str) -> None:
        """Remember the address and what was found there."""
        super().__init__(f"{where}: {found}. {hint}")


class NotRtdeError(ControllerError):
    """What answers at the address does not speak RTDE, or broke its rules."""

    def __init__(self, *, where: str, found: str) -> None:
        """Remember the address and what was found there."""
        super().__init__(
            where=where,
            found=f"not a UR controller's RTDE interface: {found}",
            hint="Check the address, the port (30004) and Settings > Security > Services > RTDE.",
        )
