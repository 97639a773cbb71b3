"""Settings of ``calibrate``; imports nothing heavy, so that --help is quick."""

from dataclasses import dataclass
from typing import Annotated, Literal

from cyclopts import Parameter

from bridge.errors import refuse_outside
from bridge.terminal import RARE

Mount = Literal["auto", "hand", "fixed"]


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class CalibrateConfig:
    """What to find out, and from which data."""

    cameras: bool = False
    """Where the cameras are, written to RUN/scene/calibration.json."""
    physics: bool = False
    """Motion of the arm and friction of pushes from imported recordings, used where held-out ones
    confirm it, and masses from the joint efforts of trials; to RUN/scene/calibration.json."""
    posterior: bool = False
    """Which friction, masses, force and common shift agree with the trials executed in this run,
    written to RUN/scene/calibration.json; samples of replays and of the gate then draw from it."""
    draws: Annotated[int, RARE] = 64
    """With --posterior: draws from the priors, each replayed through every trial."""
    camera: str = ""
    """Only this camera."""
    mount: Mount = "auto"
    """Where the camera of a target sits: in the hand, or fixed with the target in the hand; auto:
    whichever explains the pairs."""
    link: str = ""
    """Link that carries camera or target: tool0, or where there is none the robot's tool frame."""
    workers: int | None = None
    """With --physics and --posterior: processes side by side; none: one a core, at most 8."""

    def __post_init__(self) -> None:
        """Refuse numbers with which nothing can be found."""
        refuse_outside(self, {"workers": (1, 1024), "draws": (2, 100_000)})
