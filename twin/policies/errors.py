"""What goes wrong with a policy, as its user is told."""

from twin.errors import TwinError


class PolicyError(TwinError):
    """A policy, its server or its mapping cannot be used as it is."""


class StoppedError(TwinError):
    """The cell would have stopped here, as its controller or its safety settings do."""

    def __init__(self, *, name: str, detail: str) -> None:
        """Remember which limit it was.

        Args:
            name: The limit, in the words of the gate: limits, start, contact_force ...
        """
        self.name = name
        super().__init__(f"{name}: {detail}")


class RefusedError(StoppedError):
    """A target was refused before anything moved."""
