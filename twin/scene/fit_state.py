"""Everything a fit has reached, and the file it is kept in so that it can go on."""

import io
import zipfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float

from bridge.whole_file import write_whole
from twin.scene.adam import Moments, Rates, no_moments, own_copy
from twin.scene.camera_correction import CameraCorrections
from twin.scene.gaussians import GaussianCloud, arrays

FIT_STATE = "fit.npz"
"""In the scene folder while a fit runs, or after one that was interrupted."""
STATE_VERSION = 1
SCALARS = ("step", "coarse_steps", "events_done", "num_split", "num_pruned")
CAMERA_ARRAYS = ("values", "first", "second", "counts")


@dataclass(kw_only=True)
class FitState:
    """A fit between two steps; the only thing that changes while fitting."""

    cloud: GaussianCloud
    moments: Moments
    rates: Rates
    gains: Float[np.ndarray, "num_views 3"]
    cameras: CameraCorrections
    seconds: float = 0.0
    """Time spent so far."""
    step: int = 0
    """Images seen so far."""
    coarse_steps: int = 0
    events_done: int = 0
    """How much of the schedule of colour solutions and splits is behind."""
    num_split: int = 0
    num_pruned: int = 0
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


def first_state(cloud: GaussianCloud, num_views: int) -> FitState:
    """Before the first image."""
    own = own_copy(cloud)
    return FitState(
        cloud=own,
        moments=no_moments(own),
        rates=Rates.for_cloud(own),
        gains=np.ones((num_views, 3)),
        cameras=CameraCorrections.none(num_views),
    )


def save_state(checkpoint: Checkpoint, state: FitState) -> None:
    """Write the state whole; plain arrays, nothing that runs when read."""
    content: dict[str, np.ndarray] = {
        "key": np.array(checkpoint.key),
        "version": np.array(STATE_VERSION),
        "seconds": np.array(state.seconds),
        "size_m": np.array(state.rates.size_m),
        "errors": np.array(state.errors, dtype=np.float64),
        "gains": state.gains,
    }
    content |= {name: np.array(getattr(state, name)) for name in SCALARS}
    content |= {f"cameras.{name}": getattr(state.cameras, name) for name in CAMERA_ARRAYS}
    for name, rows in arrays(state.cloud):
        content[f"cloud.{name}"] = rows
        content[f"first.{name}"], content[f"second.{name}"] = state.moments[name]
    buffer = io.BytesIO()
    np.savez(buffer, **content)  # type: ignore[arg-type]  # numpy's stub takes the names for options
    write_whole(checkpoint.path, buffer.getvalue())


def load_state(checkpoint: Checkpoint) -> FitState | None:
    """Read the state of an interrupted fit of the same inputs and settings; None if there is none.

    A damaged file, or one of another version, is none.
    """
    try:
        with np.load(checkpoint.path, allow_pickle=False) as stored:
            content = {name: stored[name] for name in stored.files}
        if str(content["key"]) != checkpoint.key or int(content["version"]) != STATE_VERSION:
            return None
        return _state_from(content)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None


def _state_from(content: dict[str, np.ndarray]) -> FitState:
    def part(prefix: str) -> dict[str, np.ndarray]:
        begin = len(prefix)
        return {name[begin:]: rows for name, rows in content.items() if name.startswith(prefix)}

    cloud = GaussianCloud(**part("cloud."))
    second = part("second.")
    return FitState(
        cloud=cloud,
        moments={name: (rows, second[name]) for name, rows in part("first.").items()},
        rates=Rates(size_m=float(content["size_m"])),
        gains=content["gains"],
        cameras=CameraCorrections(**part("cameras.")),
        seconds=float(content["seconds"]),
        errors=content["errors"].tolist(),
        **{name: int(content[name]) for name in SCALARS},
    )
