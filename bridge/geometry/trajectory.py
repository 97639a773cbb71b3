"""Poses over time: integer stamps, positions, quaternions."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from bridge.geometry import se3


@dataclass(frozen=True)
class PoseTrajectory:
    """Poses ``T_frame_body`` at strictly increasing stamps."""

    stamps_ns: Int[np.ndarray, " num_poses"]
    p_m: Float[np.ndarray, "num_poses 3"]
    q_wxyz: Float[np.ndarray, "num_poses 4"]

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self.stamps_ns)

    def at(self, stamps_ns: Int[np.ndarray, " num_queries"]) -> "PoseTrajectory":
        """Interpolate (linear, slerp); stamps outside the range take the nearest end."""
        if len(self) == 1:
            index = np.zeros(len(stamps_ns), dtype=np.int64)
            return PoseTrajectory(stamps_ns, self.p_m[index], self.q_wxyz[index])
        before, fraction = self._between(stamps_ns)
        q = se3.interpolate_quaternion(self.q_wxyz[before], self.q_wxyz[before + 1], fraction)
        first = self.p_m[before]
        p_m = first + fraction[:, None] * (self.p_m[before + 1] - first)
        return PoseTrajectory(stamps_ns, np.asarray(p_m), q)

    def _between(
        self, stamps_ns: Int[np.ndarray, " num_queries"]
    ) -> tuple[Int[np.ndarray, " num_queries"], Float[np.ndarray, " num_queries"]]:
        """Index of the pose before each stamp, and how far it is to the next one, 0 to 1."""
        after = np.clip(np.searchsorted(self.stamps_ns, stamps_ns), 1, len(self) - 1)
        before = after - 1
        span = (self.stamps_ns[after] - self.stamps_ns[before]).astype(np.float64)
        offset = (stamps_ns - self.stamps_ns[before]).astype(np.float64)
        return before, np.clip(offset / np.maximum(span, 1.0), 0.0, 1.0)

    def shifted(self, shift_ns: int) -> "PoseTrajectory":
        """Return the same poses so much later."""
        return PoseTrajectory(self.stamps_ns + shift_ns, self.p_m, self.q_wxyz)

    def transforms(self) -> Float[np.ndarray, "num_poses 4 4"]:
        """Return the poses as matrices."""
        return se3.transform_from(self.q_wxyz, self.p_m)
