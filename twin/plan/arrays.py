"""The arrays that the planner hands around, by what they are; ``_`` is any number of rows."""

import numpy as np
from jaxtyping import Bool, Float, Int

Pose = Float[np.ndarray, "4 4"]
Poses = Float[np.ndarray, "_ 4 4"]
RotationMatrix = Float[np.ndarray, "3 3"]
Covariance = Float[np.ndarray, "6 6"]
"""Of a pose: x, y, z [m] and rotation about them [rad], base frame."""
Joints = Float[np.ndarray, " num_joints"]
Postures = Float[np.ndarray, "_ num_joints"]
Vector = Float[np.ndarray, "3"]
Points = Float[np.ndarray, "_ 3"]
Spheres = Float[np.ndarray, "_ 4"]
"""Centre and radius [m]."""
Numbers = Float[np.ndarray, " _"]
Flags = Bool[np.ndarray, " _"]
Ids = Int[np.ndarray, " _"]
