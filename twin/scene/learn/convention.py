"""The ways in which poses and depth can be meant: ours, and those others are known to write."""

from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Float

from bridge.geometry import se3

FLIP_YZ = np.diag([1.0, -1.0, -1.0, 1.0])
BODY_AXES = np.array(
    [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
"""``T_body_optical`` of ROS: body x forward, y left, z up; optical z forward, x right, y down."""
ORDERS = {
    "": (0, 1, 2, 3),
    "quaternions written as w x y z were read as x y z w": (1, 2, 3, 0),
    "quaternions written as x y z w were read as w x y z": (3, 0, 1, 2),
}
"""Where the true w, x, y, z are found in the w, x, y, z that were read."""
AXES = {
    "": np.eye(4),
    "the camera looks along -z with y up (OpenGL axes)": FLIP_YZ,
    "the camera frame is a body frame (x forward, y left, z up)": BODY_AXES,
}


@dataclass(frozen=True, kw_only=True)
class Convention:
    """One way of reading poses and depth."""

    order: str = ""
    inverse: bool = False
    axes: str = ""
    depth_scale: float = 1.0

    def describe(self) -> str:
        """Say what differs from our own reading."""
        parts = [self.order, self.axes]
        if self.inverse:
            parts.append("they are world-to-camera, not camera-to-world")
        if self.depth_scale != 1.0:
            parts.append(
                f"depth is to be multiplied by {self.depth_scale:g} "
                f"(or positions by {1 / self.depth_scale:g})"
            )
        return " and ".join(part for part in parts if part) or "as recorded"

    def read(self, T_as_read: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
        """Turn a pose as we read it into ``T_base_camera`` as this convention means it."""
        q, p = se3.split(T_as_read)
        T = se3.transform_from(q[list(ORDERS[self.order])], p)
        return np.asarray((se3.invert(T) if self.inverse else T) @ AXES[self.axes])


OTHER_POSES = tuple(
    Convention(order=order, inverse=inverse, axes=axes)
    for order, inverse, axes in product(ORDERS, (False, True), AXES)
)[1:]
"""Every other way of reading poses; the first of all is our own."""
