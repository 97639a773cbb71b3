"""What the worker of the tests hands out: the block shape as a generator would leave it."""

import json
from pathlib import Path

import numpy as np
from block_shape import block_mesh, camera_pose, placed
from scipy.spatial.transform import Rotation
from small_files import glb_bytes, mesh_content

from bridge.geometry import se3
from twin.scene.gaussians import GaussianCloud, as_float32, write_ply

SCALE = 0.1
PYTORCH3D = np.diag([-1.0, -1.0, 1.0])


def known_cloud() -> GaussianCloud:
    """One Gaussian on each corner of the known shape, longest along the shape's z."""
    vertices, _ = block_mesh()
    count = len(vertices)
    return GaussianCloud(
        means_m=as_float32(vertices),
        quats_wxyz=as_float32(np.tile([1.0, 0, 0, 0], (count, 1))),
        scales_log=as_float32(np.log(np.tile([0.01, 0.02, 0.05], (count, 1)))),
        opacities_logit=as_float32(np.full(count, 2.0)),
        colors=as_float32(np.full((count, 3), 0.5)),
    )


def stored_quaternion(T_camera_shape: np.ndarray) -> list[float]:
    """PyTorch3D multiplies rows, so what turns columns by R is stored as R transposed."""
    R = PYTORCH3D @ T_camera_shape[:3, :3]
    x, y, z, w = Rotation.from_matrix(R.T).as_quat()
    return [w, x, y, z]


def write_source(place: Path, T_base_shape: np.ndarray | None = None, height: float = 1.0) -> Path:
    """What the worker copies: the shape y-up as glb, z-up as Gaussians, and a rough pose."""
    place.mkdir()
    vertices, faces = block_mesh()
    y_up = vertices * [1.0, 1.0, height] @ np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    colors = np.full((len(vertices), 3), 200, dtype=np.uint8)
    (place / "mesh.glb").write_bytes(glb_bytes(*mesh_content(y_up, faces, colors)))
    write_ply(place / "splat.ply", known_cloud())
    rough = se3.invert(camera_pose()) @ (placed() if T_base_shape is None else T_base_shape)
    rough[:3, :3] = rough[:3, :3] @ Rotation.from_rotvec([0.1, -0.05, 0.15]).as_matrix()
    pose = {"rotation_wxyz": stored_quaternion(rough), "scale": [SCALE * 1.4] * 3, "iou": 0.8}
    (place / "pose.json").write_text(json.dumps(pose))
    return place
