"""Settings of ``rebuild`` and ``render``; imports nothing heavy, so that --help is quick."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from bridge.errors import UsageError

_DURATION = re.compile(r"^\s*(\d+(?:\.\d+)?)\s*(s|sec|min|m|h)?\s*$")
_SECONDS = {None: 1.0, "s": 1.0, "sec": 1.0, "min": 60.0, "m": 60.0, "h": 3600.0}


def parse_duration_s(text: str) -> float:
    """Read ``60s``, ``2min``, ``1h`` or plain seconds.

    Raises:
        UsageError: When the text is none of these.
    """
    match = _DURATION.match(text)
    if match is None:
        message = f"{text!r} is not a duration. Write 60s, 2min, 1h or plain seconds."
        raise UsageError(message)
    return float(match[1]) * _SECONDS[match[2]]


def convert_duration(_type: Any, tokens: Sequence[Any]) -> float:
    """Let a command-line option take a duration."""
    try:
        return parse_duration_s(tokens[0].value)
    except UsageError as error:
        raise ValueError(str(error)) from error


def _refuse_below(least: int, **options: int) -> None:
    """Refuse settings that nothing can be made with."""
    for name, value in options.items():
        if value < least:
            message = f"--{name.replace('_', '-')} {value} is too small: at least {least}."
            raise UsageError(message)


@Parameter(name="*", group="Frames")
@dataclass(frozen=True, kw_only=True)
class FrameConfig:
    """Which frames are used for what."""

    max_train_frames: int = 100
    """Frames to fit, spread evenly over episodes, cameras and time."""
    holdout_every: int = 8
    """Every this many frames of a camera, one is kept out of initialisation and fit."""
    max_holdout_frames: int = 24
    """Held-out frames to render, spread evenly."""
    max_depth_m: float = 5.0
    """Depth beyond is not trusted."""

    def __post_init__(self) -> None:
        """Refuse to hold out every frame, or to learn from none."""
        _refuse_below(2, holdout_every=self.holdout_every)
        _refuse_below(1, max_train_frames=self.max_train_frames)
        _refuse_below(1, max_holdout_frames=self.max_holdout_frames)


@Parameter(name="*", group="Initialisation")
@dataclass(frozen=True, kw_only=True)
class InitialiseConfig:
    """From depth images to the first Gaussians."""

    max_splats: int = 60_000
    """Budget: voxels grow until the number of Gaussians fits."""
    footprint_factor: float = 1.6
    """Voxel size in pixel footprints z/f."""
    flatness: float = 0.1
    """Standard deviation along the normal, as a fraction of the one in the plane."""
    opacity: float = 0.95
    """Opacity of a new Gaussian."""
    flying_fraction: float = 0.03
    """A pixel whose depth differs from a neighbour's by more than this share is dropped."""

    def __post_init__(self) -> None:
        """Refuse an empty budget and an opacity without a logit."""
        _refuse_below(1, max_splats=self.max_splats)
        if not 0 < self.opacity < 1:
            message = f"--opacity {self.opacity:g} does not lie between 0 and 1."
            raise UsageError(message)


@Parameter(name="*", group="Fit")
@dataclass(frozen=True, kw_only=True)
class FitConfig:
    """How the Gaussians are fitted to the images."""

    budget_s: Annotated[float, Parameter(name="--budget", converter=convert_duration)] = 60.0
    """Wall time for the fit: 60s, 2min or plain seconds."""
    iterations: int = 0
    """Fit exactly this many images instead of a time; the result is then reproducible."""
    loss: Literal["3dgs", "paper"] = "3dgs"
    """3dgs: 0.8 L1 + 0.2 (1 - SSIM); paper: squared error (Eq. 3). Both with depth L1."""
    depth_weight: float = 0.1
    """Weight of the L1 depth term (the paper's lambda_d), relative to depth."""
    coarse_fraction: float = 0.6
    """Share of the budget spent at half resolution."""
    seed: int = 0
    """Order of the frames."""
    threads: int = 0
    """0: all cores. The result does not depend on it."""

    def __post_init__(self) -> None:
        """Refuse a fit that never ends, or never begins."""
        _refuse_below(0, iterations=self.iterations)
        if self.iterations == 0 and not self.budget_s > 0:
            message = f"--budget {self.budget_s:g} s leaves no time to fit; give more than 0."
            raise UsageError(message)


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class RebuildConfig:
    """Everything ``rebuild`` can be told."""

    frames: FrameConfig = FrameConfig()
    """Which frames are used for what."""
    initialise: InitialiseConfig = InitialiseConfig()
    """From depth images to the first Gaussians."""
    fit: FitConfig = FitConfig()
    """How the Gaussians are fitted to the images."""
    force: bool = False
    """Redo work that is already done."""


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class RenderConfig:
    """Which view of the rebuilt scene to draw."""

    episode: str = ""
    """Take camera and pose from this recorded episode; empty: the first of the scene."""
    camera: str = ""
    """Camera id; empty: the episode's first."""
    at_s: float = 0.0
    """Seconds after the episode's start."""
    eye: tuple[float, float, float] | None = None
    """Stand here instead, in metres in the scene's frame; needs --target."""
    target: tuple[float, float, float] | None = None
    """Look at this point, in metres in the scene's frame."""
    depth: bool = False
    """Write a second image with the depth, in millimetres."""
    out: Path | None = None
    """File to write; default: RUN/results/render.png."""
