"""Where the arm carries the wrist camera during a scan, and how it gets there."""

import numpy as np
from jaxtyping import Float

from bridge.geometry import se3
from bridge.robots.default import TCP_FRAME
from bridge.sources.standin.cell_file import CameraMount
from bridge.sources.standin.kinematics import Kinematics, UnreachablePoseError, minimum_jerk

SAFE_HEIGHT_M = {"forearm_link": 0.12, "wrist_1_link": 0.10, "wrist_2_link": 0.10, TCP_FRAME: 0.09}
"""Lowest allowed height of links above the table, on the way too."""
SAFE_RADIUS_M = 0.20
"""The tool stays this far from the axis of the robot's base."""
QUARTERS_RAD = (0.0, np.pi / 2, -np.pi / 2, np.pi)
ROLLS_RAD = tuple(quarter + off for off in (0.0, 0.6, -0.6) for quarter in QUARTERS_RAD)
"""About the optical axis, tried in this order."""
GOOD_MOVE_RAD = 1.0
"""A viewpoint this near is taken without looking for a nearer one."""
LARGEST_MOVE_RAD = 2.4
"""Between neighbouring viewpoints, of any one joint."""


CENTER_M = (0.49, 0.0, 0.02)
"""What the camera circles."""
RINGS = ((1.35, 0.50, 5), (1.05, 0.46, 11), (0.80, 0.44, 15), (0.58, 0.42, 14))
"""Elevation [rad], distance [m] and number of viewpoints of each ring."""
AIM_SPREAD_M = 0.13
"""How far the point looked at wanders along the table, so that its ends are seen as well."""


def scan_joints(
    mount: CameraMount, kinematics: Kinematics, joints_start_rad: Float[np.ndarray, "6"]
) -> list[Float[np.ndarray, "6"]]:
    """Find joints for each viewpoint that can be reached safely from the one before.

    Viewpoints behind the reach of the arm are left out.
    """
    T_parent_tcp = se3.invert(
        kinematics.T_base_frame(joints_start_rad, mount.parent)
    ) @ kinematics.T_base_tcp(joints_start_rad)
    T_camera_tcp = se3.invert(mount.T_parent_camera) @ T_parent_tcp
    joints, found = joints_start_rad, []
    for T_base_camera in viewpoints():
        reached = _reach(T_base_camera, T_camera_tcp, kinematics, joints)
        if reached is not None:
            found.append(reached)
            joints = reached
    return found


def viewpoints() -> list[Float[np.ndarray, "4 4"]]:
    """Camera poses ring by ring, turning back at the end of each ring so that moves stay short."""
    poses = []
    for ring, (elevation, distance, count) in enumerate(RINGS):
        # Azimuth 0 is the far side of the table, where the arm cannot look back from.
        azimuths = np.linspace(-2.6, 2.6, count) + np.pi
        for k, azimuth in enumerate(azimuths[:: -1 if ring % 2 else 1]):
            wander = AIM_SPREAD_M * np.array([0.35 * (-1) ** k, np.sin(2.4 * k), 0.0])
            target = np.array(CENTER_M) + wander
            out = np.array([np.cos(azimuth), np.sin(azimuth), 0.0]) * np.cos(elevation)
            eye = target + distance * (out + np.array([0.0, 0.0, np.sin(elevation)]))
            up = np.array([0.0, 0.0, 1.0]) if elevation < 1.5 else np.array([1.0, 0.0, 0.0])
            poses.append(se3.look_at(eye, target, up))
    return poses


def _reach(
    T_base_camera: Float[np.ndarray, "4 4"],
    T_camera_tcp: Float[np.ndarray, "4 4"],
    kinematics: Kinematics,
    joints_rad: Float[np.ndarray, "6"],
) -> Float[np.ndarray, "6"] | None:
    """Turn the camera about its axis until the arm gets there by a short, safe way."""
    best, best_move = None, LARGEST_MOVE_RAD
    for roll in ROLLS_RAD:
        T_base_tcp = (
            T_base_camera @ se3.small_motion(np.array([0, 0, roll, 0, 0, 0])) @ T_camera_tcp
        )
        try:
            joints = kinematics.joints_for(T_base_tcp, joints_rad)
        except UnreachablePoseError:
            continue
        move = float(np.max(np.abs(joints - joints_rad)))
        if move < best_move and _is_safe(kinematics, joints_rad, joints):
            best, best_move = joints, move
        if best_move < GOOD_MOVE_RAD:
            break
    return best


def _is_safe(
    kinematics: Kinematics, start_rad: Float[np.ndarray, "6"], end_rad: Float[np.ndarray, "6"]
) -> bool:
    for fraction in np.linspace(0.0, 1.0, 6)[1:]:
        joints = start_rad + fraction * (end_rad - start_rad)
        for link, lowest_m in SAFE_HEIGHT_M.items():
            p = kinematics.T_base_frame(joints, link)[:3, 3]
            if p[2] < lowest_m or (link == TCP_FRAME and np.hypot(p[0], p[1]) < SAFE_RADIUS_M):
                return False
    return True


def joint_move(
    start_rad: Float[np.ndarray, "6"], end_rad: Float[np.ndarray, "6"], max_speed_rad_s: float
) -> tuple[np.ndarray, Float[np.ndarray, "num_waypoints 6"]]:
    """A smooth move in joint space, as fast as the slowest joint allows: times [ns] and joints."""
    largest = float(np.max(np.abs(end_rad - start_rad)))
    # The minimum-jerk law peaks at 15/8 of its mean speed.
    duration_s = max(1.875 * largest / max_speed_rad_s, 0.1)
    s = np.linspace(0.0, 1.0, max(round(duration_s / 0.04), 2) + 1)
    times = np.rint(s * duration_s * 1e9).astype(np.int64)
    return times, start_rad + minimum_jerk(s)[:, None] * (end_rad - start_rad)
