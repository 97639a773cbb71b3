"""Settings of ``calibrate``; imports nothing heavy, so that --help is quick."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from bridge.errors import refuse_outside
from twin.scene.settings import convert_duration

Mount = Literal["auto", "hand", "fixed"]


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class CalibrateConfig:
    """What to find out, and from which data."""

    cameras: bool = False
    """Where the cameras are, written to RUN/scene/calibration.json."""
    physics: bool = False
    """Friction, masses, forces and pose bias from executed probes and trials, written to
    RUN/scene/calibration.json where held-out episodes confirm them."""
    posterior: bool = False
    """Which friction, masses, force and common shift agree with the trials executed in this run,
    written to RUN/scene/calibration.json; samples of replays and of the gate then draw from it."""
    draws: int = 64
    """With --posterior: draws from the priors, each replayed through every trial."""
    pairs: Path | None = None
    """JSON file of pose pairs (T_base_effector, T_camera_target), for --camera."""
    camera: str = ""
    """Only this camera; with --pairs, the one the pairs belong to."""
    mount: Mount = "auto"
    """Where the camera of a target sits: in the hand, or fixed with the target in the hand; auto:
    whichever explains the pairs."""
    link: str = "tool0"
    """Link that carries the camera, or the target of a fixed camera."""
    seed: int = 0
    """Of the resampling behind the intervals; with --physics, of the search and of which episodes
    are held out."""
    evaluations: int = 50
    """With --physics: points the search tries; the intervals take about 60 more."""
    budget_s: Annotated[float, Parameter(name="--budget", converter=convert_duration)] = 3600.0
    """With --physics: a last resort, named where it strikes: wall time after which the search ends
    before its last point: 1h, 10min or plain seconds."""
    workers: int | None = None
    """With --physics and --posterior: processes that simulate side by side; one for each core, at
    most 8, when no number is given."""

    def __post_init__(self) -> None:
        """Refuse a number of postures nothing can be found from."""
        refuse_outside(
            self,
            {
                "seed": (0, 2**31),
                "evaluations": (1, 100_000),
                "budget_s": (0, float("inf")),
                "workers": (1, 1024),
                "draws": (2, 100_000),
            },
        )
