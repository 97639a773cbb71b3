"""Look at a robot file before anything is recorded with it: what it says, and what is missing."""

import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from bridge.errors import GstError, UsageError
from bridge.robots.robot import Gripper, Robot, number_of, read_robot
from twin.robot.collision import RobotHulls
from twin.robot.inverse import NUM_POSE, UrInverse, solve_ik
from twin.robot.model import RobotModel, without_dynamics

_POSES, _SEED = 20, 0
_MOST_RAD = 8 * np.pi
"""No arm turns more than four times to one side; degrees look like it."""
_ROUNDED = 1e-3
_INERTIA = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")


def check_robot(name: str, *, urdf_out: Path | None = None) -> dict[str, Any]:
    """Read a robot file, build all that replays need of it, and say what was found."""
    record, text, lost = read_robot(name), "<robot/>", list[str]()
    try:
        text = record.description(lost)
        robot = RobotModel(text)
        hulls = None if lost else RobotHulls(robot)
    except GstError as error:
        more = [f"\n  {level}: {told}" for level, told in _in_text(record, text, lost)]
        raise UsageError(f"{record.name}: {error}{''.join(more)}") from error
    unknown = [None] * len(robot.joints)
    rng = np.random.default_rng(_SEED)  # of poses that some posture reaches
    postures = rng.uniform(robot.lower_rad, robot.upper_rad, (_POSES, len(robot.joints)))
    reached = sum(solve_ik(robot, robot.T_base_tcp(q)).reached for q in postures)
    if urdf_out is not None and hulls is not None:
        urdf_out.parent.mkdir(parents=True, exist_ok=True)
        urdf_out.write_text(text)
    return {
        "name": record.name,
        "base_frame": record.base_frame,
        "tool_frame": record.tool_frame,
        "home_tool_m": robot.T_base_tcp(robot.home_rad)[:3, 3].round(4).tolist(),
        "joints": [
            {
                "name": joint,
                "lower_rad": float(robot.lower_rad[index]),
                "upper_rad": float(robot.upper_rad[index]),
                "velocity_rad_s": float(robot.velocity_limit_rad_s[index]),
                "acceleration_rad_s2": (record.acceleration_rad_s2 or unknown)[index],
                "effort_Nm": float(robot.model.effortLimit[robot.effort_id(joint)]),
                "home_rad": float(robot.home_rad[index]),
            }
            for index, joint in enumerate(robot.joints)
        ],
        "gripper": _widths(record.gripper),
        "mass_kg": float(sum(inertia.mass for inertia in robot.model.inertias)),
        "payload_kg": record.payload_kg,
        "hulls": None if hulls is None else len(hulls.hulls),
        "inverse": "closed form" if UrInverse.for_robot(robot) is not None else "iteration",
        "reached": f"{reached} of {_POSES} random poses",
        "limits": _limits_of_use(robot, record.held),
        "findings": [
            {"level": level, "found": found}
            for level, found in (*_in_text(record, text, lost), *_findings(robot, hulls, text))
        ],
    }


def _widths(gripper: Gripper) -> dict[str, Any] | None:
    """Each finger joint's value when closed, half open and open."""
    if not gripper.fingers:
        return None
    ends = (0.0, gripper.max_width_m / 2, gripper.max_width_m)
    return {
        "max_width_m": gripper.max_width_m,
        "fingers": {
            finger.joint: {f"{width:g}": float(finger.value(width)) for width in ends}
            for finger in gripper.fingers
        },
    }


def _limits_of_use(robot: RobotModel, held: tuple[str, ...]) -> list[str]:
    """What cannot be done with this robot, or is not known of it."""
    record, found = robot.record, []
    lost = [name for name in record.finger_joints if not robot.model.existJointName(name)]
    if lost:
        found.append(f"the URDF lacks the finger joints {', '.join(lost)}: no dynamic replay")
    if not record.gripper.fingers:
        found.append("a fixed tool: plans that grasp are refused")
    if len(record.joints) < NUM_POSE:
        found.append(
            "of a pose the position is reached; the tool turns as far as its joints let it"
        )
    if held:
        found.append(f"held at 0: {', '.join(held)}")
    limits = {
        "acceleration limits are": record.acceleration_rad_s2,
        "payload is": record.payload_kg,
    }
    return found + [f"{name} not known" for name, value in limits.items() if value is None]


