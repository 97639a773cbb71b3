"""Depth that a network guesses from one image, laid onto what was measured in that image.

A network knows depth up to a scale, and mostly a shift, of its own for each image (Ranftl et al.
2020). Both come from the pixels that were measured, robustly: some of them are wrong in the
measurement, some in the guess. A guess that does not explain the measured pixels says nothing of
the others and is refused. What is left is a hypothesis for holes, see ``fit/completion.py``.
"""

from collections import Counter
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from twin.errors import TwinError
from twin.scene.fit.completion import ClosedHoles, DepthGuess
from twin.scene.foundation.loading import Placement
from twin.scene.foundation.models import (
    DEPTH_MODELS,
    DepthAnything,
    split_spec,
)
from twin.scene.frames.rgbd import TrainingView
from twin.scene.settings import ModelConfig

LEAST_MEASURED_PX = 100
"""An image with fewer measured pixels aligns nothing."""
AGREE = 0.1
"""Guessed and measured depth agree when their logarithms differ by less."""
LEAST_AGREEING = 0.5
"""Share of the measured pixels that must agree."""
LEAST_EXPLAINED = 0.5
"""The median difference may be this much of what one constant depth would leave."""
NUM_PAIRS, MAX_PIXELS = 400, 4000
"""Pairs of pixels that a line is laid through (RANSAC, Fischler and Bolles 1981), and pixels that
it is judged by."""
ROUNDS = 12
"""Of reweighted least squares after that."""
TUKEY = 4.685
"""Times the scatter: measurements farther off count nothing (Tukey's biweight)."""
LEAST_SCATTER = 1e-4
BEYOND = 2.0
"""No guess farther than this many times what was measured in the image, nor nearer."""


class DepthDisagreesError(TwinError):
    """What a network guessed for an image does not fit what was measured in it."""


@runtime_checkable
class DepthNetwork(Protocol):
    """Guesses depth from one image."""

    source: str
    is_metric: bool
    """Whether it guesses depth; else inverse depth."""

    def predict(
        self, image_u8: UInt8[np.ndarray, "_ _ 3"], size: tuple[int, int]
    ) -> Float32[np.ndarray, "height width"]:
        """Values of all pixels, as an image of a given height and width."""


@dataclass(frozen=True, kw_only=True)
class DepthAlignment:
    """The line from what was guessed to what was measured in one image, and how well it fits."""

    scale: float
    shift: float
    """In metres, or in 1/m where the inverse of depth was guessed."""
    is_inverse: bool
    nearest_m: float
    farthest_m: float
    """Of most that was measured."""
    scatter: float
    """Standard deviation of the logarithm of guessed over measured depth, where they agree."""
    agreeing: float
    """Share of the measured pixels that agree within ``AGREE``."""

    def depth_m(
        self, guessed: Float[np.ndarray, "height width"]
    ) -> Float32[np.ndarray, "height width"]:
        """Depth in metres; 0 where the line leads nowhere near what was measured.

        Args:
            guessed: As the network says.
        """
        value = self.scale * guessed.astype(np.float64) + self.shift
        if self.is_inverse:
            value = np.where(value > 1e-9, 1.0 / np.maximum(value, 1e-9), 0.0)
        near = (value > self.nearest_m / BEYOND) & (value < self.farthest_m * BEYOND)
        return np.where(near, value, 0.0).astype(np.float32)


