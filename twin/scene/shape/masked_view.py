"""What one camera says about one object: which pixels are the object, how far each pixel sees."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32

from bridge.geometry import se3
from bridge.geometry.camera import Camera
from twin.errors import TwinError


class ShapeError(TwinError):
    """There is not enough to make a shape from, or what there is contradicts itself."""


@dataclass(frozen=True, kw_only=True)
class MaskedView:
    """One depth image and the object's pixels in it.

    ``base`` may be any frame whose z axis points up: the robot's, or the object's own.
    """

    camera: Camera
    T_base_camera: Float[np.ndarray, "4 4"]
    depth_m: Float[np.ndarray, "height width"]
    """Along the optical axis; 0, negative or not finite is "not measured"."""
    mask: Bool[np.ndarray, "mask_height mask_width"]
    """True where the object is seen."""
    sensor: str = ""
    """Which camera it is: views of one camera share the errors of its depth."""

    def __post_init__(self) -> None:
        """Refuse images that do not belong together.

        Raises:
            ShapeError: When sizes differ, or the pose is no number.
        """
        size = (self.camera.height, self.camera.width)
        if self.depth_m.shape != size or self.mask.shape != size:
            message = (
                f"a camera of {size[1]} x {size[0]} pixels came with depth of shape "
                f"{self.depth_m.shape} and a mask of shape {self.mask.shape}; give all one size."
            )
            raise ShapeError(message)
        if not np.isfinite(self.T_base_camera).all():
            message = "a view's camera pose is not finite; leave that view out."
            raise ShapeError(message)

    def known_depth_m(self) -> Float32[np.ndarray, "height width"]:
        """Depth with 0 wherever it was not measured [m]."""
        depth = self.depth_m.astype(np.float32)
        return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0.0))

    def points_m(self) -> Float[np.ndarray, "num_points 3"]:
        """Measured points of the object, in ``base`` [m]."""
        depth = self.known_depth_m()
        row, column = np.nonzero(self.mask & (depth > 0))
        z = depth[row, column].astype(np.float64)
        x = (column + 0.5 - self.camera.cx) / self.camera.fx * z
        y = (row + 0.5 - self.camera.cy) / self.camera.fy * z
        return se3.apply(self.T_base_camera, np.stack([x, y, z], axis=1))
