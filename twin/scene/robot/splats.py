"""Gaussians bound to the robot's links: forward kinematics drives them.

They lie in ``scene`` and not in ``robot``, because they are Gaussians and ``robot`` stands below
``scene``: see docs/decisions/0015-calibration.md.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float64, Int64

from bridge.episode import provenance
from bridge.episode.run_folder import RunFolder, check_episode_id
from bridge.geometry import se3
from twin.robot.model import RobotModel, load_robot
from twin.robot.posture import Posture
from twin.robot.surface import PosedSurface, fixed_links, link_poses
from twin.scene.gaussians import GaussianCloud, concatenate, moved_cloud, read_ply, write_ply

FOLDER = "robot"
BOUND_M = 0.015
"""A Gaussian nearer than this to a link belongs to it (design page on perception, section 5)."""
ASIDE_M = 0.006
"""Beside a link that never moves, a surface point must lie over it and not next to it."""


def bind(
    cloud: GaussianCloud,
    joints_rad: Float[np.ndarray, " num_joints"],
    urdf: str,
    *,
    width_m: float = 0.0,
) -> dict[str, GaussianCloud]:
    """Give each Gaussian within 15 mm of the posed robot to its nearest link.

    Args:
        cloud: Gaussians in the robot's base frame.
        joints_rad: Where the arm was, in the order of ``bridge.robots.default.ARM_JOINTS``.
        urdf: The robot's description.
        width_m: Opening of the gripper.

    Returns:
        Per link its Gaussians in the link's frame; links without any are left out.

    Raises:
        RobotDescriptionError: The description has no usable shapes.
    """
    robot, posture = load_robot(urdf), Posture(joints_rad=joints_rad, width_m=width_m)
    surface = PosedSurface(robot, posture)
    owner = splat_links(surface, cloud.means_m.astype(np.float64))
    poses = link_poses(robot, posture)
    links = sorted({surface.links[index] for index in owner[owner >= 0]})
    numbers = np.array(surface.links)
    return {
        link: moved_cloud(
            cloud.take(np.flatnonzero((owner >= 0) & (numbers[owner] == link))),
            se3.invert(poses[link]),
        )
        for link in links
    }


def posed(
    links: Mapping[str, GaussianCloud],
    joints_rad: Float[np.ndarray, " num_joints"],
    urdf: str,
    *,
    width_m: float = 0.0,
) -> GaussianCloud:
    """Put the Gaussians of all links where forward kinematics puts the links.

    Args:
        links: Per link its Gaussians in the link's frame, as ``bind`` or ``read_links`` give them.
        joints_rad: Where the arm is to be.
        urdf: The robot's description.
        width_m: Opening of the gripper.

    Returns:
        One cloud in the base frame, links in the order of the mapping; empty without links.

    Raises:
        RobotDescriptionError: The description lacks one of the links; lists those it has.
    """
    robot = load_robot(urdf)
    placed = [
        moved_cloud(cloud, robot.T_base_link(link, joints_rad, width_m))
        for link, cloud in links.items()
    ]
    return concatenate(placed) if placed else _empty()


def splat_links(
    surface: PosedSurface, p_base: Float[np.ndarray, "num_points 3"]
) -> Int64[np.ndarray, " num_points"]:
    """Index in ``surface.links`` of the nearest shape within 15 mm, or -1."""
    found, near = _nearest(surface, p_base)
    owner = np.full(len(p_base), -1, dtype=np.int64)
    close = found.distance_m < BOUND_M
    owner[near[close]] = found.link_ids[close]
    return owner


def surface_links(
    robot: RobotModel,
    surface: PosedSurface,
    p_base: Float[np.ndarray, "num_points 3"],
    normals: Float[np.ndarray, "num_points 3"],
) -> Int64[np.ndarray, " num_points"]:
    """Like ``splat_links``, but the table around a link that never moves is not taken for the link.

    Everything beside a moving link will be seen by itself in another posture. Beside the base it
    never will, so there a point must lie along its own normal from the link.
    """
    found, near = _nearest(surface, p_base)
    close = found.distance_m < BOUND_M
    gap = p_base[near] - found.p_m
    along = np.einsum("ij,ij->i", gap, normals[near])
    aside = np.linalg.norm(gap - along[:, None] * normals[near], axis=1)
    fixed = fixed_links(robot)
    never = np.array([link in fixed for link in surface.links], dtype=bool)[found.link_ids]
    close &= ~never | (aside < ASIDE_M)
    owner = np.full(len(p_base), -1, dtype=np.int64)
    owner[near[close]] = found.link_ids[close]
    return owner


def _nearest(surface: PosedSurface, p_base: Float64[np.ndarray, "num_points 3"]) -> tuple[Any, Any]:
    near = surface.near_box(p_base, BOUND_M)
    return surface.nearest(p_base[near]), near


def write_links(run: RunFolder, links: Mapping[str, GaussianCloud]) -> dict[str, Any]:
    """Write ``robot/<link>.ply`` and return what ``scene.json`` says about them."""
    folder = run.scene_dir / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    for path in folder.glob("*.ply"):
        if path.stem not in links:
            path.unlink()
    record = {}
    for link, cloud in links.items():
        path = folder / f"{check_episode_id(link)}.ply"
        write_ply(path, cloud)
        record[link] = {
            "file": f"{FOLDER}/{path.name}",
            "num_splats": len(cloud),
            "sha256": provenance.hash_file(path),
        }
    return record


def read_links(run: RunFolder, record: Mapping[str, Any]) -> dict[str, GaussianCloud]:
    """Load the links that ``scene.json`` lists under ``robot``, each in its own frame.

    Raises:
        PathNotFoundError: A file is gone.
        UnreadablePlyError: A file is damaged.
    """
    folder: Path = run.scene_dir / FOLDER
    return {
        link: read_ply(folder / f"{check_episode_id(link)}.ply")
        for link in record.get("robot", {}).get("links", {})
    }


def _empty() -> GaussianCloud:
    none = np.zeros((0, 3), dtype=np.float32)
    return GaussianCloud(
        means_m=none,
        quats_wxyz=np.zeros((0, 4), dtype=np.float32),
        scales_log=none,
        opacities_logit=np.zeros(0, dtype=np.float32),
        colors=none,
    )
