"""Held-out depth of a scene and of an Open3D TSDF of the same training frames.

Protocol in docs/reconstruction.md. Truth is the depth recorded in held-out frames, as far as it is
trusted, nothing moved there, and both methods show a surface: no pixel counts for only one of them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Float32

from bridge.geometry import se3
from bridge.geometry.camera import Camera
from twin.scene.frames.rgbd import TrainingView

VOXEL_M, TRUNCATION_VOXELS, MAX_DEPTH_M = 3.0 / 512, 8.0, 5.0
"""As in Open3D's own examples of integration."""
BLOCK, NUM_BLOCKS = 16, 20_000
DrawDepth = Callable[[Camera, Float[np.ndarray, "4 4"]], Float32[np.ndarray, "height width"]]


@dataclass(frozen=True, kw_only=True)
class DepthScore:
    """Rendered minus recorded depth over all pixels of all held-out views together."""

    median_abs_m: float
    bias_m: float
    """Median of the signed error: negative is too near."""
    within_5mm: float
    within_20mm: float
    num_pixels: int

    def __str__(self) -> str:
        """One line."""
        return (
            f"{1e3 * self.median_abs_m:.2f} mm, bias {1e3 * self.bias_m:+.2f} mm, within 5 mm "
            f"{100 * self.within_5mm:.1f} %, within 20 mm {100 * self.within_20mm:.1f} %"
        )


def depth_scores(
    ways: dict[str, DrawDepth], held_out: Sequence[TrainingView]
) -> dict[str, DepthScore]:
    """Score several ways of drawing depth on the pixels that all of them, and the truth, cover.

    Args:
        ways: By name, what draws depth along the axis [m]; 0 is nothing.
    """
    errors: dict[str, list[np.ndarray]] = {name: [] for name in ways}
    for view in held_out:
        drawn = {name: draw(view.full.camera, view.T_base_color) for name, draw in ways.items()}
        both = np.logical_and.reduce([view.full.depth_m > 0, *(d > 0 for d in drawn.values())])
        for name, depth_m in drawn.items():
            errors[name].append((depth_m - view.full.depth_m)[both])
    return {name: _score(np.concatenate(parts)) for name, parts in errors.items()}


def _score(error_m: np.ndarray) -> DepthScore:
    off_m = np.abs(error_m)
    return DepthScore(
        median_abs_m=float(np.median(off_m)),
        bias_m=float(np.median(error_m)),
        within_5mm=float((off_m <= 5e-3).mean()),
        within_20mm=float((off_m <= 20e-3).mean()),
        num_pixels=len(error_m),
    )


class Tsdf:
    """The reference: truncated signed distances in voxels (Curless and Levoy 1996), by Open3D."""

    def __init__(self, views: Sequence[TrainingView]) -> None:
        """Integrate the trusted depth of training views."""
        import open3d

        self._o3d: Any = open3d
        core = open3d.core
        self._grid: Any = open3d.t.geometry.VoxelBlockGrid(
            attr_names=("tsdf", "weight"),
            attr_dtypes=(core.float32, core.float32),
            attr_channels=((1), (1)),
            voxel_size=VOXEL_M,
            block_resolution=BLOCK,
            block_count=NUM_BLOCKS,
            device=core.Device("CPU:0"),
        )
        for view in views:
            depth = open3d.t.geometry.Image(np.ascontiguousarray(view.full.depth_m))
            K, T = self._about(view.full.camera, view.T_base_color)
            ranges = (1.0, MAX_DEPTH_M, TRUNCATION_VOXELS)
            blocks = self._grid.compute_unique_block_coordinates(depth, K, T, *ranges)
            self._grid.integrate(blocks, depth, K, T, *ranges)

    def depth_m(
        self, camera: Camera, T_base_camera: Float[np.ndarray, "4 4"]
    ) -> Float32[np.ndarray, "height width"]:
        """Cast rays to the zero crossing; 0 where there is none."""
        K, T = self._about(camera, T_base_camera)
        blocks = self._grid.hashmap().key_tensor()[
            self._grid.hashmap().active_buf_indices().to(self._o3d.core.int64)
        ]
        found = self._grid.ray_cast(
            block_coords=blocks,
            intrinsic=K,
            extrinsic=T,
            width=camera.width,
            height=camera.height,
            render_attributes=["depth"],
            depth_scale=1.0,
            depth_min=0.05,
            depth_max=MAX_DEPTH_M,
            weight_threshold=1.0,
            trunc_voxel_multiplier=TRUNCATION_VOXELS,
        )
        return np.asarray(found["depth"].numpy()[..., 0])

    def _about(self, camera: Camera, T_base_camera: np.ndarray) -> tuple[Any, Any]:
        # Open3D's pixel centres are whole numbers.
        K = np.array(
            [[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1.0]]
        )
        tensor = self._o3d.core.Tensor
        return tensor(K), tensor(se3.invert(T_base_camera))
