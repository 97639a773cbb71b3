"""Everything a fit has reached, and the file it is kept in so that it can go on."""

import io
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float

from bridge.whole_file import write_whole
from twin.scene.fit.camera_correction import CameraCorrections
from twin.scene.fit.surface_prior import SurfacePrior
from twin.scene.gaussians.cloud import GaussianCloud, arrays
from twin.scene.raster.session import FitSession

FIT_STATE = "fit.npz"
"""In the scene folder while a fit runs, or after one that was interrupted."""
STATE_VERSION = 2
SCALARS = ("coarse_steps", "events_done", "num_split", "num_pruned", "colour_steps")
CAMERA_ARRAYS = ("values", "first", "second", "counts")
SURFACE_ARRAYS = ("normals", "heights_m", "sizes_m")


@dataclass(kw_only=True)
class FitState:
    """A fit between two steps; the only thing that changes while fitting."""

    session: FitSession
    """The cloud, the moments of Adam and the number of images seen."""
    size_m: float
    """Median size of the first Gaussians; positions move in units of it."""
    gains: Float[np.ndarray, "num_views 3"]
    cameras: CameraCorrections
    surface: SurfacePrior
    """Where the Gaussians began."""
    seconds: float = 0.0
    """Time spent so far."""
    coarse_steps: int = 0
    events_done: int = 0
    """How much of the schedule of colour solutions and splits is behind."""
    num_split: int = 0
    num_pruned: int = 0
    colour_steps: int = 0
    errors: list[float] = field(default_factory=list)
    """Mean squared errors of the last images."""


@dataclass(frozen=True, kw_only=True)
class Checkpoint:
    """Where an interrupted fit goes on from."""

    path: Path
    key: str
    """Names the inputs and settings; a file of others is not used."""
    period_s: float = 10.0
    """At most this much is lost."""


def first_state(session: FitSession, num_views: int) -> FitState:
    """Before the first image."""
    return FitState(
        session=session,
        size_m=float(np.median(np.exp(session.cloud.scales_log.max(axis=1)))),
        gains=np.ones((num_views, 3)),
        cameras=CameraCorrections.none(num_views),
        surface=SurfacePrior.of(session.cloud),
    )


def save_state(checkpoint: Checkpoint, state: FitState) -> None:
    """Write the state whole; plain arrays, nothing that runs when read."""
    content: dict[str, np.ndarray] = {
        "key": np.array(checkpoint.key),
        "version": np.array(STATE_VERSION),
        "seconds": np.array(state.seconds),
        "size_m": np.array(state.size_m),
        "steps": np.array(state.session.steps),
        "errors": np.array(state.errors, dtype=np.float64),
        "gains": state.gains,
    }
    content |= {name: np.array(getattr(state, name)) for name in SCALARS}
    content |= {f"cameras.{name}": getattr(state.cameras, name) for name in CAMERA_ARRAYS}
    content |= {f"surface.{name}": getattr(state.surface, name) for name in SURFACE_ARRAYS}
    moments = state.session.moments
    for name, rows in arrays(state.session.cloud):
        content[f"cloud.{name}"] = rows
        content[f"first.{name}"], content[f"second.{name}"] = moments[name]
    buffer = io.BytesIO()
    np.savez(buffer, **content)  # type: ignore[arg-type]  # numpy's stub takes the names for options
    write_whole(checkpoint.path, buffer.getvalue())


def load_state(
    checkpoint: Checkpoint, make_session: Callable[[GaussianCloud], FitSession]
) -> FitState | None:
    """Read the state of an interrupted fit of the same inputs and settings; None if there is none.

    A damaged file, or one of another version, is none.
    """
    try:
        whole = io.BytesIO(checkpoint.path.read_bytes())
        with np.load(whole, allow_pickle=False) as stored:
            content = {name: stored[name] for name in stored.files}
        if str(content["key"]) != checkpoint.key or int(content["version"]) != STATE_VERSION:
            return None
        return _state_from(content, make_session)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None


def _state_from(
    content: dict[str, np.ndarray], make_session: Callable[[GaussianCloud], FitSession]
) -> FitState:
    def part(prefix: str) -> dict[str, np.ndarray]:
        begin = len(prefix)
        return {name[begin:]: rows for name, rows in content.items() if name.startswith(prefix)}

    session = make_session(GaussianCloud(**part("cloud.")))
    second = part("second.")
    moments = {name: (rows, second[name]) for name, rows in part("first.").items()}
    session.resume(moments, int(content["steps"]))
    return FitState(
        session=session,
        size_m=float(content["size_m"]),
        gains=content["gains"],
        cameras=CameraCorrections(**part("cameras.")),
        surface=SurfacePrior(**part("surface.")),
        seconds=float(content["seconds"]),
        errors=content["errors"].tolist(),
        **{name: int(content[name]) for name in SCALARS},
    )
