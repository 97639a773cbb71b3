"""A cloud of Gaussians after a rigid motion."""

import numpy as np
from jaxtyping import Float

from bridge.geometry import se3
from twin.scene.gaussians.cloud import GaussianCloud, as_float32, turned_harmonics


def moved_cloud(cloud: GaussianCloud, T_new_old: Float[np.ndarray, "4 4"]) -> GaussianCloud:
    """The same Gaussians after a rigid motion; what their colour owes to direction turns along."""
    q, _ = se3.split(T_new_old)
    w, x, y, z = q
    w2, x2, y2, z2 = cloud.quats_wxyz.astype(np.float64).T
    quats = np.stack(
        [
            w * w2 - x * x2 - y * y2 - z * z2,
            w * x2 + x * w2 + y * z2 - z * y2,
            w * y2 - x * z2 + y * w2 + z * x2,
            w * z2 + x * y2 - y * x2 + z * w2,
        ],
        axis=1,
    )
    return GaussianCloud(
        means_m=as_float32(se3.apply(T_new_old, cloud.means_m.astype(np.float64))),
        quats_wxyz=as_float32(quats),
        scales_log=cloud.scales_log,
        opacities_logit=cloud.opacities_logit,
        colors=cloud.colors,
        harmonics=turned_harmonics(cloud.harmonics, T_new_old[:3, :3]),
    )
