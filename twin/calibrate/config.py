"""Settings of ``calibrate``; imports nothing heavy, so that --help is quick."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from cyclopts import Parameter

from bridge.errors import refuse_outside

Mount = Literal["auto", "hand", "fixed"]


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class CalibrateConfig:
    """What to find out, and from which data."""

    cameras: bool = False
    """Where the cameras are, written to RUN/scene/calibration.json."""
    physics: bool = False
    """Friction, masses and timing from executed plans; not part of this version."""
    pairs: Path | None = None
    """JSON or CSV file of pose pairs (T_base_effector, T_camera_target), for --camera."""
    camera: str = ""
    """Only this camera; with --pairs, the one the pairs belong to."""
    mount: Mount = "auto"
    """Where the camera of a target sits: in the hand, or fixed with the target in the hand; auto:
    whichever explains the pairs."""
    link: str = "tool0"
    """Link that carries the camera, or the target of a fixed camera."""
    max_postures: int = 6
    """A fixed camera is found from the robot in this many different postures."""
    seed: int = 0
    """Of the resampling behind the intervals."""

    def __post_init__(self) -> None:
        """Refuse a number of postures nothing can be found from."""
        refuse_outside(self, {"max_postures": (1, 50), "seed": (0, 2**31)})
