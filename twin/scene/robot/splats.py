"""Gaussians bound to the robot's links: forward kinematics drives them.

They lie in ``scene`` and not in ``robot``, because they are Gaussians and ``robot`` stands below
``scene``: see docs/decisions/0015-calibration.md.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int64

from bridge.episode import provenance
from bridge.episode.run_folder import RunFolder, check_episode_id
from twin.robot.model import RobotModel, load_robot
from twin.robot.posture import Posture
from twin.robot.surface import PosedSurface
from twin.scene.fit.lighting import EVEN, Lighting
from twin.scene.gaussians import GaussianCloud, concatenate, moved_cloud, read_ply, write_ply

FOLDER = "robot"
BOUND_M = 0.015
"""A Gaussian nearer than this to a link belongs to it (design page on perception, section 5)."""
ASIDE_M = 0.006
"""Beside a link that never moves, a surface point must lie over it and not next to it."""


def posed(
    links: Mapping[str, GaussianCloud], posture: Posture, urdf: str, lighting: Lighting = EVEN
) -> GaussianCloud:
    """Put the Gaussians of all links where forward kinematics puts the links.

    Returns:
        One cloud in the base frame, links in the order of the mapping; there must be one.
    """
    robot = load_robot(urdf)
    placed = [
        moved_cloud(cloud, robot.T_base_link(link, posture.joints_rad, posture.width_m))
        for link, cloud in links.items()
    ]
    return lighting.on(concatenate(placed))


def surface_links(
    robot: RobotModel,
    surface: PosedSurface,
    p_base: Float[np.ndarray, "num_points 3"],
    normals: Float[np.ndarray, "num_points 3"],
) -> Int64[np.ndarray, " num_points"]:
    """Index in ``surface.links`` of the nearest shape within 15 mm, or -1.

    The table around a link that never moves is not taken for the link. Everything beside a moving
    link will be seen by itself in another posture. Beside the base it never will, so there a point
    must lie along its own normal from the link.

    Args:
        normals: Unit vectors out of the surface at the points, base frame.
    """
    near = surface.near_box(p_base, BOUND_M)
    found = surface.nearest(p_base[near])
    close = found.distance_m < BOUND_M
    gap = p_base[near] - found.p_m
    along = np.einsum("ij,ij->i", gap, normals[near])
    aside = np.linalg.norm(gap - along[:, None] * normals[near], axis=1)
    fixed = {frame.name for frame in robot.model.frames if not frame.parentJoint}
    never = np.array([link in fixed for link in surface.links], dtype=bool)[found.link_ids]
    close &= ~never | (aside < ASIDE_M)
    owner = np.full(len(p_base), -1, dtype=np.int64)
    owner[near[close]] = found.link_ids[close]
    return owner


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
    """Load the links that ``scene.json`` lists under ``robot``, each in its own frame."""
    folder: Path = run.scene_dir / FOLDER
    return {
        link: read_ply(folder / f"{check_episode_id(link)}.ply")
        for link in record.get("robot", {}).get("links", {})
    }