def _findings(robot: RobotModel, hulls: RobotHulls | None, text: str) -> Iterator[tuple[str, str]]:
    """Say of each link and joint what it cannot be used for: kinematic, dynamic or gate."""
    for lacking in without_dynamics(robot):
        yield "dynamic", f"the URDF gives {lacking}"
    if hulls is None:
        return
    watched = Counter(hull.link for hull in hulls.hulls)
    bodies = robot.bodies.union(robot.record.gripper.finger_links)
    for link in ET.fromstring(text).findall("link"):
        name, shapes = link.get("name", ""), len(link.findall("collision"))
        if watched[name] < shapes or (name in bodies and not shapes):
            told = f"{watched[name]} of its {shapes} collision shapes are read"
            yield "gate", f"the link {name!r} is not watched: {told}"
    if oversized := hulls.oversized():
        yield "gate", oversized
        return
    for links, why in hulls.left_out.items():
        yield "kinematic", f"{links} are not watched against each other: {why}"


def _in_text(record: Robot, text: str, lost: list[str]) -> Iterator[tuple[str, str]]:
    """What a description lacks or cannot mean, whether or not an arm can be made of it."""
    yield from (("gate", told) for told in lost)
    root = ET.fromstring(text)
    limits = {joint.get("name"): joint.find("limit") for joint in root.findall("joint")}
    for index, name in enumerate(record.joints):
        if (limit := limits.get(name)) is None:
            continue
        lower, upper, speed = (
            number_of(limit.get(key, "0")) for key in ("lower", "upper", "velocity")
        )
        if record.position_rad is not None:
            lower, upper = record.position_rad[index]
        if max(abs(lower), abs(upper)) > _MOST_RAD:
            told = f"{lower:g} to {upper:g} rad; are these degrees?"
            yield "kinematic", f"the joint {name!r} is limited to {told}"
        if record.velocity_rad_s is None and not speed > 0:
            yield "gate", f"the joint {name!r} has a speed of {speed:g}; set velocity_rad_s"
    for link in root.findall("link"):
        for inertia in link.findall("inertial/inertia"):
            xx, yy, zz, xy, xz, yz = (number_of(inertia.get(key, "")) for key in _INERTIA)
            matrix = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
            moments = np.linalg.eigvalsh(matrix) if np.isfinite(matrix).all() else [np.nan] * 3
            if not moments[0] + moments[1] >= moments[2] * (1 - _ROUNDED):
                told = f"the inertia of the link {link.get('name')!r} is no body's: A + B < C"
                yield "dynamic", told


def describe_robot(found: dict[str, Any]) -> str:
    """What a person should look at."""
    lines = [
        f"{found['name']}: {len(found['joints'])} joints, {found['mass_kg']:.1f} kg, "
        f"payload {_or_unknown(found['payload_kg'], 'kg')}",
        f"base {found['base_frame']}, tool {found['tool_frame']}, at home at "
        f"({', '.join(f'{value:.3f}' for value in found['home_tool_m'])}) m",
    ]
    lines += [
        f"  {joint['name']}: {joint['lower_rad']:.3f} to {joint['upper_rad']:.3f} rad, "
        f"{joint['velocity_rad_s']:.2f} rad/s, "
        f"{_or_unknown(joint['acceleration_rad_s2'], 'rad/s2')}, {joint['effort_Nm']:.0f} Nm, "
        f"home {joint['home_rad']:.3f}"
        for joint in found["joints"]
    ]
    if found["gripper"] is not None:
        for joint, values in found["gripper"]["fingers"].items():
            told = ", ".join(f"{width} m at {value:.4f}" for width, value in values.items())
            lines.append(f"  gripper {joint}: {told}")
    lines.append(
        f"{found['hulls'] or 'no'} collision hulls; inverse kinematics by {found['inverse']}, "
        f"{found['reached']} reached"
    )
    lines += [f"{finding['level']}: {finding['found']}" for finding in found["findings"]]
    lines += [f"note: {text}" for text in found["limits"]]
    return "\n".join(lines)


def _or_unknown(value: float | None, unit: str) -> str:
    return "unknown" if value is None else f"{value:g} {unit}"
