"""One step of fitting in native code: draw, compare, pull back, Adam; nothing goes through Python.

The separate steps are ``rasteriser.Rasteriser``, ``losses.Loss`` and Adam; a test holds them equal.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Float32, Int64

from twin.scene.frames.training_view import Target
from twin.scene.gaussians.cloud import GaussianCloud, arrays, as_float32
from twin.scene.raster.config import CloudGradient, RasterConfig, load_native, native_camera

NAMES = ("means_m", "quats_wxyz", "scales_log", "opacities_logit", "colors", "harmonics")
STAGES = ("draw", "compare", "pull", "learn")
UNIT_GAIN = (1.0, 1.0, 1.0)

Moments = Mapping[str, tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True, kw_only=True)
class StepReport:
    """What one step found, before it changed the cloud."""

    loss: float
    mse: float | None
    """Mean squared colour error over the static pixels; None when there are none."""
    gain: Float[np.ndarray, "3"]
    """Gradient of the loss on the gain."""
    T_camera_base: Float[np.ndarray, "3 4"]
    """Gradient of the loss on the camera's pose, as in ``CloudGradient``."""
    seconds: Mapping[str, float]
    """Wall time of each stage: draw, compare, pull, learn."""
    serial_s: float
    """How much of it one thread spent alone: by Amdahl's law it bounds what more threads gain."""


class FitSession:
    """A cloud being fitted, with the moments of Adam (Kingma and Ba 2015).

    Loss as in ``losses.Loss``: ``3dgs`` is 0.8 L1 + 0.2 (1 - SSIM), ``paper`` the squared error
    (Eq. 3), both with ``depth_weight`` times the L1 depth error relative to depth. Same bits for
    any number of threads.
    """

    def __init__(
        self,
        cloud: GaussianCloud,
        config: RasterConfig | None = None,
        *,
        loss: Literal["3dgs", "paper"] = "3dgs",
        depth_weight: float = 0.1,
        l1_share: float = 0.8,
    ) -> None:
        """Copy the cloud; moments start at zero."""
        self.config = config or RasterConfig()
        self.steps = 0
        self._loss = (loss == "3dgs", l1_share, depth_weight)
        self._native = load_native().FitSession(self.config.threads, self.config.isa)
        self._cloud = _own_copy(cloud)
        self._first = {name: np.zeros_like(rows) for name, rows in arrays(cloud)}
        self._second = {name: np.zeros_like(rows) for name, rows in arrays(cloud)}

    @property
    def moments(self) -> Moments:
        """Adam's running means of the gradient and of its square, by array; they change too."""
        return {name: (self._first[name], self._second[name]) for name in self._first}

    def resume(self, moments: Moments, steps: int) -> None:
        """Take up a fit where another session of the same cloud left it.

        Args:
            moments: Copied.
            steps: How many steps that session had made.
        """
        self._first = {name: as_float32(first).copy() for name, (first, _) in moments.items()}
        self._second = {name: as_float32(second).copy() for name, (_, second) in moments.items()}
        self.steps = steps

    @property
    def cloud(self) -> GaussianCloud:
        """The cloud as it is now. Its arrays change with each step, and may be written to."""
        return self._cloud

    def step(
        self,
        target: Target,
        T_base_camera: Float[np.ndarray, "4 4"],
        rates: Mapping[str, float],
        gain: Float[np.ndarray, "3"] | tuple[float, float, float] = UNIT_GAIN,
    ) -> StepReport:
        """Draw one view, compare it with what was seen, and follow the gradient.

        Args:
            target: Image, depth and static mask at the camera's size.
            T_base_camera: Where it was seen from.
            rates: Adam's step size for each array by name; arrays without one stay as they are,
                and so do their moments.
            gain: The drawn colours times these are compared with the image.
        """
        self.steps += 1
        red, green, blue = (float(value) for value in gain)
        loss, squared, num_static, d_gain, d_pose, seconds, serial_s = self._native.step(
            self._tables(dict(arrays(self._cloud))),
            self._tables(self._first),
            self._tables(self._second),
            *native_camera(target.camera, T_base_camera),
            self.config.alpha_cut,
            self.config.transmittance_stop,
            target.planes_u8,
            target.depth_m,
            target.static_mask,
            (red, green, blue),
            self._loss,
            tuple(float(rates.get(name, 0.0)) for name in NAMES),
            self.steps,
        )
        return StepReport(
            loss=loss,
            mse=squared / (3 * num_static) if num_static else None,
            gain=np.array(d_gain),
            T_camera_base=d_pose,
            seconds=dict(zip(STAGES, seconds, strict=True)),
            serial_s=serial_s,
        )

    def planes(self) -> Float32[np.ndarray, "5 height width"]:
        """A copy of what the last step drew, before gain."""
        drawn: np.ndarray = self._native.planes()
        return drawn

    def gradient(self, report: StepReport) -> CloudGradient:
        """A copy of the last step's gradient; ``report`` is that step's."""
        named = dict(zip(NAMES, self._native.gradients(), strict=True))
        return CloudGradient(**named, T_camera_base=report.T_camera_base)

    def visible_mask(self) -> Bool[np.ndarray, " num_splats"]:
        """Say which Gaussians could touch the last image."""
        mask: np.ndarray = self._native.visible()
        return mask

    def rearrange(
        self, cloud: GaussianCloud, parents: Int64[np.ndarray, " num_splats"] | None = None
    ) -> None:
        """Go on with another cloud.

        Args:
            cloud: Copied.
            parents: For each of its Gaussians the row of the present cloud whose moments it goes
                on with, or -1 for none; nothing given: none for all.
        """
        rows_from = np.full(len(cloud), -1) if parents is None else parents
        self._first = _carried(self._first, cloud, rows_from)
        self._second = _carried(self._second, cloud, rows_from)
        self._cloud = _own_copy(cloud)

    @staticmethod
    def _tables(named: Mapping[str, np.ndarray]) -> tuple[np.ndarray | None, ...]:
        return tuple(named.get(name) for name in NAMES)


def _own_copy(cloud: GaussianCloud) -> GaussianCloud:
    return GaussianCloud(**{name: as_float32(rows).copy() for name, rows in arrays(cloud)})


def _carried(
    moments: Mapping[str, np.ndarray], cloud: GaussianCloud, parents: np.ndarray
) -> dict[str, np.ndarray]:
    carried = {name: np.zeros_like(rows) for name, rows in arrays(cloud)}
    known = parents >= 0
    for name, rows in carried.items():
        if name in moments:
            rows[known] = moments[name][parents[known]]
    return carried