def align_depth(
    guessed: Float[np.ndarray, "height width"],
    measured_m: Float[np.ndarray, "height width"],
    usable: Bool[np.ndarray, "height width"],
    *,
    is_inverse: bool,
) -> DepthAlignment:
    """Fit scale and shift of a guess to measured depth; errors count relative to depth.

    The line that most pixels lie near, of lines through pairs of them, then least squares with
    Tukey's weights. Nothing changes when the guess is scaled and shifted first, and the same
    pixels give the same line.

    Args:
        guessed: Depth, or inverse depth, up to a positive scale and a shift.
        measured_m: Along the optical axis; 0 where it was not measured.
        usable: Pixels whose measurement counts.
        is_inverse: Whether the inverse of depth was guessed.

    Raises:
        DepthDisagreesError: When too little was measured, or the guess does not explain it.
    """
    chosen = usable & (measured_m > 0) & np.isfinite(guessed)
    num_measured = int(chosen.sum())
    if num_measured < LEAST_MEASURED_PX:
        message = f"only {num_measured} pixels were measured, {LEAST_MEASURED_PX} are needed"
        raise DepthDisagreesError(message)
    x, z_m = guessed[chosen].astype(np.float64), measured_m[chosen].astype(np.float64)
    middle, spread = float(np.median(x)), float(np.ptp(np.quantile(x, [0.1, 0.9])))
    if not spread > 1e-6 * max(abs(middle), 1e-30):
        message = "the same is guessed everywhere"
        raise DepthDisagreesError(message)
    x = (x - middle) / spread
    y = 1.0 / z_m if is_inverse else z_m
    step = -(-num_measured // MAX_PIXELS)
    scale, shift = _line(x[::step], y[::step])
    fitted = scale * x + shift
    possible = fitted > 1e-9
    off = np.full(len(x), np.inf)
    off[possible] = np.abs(np.log(fitted[possible] / y[possible]))
    near = off < AGREE
    if near.mean() < LEAST_AGREEING:
        message = f"{near.mean():.0%} of the measured pixels agree within {AGREE:.0%}"
        raise DepthDisagreesError(message)
    constant = float(np.median(np.abs(np.log(z_m / np.median(z_m)))))
    if np.median(off) > LEAST_EXPLAINED * constant:
        message = "one distance for the whole image fits about as well"
        raise DepthDisagreesError(message)
    nearest_m, farthest_m = np.quantile(z_m, [0.02, 0.98])
    return DepthAlignment(
        scale=scale / spread,
        shift=shift - scale * middle / spread,
        is_inverse=is_inverse,
        nearest_m=float(nearest_m),
        farthest_m=float(farthest_m),
        scatter=1.4826 * float(np.median(off[near])),
        agreeing=float(near.mean()),
    )


def _line(
    x: Float[np.ndarray, " num_pixels"], y: Float[np.ndarray, " num_pixels"]
) -> tuple[float, float]:
    """Positive scale and shift of the line that most pixels lie near, relative to their values.

    Raises:
        DepthDisagreesError: When no such line rises.
    """
    rng = np.random.default_rng(0)
    first, second = rng.integers(0, len(x), size=(2, NUM_PAIRS))
    run = x[second] - x[first]
    distinct = np.abs(run) > 1e-3
    scale = (y[second] - y[first])[distinct] / run[distinct]
    shift = y[first][distinct] - scale * x[first][distinct]
    scale, shift = scale[scale > 0], shift[scale > 0]
    if len(scale) == 0:
        message = "nearer in the guess is not nearer in the measurement"
        raise DepthDisagreesError(message)
    off = np.abs(np.outer(scale, x) + shift[:, None] - y) / y
    best = int(np.minimum(off, AGREE).mean(axis=1).argmin())
    found = np.array([scale[best], shift[best]])
    rows = np.stack([x, np.ones(len(x))], axis=1) / y[:, None]
    for _ in range(ROUNDS):
        error = rows @ found - 1.0
        near = np.abs(error)[np.abs(error) < AGREE]
        scatter = 1.4826 * float(np.median(near)) if len(near) else AGREE
        limit = TUKEY * max(scatter, LEAST_SCATTER)
        root_weight = np.clip(1.0 - np.square(error / limit), 0.0, None)
        found, *_ = np.linalg.lstsq(rows * root_weight[:, None], root_weight, rcond=None)
    if found[0] <= 0:
        message = "nearer in the guess is not nearer in the measurement"
        raise DepthDisagreesError(message)
    return float(found[0]), float(found[1])


class DepthGuesser:
    """Asks a network about training views one by one, and remembers how its guesses fitted."""

    def __init__(self, network: DepthNetwork, sha256: str) -> None:
        """Nothing is asked yet.

        Args:
            network: Guesses depth.
            sha256: Of its weights, for the record.
        """
        self._network = network
        self._sha256 = sha256
        self._scatter: list[float] = []
        self._refused: list[dict[str, Any]] = []

    @staticmethod
    def load(config: ModelConfig, sha256: str) -> "DepthGuesser | None":
        """The network that is named, None where none is.

        Args:
            config: Names the folder and the device.
            sha256: Of its weights, which ``check_models`` read.

        Raises:
            UsageError: When the folder or the device cannot be used.
            MissingDependencyError: When the extra ``foundation`` is not installed.
        """
        if not config.depth_model:
            return None
        _, folder = split_spec(config.depth_model, "--depth-model", DEPTH_MODELS)
        network = DepthAnything.load(folder, Placement(device=config.device))
        return DepthGuesser(network, sha256)

    def __call__(self, view: TrainingView) -> DepthGuess | None:
        """What the network guesses for a view's half-size image, aligned; None where it is refused.

        Args:
            view: With the depth measured in it.
        """
        half = view.half
        image_u8 = np.ascontiguousarray(np.moveaxis(view.full.planes_u8, 0, -1))
        guessed = self._network.predict(image_u8, (half.camera.height, half.camera.width))
        try:
            found = align_depth(
                guessed,
                half.depth_m,
                half.static_mask,
                is_inverse=not self._network.is_metric,
            )
        except DepthDisagreesError as error:
            about = {"camera": view.camera_id, "stamp_ns": view.stamp_ns, "why": str(error)}
            self._refused.append(about)
            return None
        self._scatter.append(found.scatter)
        return DepthGuess(depth_m=found.depth_m(guessed), scatter=found.scatter)

    def to_record(self, closed: ClosedHoles) -> dict[str, Any]:
        """What ``scene.json`` says of it.

        Args:
            closed: What became of the guesses.
        """
        used = len(self._scatter)
        return {
            "source": self._network.source,
            "guesses": "depth" if self._network.is_metric else "inverse depth",
            "sha256": self._sha256,
            "images_asked": used + len(self._refused),
            "images_used": used,
            "median_scatter": round(float(np.median(self._scatter)), 4) if used else None,
            "refused": list(self._refused),
            "pixels": closed.num_guessed_px,
            "num_splats": int(closed.guessed.sum()),
        }


def describe_guesses(record: dict[str, Any]) -> str:
    """Say in words what a depth model did for a scene.

    Args:
        record: As ``to_record`` made it.
    """
    asked, used = record["images_asked"], record["images_used"]
    if not asked:
        return f"{record['source']} was not asked: no image has a hole"
    text = (
        f"{record['source']} gave {record['num_splats']} Gaussians their distance; in {used} of "
        f"{asked} images it agrees with the measured depth"
    )
    if used:
        text += f" (within {record['median_scatter']:.1%})"
    if record["refused"]:
        reasons = Counter(item["why"] for item in record["refused"])
        why, _ = reasons.most_common(1)[0]
        text += f"; elsewhere it is not used, for example because {why}"
    return text
