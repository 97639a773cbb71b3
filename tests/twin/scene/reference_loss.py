"""The loss of a fit in plain NumPy, with its gradient: what the native code is compared with."""

from typing import Literal

import numpy as np
from jaxtyping import Float32

from twin.scene.raster.rasteriser import load_native

L1_SHARE = 0.8
"""0.8 L1 + 0.2 (1 - SSIM), as in 3D Gaussian splatting (Kerbl et al. 2023, Eq. 7)."""


class Loss:
    """Photometric and depth loss of one drawn image."""

    def __init__(
        self, kind: Literal["3dgs", "paper"], *, depth_weight: float, threads: int = 0
    ) -> None:
        """Choose the photometric term."""
        self.kind = kind
        self.depth_weight = depth_weight
        self._similarity = load_native().Similarity(threads, "auto")

    def __call__(
        self,
        planes: Float32[np.ndarray, "5 height width"],
        target: Float32[np.ndarray, "3 height width"],
        depth_m: Float32[np.ndarray, "height width"],
    ) -> tuple[float, float, Float32[np.ndarray, "5 height width"]]:
        """Return the loss, the mean squared colour error, and the gradient on the planes."""
        gradient = np.empty_like(planes)
        difference = planes[:3] - target
        mse = float(np.square(difference).mean())
        if self.kind == "paper":
            value = mse
            np.multiply(difference, 2.0 / difference.size, out=gradient[:3])
        else:
            similarity, d_similarity = self._similarity.mean(planes[:3], target)
            value = L1_SHARE * float(np.abs(difference).mean())
            value += (1 - L1_SHARE) * (1 - similarity)
            np.sign(difference, out=gradient[:3])
            gradient[:3] *= L1_SHARE / difference.size
            gradient[:3] -= (1 - L1_SHARE) * d_similarity
        value += self._depth(planes, depth_m, gradient)
        return value, mse, gradient

    def _depth(self, planes: np.ndarray, depth_m: np.ndarray, gradient: np.ndarray) -> float:
        gradient[3:] = 0.0
        valid = depth_m > 0
        count = int(valid.sum())
        if self.depth_weight == 0 or count == 0:
            return 0.0
        inverse = np.divide(1.0, depth_m, out=np.zeros_like(depth_m), where=valid)
        residual = planes[3] * inverse - planes[4] * valid
        sign = np.sign(residual) * np.float32(self.depth_weight / count)
        gradient[3] = sign * inverse
        gradient[4] = -sign * valid
        return self.depth_weight * float(np.abs(residual).sum()) / count
