"""Settings of ``rebuild`` and ``render``; imports nothing heavy, so that --help is quick."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from bridge.errors import UsageError, refuse_outside
from bridge.terminal import RARE

_DURATION = re.compile(r"^\s*(\d+(?:\.\d+)?)\s*(s|sec|min|m|h)?\s*$")
_SECONDS = {None: 1.0, "s": 1.0, "sec": 1.0, "min": 60.0, "m": 60.0, "h": 3600.0}
MOST_S = 1e6
"""Eleven days: longer is a number gone wrong."""
DEFAULT_BUDGET_S = 60.0
"""Wall time of a fit when neither a time nor a number of images is given."""


def convert_duration(_type: Any, tokens: Sequence[Any]) -> float:
    """Let a command-line option take ``60s``, ``2min``, ``1h`` or plain seconds."""
    match = _DURATION.match(tokens[0].value)
    if match is None:
        message = f"{tokens[0].value!r} is not a duration. Write 60s, 2min, 1h or plain seconds."
        raise ValueError(message)
    return float(match[1]) * _SECONDS[match[2]]


@Parameter(name="*", group="Frames")
@dataclass(frozen=True, kw_only=True)
class FrameConfig:
    """Which frames are used for what."""

    max_train_frames: int = 100
    """Frames to fit, shared evenly by episodes and cameras."""
    train_every: Annotated[int, RARE] = 0
    """Learn from every this many frames: a fixed protocol. 0: evenly along the camera's path."""
    holdout_every: int = 8
    """Every this many frames of a camera, the middle one is kept out of everything: initialisation,
    poses, exposure, fit, objects."""
    max_holdout_frames: Annotated[int, RARE] = 24
    """Held-out frames to render, spread evenly."""
    max_depth_m: float = 5.0
    """Depth beyond is not trusted."""
    poses: Literal["auto", "tf", "odometry"] = "auto"
    """Where cameras are. tf: /tf; odometry: from the images themselves; auto: what calibrate found,
    else /tf, else odometry."""
    check_poses: Annotated[bool, RARE] = True
    """Refuse poses that fit the depth only when read in another convention, and cameras that move
    while their poses stand still."""

    def __post_init__(self) -> None:
        """Refuse to hold out every frame, or to learn from none."""
        least = {"holdout_every": 2, "train_every": 0}
        least |= {"max_train_frames": 1, "max_holdout_frames": 1}
        refuse_outside(self, {name: (value, math.inf) for name, value in least.items()})
        refuse_outside(self, {"max_depth_m": (0.1, 1000.0)})


@Parameter(name="*", group="Initialisation")
@dataclass(frozen=True, kw_only=True)
class InitialiseConfig:
    """From depth images to the first Gaussians."""

    max_splats: int = 60_000
    """Budget of the whole fit."""
    flying_fraction: Annotated[float, RARE] = 0.03
    """A pixel whose depth differs from a neighbour's by more than this share is dropped."""

    def __post_init__(self) -> None:
        """Refuse an empty budget."""
        refuse_outside(self, {"max_splats": (1, math.inf), "flying_fraction": (1e-3, 10.0)})

    @property
    def first_splats(self) -> int:
        """Most of the first Gaussians: half; the fit splits them where the error is large."""
        return max(round(self.max_splats / 2), 1)


@Parameter(name="*", group="Fit")
@dataclass(frozen=True, kw_only=True)
class FitConfig:
    """How the Gaussians are fitted to the images."""

    budget_s: Annotated[float | None, Parameter(name="--budget", converter=convert_duration)] = None
    """Wall time for initialisation and fit: 60s, 2min or plain seconds; 60s without --iterations.
    With --iterations it is only a limit, none by default: where it strikes first, the scene is
    reported as underfitted. Reading the frames before and all that is made of the scene afterwards
    come on top."""
    iterations: int = 0
    """Fit exactly this many images: the result is then reproducible, on slow machines too."""
    seed: int = 0
    """Order of the frames, and nothing else: the rest leaves nothing to chance."""
    threads: Annotated[int, RARE] = 0
    """0: all cores. The result does not depend on it."""

    def __post_init__(self) -> None:
        """Refuse a fit that never ends, or never begins."""
        refuse_outside(self, dict.fromkeys(("iterations", "seed", "threads"), (0, math.inf)))
        if self.budget_s is not None and not 0 < self.budget_s <= MOST_S:
            message = f"--budget {self.budget_s:g} s is no time to fit in; give more than 0."
            raise UsageError(message)

    @property
    def limit_s(self) -> float:
        """Wall time after which the fit ends; infinite when only images are counted."""
        if self.budget_s is None:
            return math.inf if self.iterations else DEFAULT_BUDGET_S
        return self.budget_s


@Parameter(name="*", group="Foundation models")
@dataclass(frozen=True, kw_only=True)
class ModelConfig:
    """Which large models to ask, see docs/foundation_models.md; none by default.

    Each is a local folder of weights. Nothing is ever downloaded.
    """

    segmenter: str = ""
    """Find things in images with sam3:FOLDER instead of the default segmenter."""
    prompt: tuple[str, ...] = ()
    """What the segmenter looks for, once for each; default: the names of the task's objects."""
    clip: str = ""
    """Folder of CLIP: find --clip then finds by meaning, not by the words of the lexicon."""
    device: str = "auto"
    """Where they run: cpu, cuda, cuda:1; auto takes a GPU if there is one."""

    @property
    def any_named(self) -> bool:
        """Whether a model is to be asked at all."""
        return bool(self.segmenter or self.clip)


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
    models: ModelConfig = ModelConfig()
    """Which large models to ask."""
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
    at_s: float | None = None
    """Seconds after the episode's first sample, by the stamps of its source as on the dashboard;
    when messages arrived does not count. Without it an --episode is drawn from its start to its
    end, and one image is drawn at 0 s."""
    size: str = ""
    """WIDTHxHEIGHT of the images in pixels; default: as recorded."""
    compare: bool = False
    """Of a whole episode: show recorded image, twin and their difference side by side, and measure
    how much they agree."""
    eye: tuple[float, float, float] | None = None
    """Stand here instead, in metres in the scene's frame; needs --target."""
    target: tuple[float, float, float] | None = None
    """Look at this point, in metres in the scene's frame."""
    depth: bool = False
    """Write two more images: the depth in millimetres, and, white, what was measured in the scan;
    black is what was completed or never seen."""
    backend: Literal["auto", "cpu", "cuda"] = "cpu"
    """What draws: our own code, or gsplat on a CUDA device; auto takes a GPU if there is one."""
    out: Path | None = None
    """File to write; default: RUN/results/render.png. A whole episode: an .mp4 file, or a folder
    for one PNG a frame; default: RUN/results/EPISODE.CAMERA.mp4."""

    def __post_init__(self) -> None:
        """Refuse numbers that are none."""
        refuse_outside(self, {"at_s": (0.0, MOST_S)})
        if self.out is not None and self.out.suffix.lower() == ".ply":
            message = (
                f"--out {self.out}: render writes images. The scene's Gaussians are "
                "RUN/scene/background.ply and RUN/scene/objects/*/gaussians.ply."
            )
            raise UsageError(message)
        for name, place in (("eye", self.eye), ("target", self.target)):
            if place is not None and not all(math.isfinite(value) for value in place):
                message = f"--{name} {place} is no place: three numbers in metres."
                raise UsageError(message)

    @property
    def is_sequence(self) -> bool:
        """Whether a whole episode is drawn, and not one image."""
        if self.out is not None and self.out.suffix.lower() == ".png":
            return False
        return self.at_s is None and bool(self.episode)
