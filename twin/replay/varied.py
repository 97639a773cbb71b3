"""What a varied replay takes over from the one that it varies: the motion of the arm.

It has other objects, contacts and times of the gripper. So physics begins shortly before the hand
comes near an object, ends once all lie still and it comes near none any more, and a clearance is
measured again where it may be too small now. No other link may touch objects.
"""

from collections.abc import Mapping
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float

from bridge.geometry import se3
from twin.replay.clearance.monitor import MAX_CONTACT_DEPTH_M, ClearanceMonitor
from twin.replay.config import MOVED_M
from twin.replay.result import ReplayResult, States
from twin.replay.scene import ReplayScene
from twin.robot.collision import RobotHulls

AWAY_M = 0.01
"""The hand is away from an object when the box around it is so far from the sphere around that [m]:
its fingers may have been told to move a tenth of a second later."""
HASTE = 1.5
"""Bodies keep so many of the tool's or an object's steps more: ``LATE_S`` asks for 0.6 of their
own, and half of one may be lost between two states."""

Places = Mapping[str, Float[np.ndarray, "*num_steps 3"]]


@lru_cache(maxsize=4)
def hand_box(hulls: RobotHulls) -> Float[np.ndarray, "2 3"]:
    """Middle and half extents of the open hand in the tool's frame [m]. It moves the hulls."""
    robot, gripper = hulls.robot, hulls.robot.record.gripper
    zero = np.zeros(len(robot.joints))
    hulls.place(zero, gripper.max_width_m)
    hand = [np.zeros((1, 3))]  # a tool without links is a point
    for hull, R, t in zip(hulls.hulls, hulls.rotations, hulls.translations, strict=True):
        if hull.link in gripper.links:
            hand.append(se3.apply(se3.invert(robot.T_base_tcp(zero)), hull.points_m @ R.T + t))
    low, high = (end(np.concatenate(hand), axis=0) for end in (np.min, np.max))
    return np.stack([(low + high) / 2, (high - low) / 2])


def hand_near(
    known: ReplayResult, places: Places, scene: ReplayScene, hulls: RobotHulls
) -> Bool[np.ndarray, " num_steps"]:
    """Whether the hand comes near objects at these places, state by state."""
    middle_m, half_m = hand_box(hulls)
    found = np.zeros(len(known.stamps_ns), dtype=bool)
    for name, place in places.items():
        away_m = place - known.Ts_base_tcp[:, :3, 3]
        local = np.einsum("nji,nj->ni", known.Ts_base_tcp[:, :3, :3], away_m) - middle_m
        gaps = np.linalg.norm(np.maximum(np.abs(local) - half_m, 0.0), axis=1)
        found |= gaps < np.linalg.norm(scene.task.objects[name].size_m) / 2 + AWAY_M
    return found


def to_measure(
    known: ReplayResult, states: States, scene: ReplayScene, monitor: ClearanceMonitor
) -> Bool[np.ndarray, " num_steps"]:
    """The states of a varied replay in which a clearance may be too small."""
    known_m, found = known.clearance_m, np.isnan(known.clearance_m)
    joints, widths = states.joints_rad - known.joints_rad, states.width_m - known.width_m
    moved = monitor.reach.travel_m(joints, widths).max(axis=1)
    deepest_m = min((contact.min_distance_m for contact in known.contacts or ()), default=0.0)
    step = np.linalg.norm(np.diff(known.Ts_base_tcp[:, :3, 3], axis=0), axis=1)
    for name, Ts in states.Ts_base_object.items():
        before, size_m = known.Ts_base_object[name], scene.task.objects[name].size_m
        turn = np.linalg.norm((Ts - before)[:, :3, :3], axis=(1, 2))
        shift = np.linalg.norm((Ts - before)[:, :3, 3], axis=1) + turn * np.linalg.norm(size_m) / 2
        moved += shift
        step = np.maximum(step, np.linalg.norm(np.diff(Ts[:, :3, 3], axis=0), axis=1))
        left = [np.linalg.norm(T[:, :3, 3] - T[0, :3, 3], axis=1) > MOVED_M for T in (Ts, before)]
        found |= left[0] != left[1]
        # What the hand may touch may be deeper in it than before.
        near = hand_near(known, {name: Ts[:, :3, 3]}, scene, monitor.hulls)
        touched = states.finger_contact.get(name, near)
        found |= touched & (shift > MAX_CONTACT_DEPTH_M + deepest_m)
    clear_m = np.minimum(known_m, np.append(np.inf, known_m[:-1])) - moved
    least_m = monitor.config.eps_col_m + max(monitor.sigma_m.values(), default=0.0)
    return np.asarray(found | (clear_m < least_m + HASTE * np.append(0.0, step)))
