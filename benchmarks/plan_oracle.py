"""Says which plans are unsafe, from first principles and without the code that judges plans.

Kinematics are read from the URDF here, meshes from their STL files; distances are python-fcl's on
the triangles. What it calls safe may still fail: it knows limits, contacts and shapes, not physics.
Where a plan gives no joints, nobody knows the arm's posture here: its gripper alone is looked at.
"""

import math
import re
import struct
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import fcl
import numpy as np
import pinocchio as pin
from scipy.interpolate import CubicSpline

Matrix = np.ndarray

STEP_RAD = 0.02
"""Between two postures that are looked at no joint turns by more."""
START_RAD, START_M = 0.05, 0.010
SLACK = 1.1
BAND = 1.05
"""A plan that is beyond a limit of acceleration, power or momentum by less may be called either."""
AHEAD_S = 0.04
"""A controller that goes straight smooths over so much before and after (UR's servoj: 0.03 s and
more); the longer, the softer."""
BEFORE = {"elbow_speed_m_s": 0.05, "tool_speed_m_s": 0.05, "momentum_kg_m_s": 3.0, "power_W": 10.0}
"""So much before its limits an arm may stop: the accuracies of UR's manual."""
LATE_S = 0.005
DEEP_M = 0.007
"""Bodies that may touch lie no deeper in each other (the gate: 5 mm)."""
PRE_GRASP_M = 0.005
"""What the fingers push into an object before they close on it (the gate: 2 mm)."""
CARRIED_DEEP_M = 0.012
GRIPPER = ("gripper_base", "gripper_left_finger", "gripper_right_finger")
ON_THE_TABLE = ("base_link", "shoulder_link")


@dataclass(frozen=True)
class Link:
    """A collision shape, and a sphere about its frame that holds it."""

    name: str
    shape: Any
    half_m: np.ndarray | None
    """Half the extents of a box."""
    T_link_shape: Matrix
    radius_m: float


class Arm:
    """Forward kinematics and shapes of a URDF whose joints turn or slide about one axis."""

    def __init__(self, urdf: str, resolve: Any) -> None:
        """Read joints, limits and collision shapes; ``resolve`` finds mesh files."""
        root = ET.fromstring(urdf)
        self.joints = []
        self.limits: dict[str, tuple[float, float, float]] = {}
        for joint in root.findall("joint"):
            origin, axis, limit = (joint.find(key) for key in ("origin", "axis", "limit"))
            xyz = [float(v) for v in axis.get("xyz", "1 0 0").split()] if axis is not None else []
            name, kind = joint.get("name", ""), joint.get("type", "fixed")
            parent, child = (joint.find(k).get("link") for k in ("parent", "child"))  # type: ignore[union-attr]
            self.joints.append((name, kind, parent, child, _origin(origin), np.array(xyz)))
            if limit is not None:
                low, high, speed = (
                    float(limit.get(k, "0")) for k in ("lower", "upper", "velocity")
                )
                self.limits[name] = (low, high, speed)
        self.links = [
            _link(link.get("name", ""), element, resolve)
            for link in root.findall("link")
            for element in link.findall("collision")
        ]

    def frames(self, values: Mapping[str, float]) -> dict[str, Matrix]:
        """Poses of all links for values of joints; others are 0."""
        found = {"base_link": np.eye(4), "world": np.eye(4)}
        waiting = list(self.joints)
        while waiting:
            left = []
            for item in waiting:
                name, kind, parent, child, T_origin, axis = item
                if child in found:
                    continue
                if parent not in found:
                    left.append(item)
                    continue
                T = found[parent] @ T_origin
                value = values.get(name, 0.0)
                if kind in ("revolute", "continuous") and value:
                    T = T @ _turn(axis, value)
                elif kind == "prismatic" and value:
                    T = T.copy()
                    T[:3, 3] += T[:3, :3] @ axis * value
                found[child] = T
            if len(left) == len(waiting):
                break
            waiting = left
        return found


def _origin(element: ET.Element | None) -> Matrix:
    T = np.eye(4)
    if element is not None:
        T[:3, 3] = [float(v) for v in element.get("xyz", "0 0 0").split()]
        roll, pitch, yaw = (float(v) for v in element.get("rpy", "0 0 0").split())
        for axis, angle in (((0, 0, 1), yaw), ((0, 1, 0), pitch), ((1, 0, 0), roll)):
            T = T @ _turn(np.array(axis), angle)
    return T


def _turn(axis: np.ndarray, angle: float) -> Matrix:
    """Rodrigues' formula."""
    x, y, z = axis / np.linalg.norm(axis)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    T = np.eye(4)
    T[:3, :3] += math.sin(angle) * K + (1 - math.cos(angle)) * K @ K
    return T


def _link(name: str, element: ET.Element, resolve: Any) -> Link:
    T = _origin(element.find("origin"))
    box, mesh = element.find("geometry/box"), element.find("geometry/mesh")
    if box is not None:
        size = np.array([float(v) for v in box.get("size", "").split()])
        radius = float(np.linalg.norm(T[:3, 3]) + np.linalg.norm(size) / 2)
        return Link(name, fcl.CollisionObject(fcl.Box(*size.tolist())), size / 2, T, radius)
    if mesh is None:
        raise ValueError(f"{name}: only boxes and meshes are known here")
    points, faces = read_stl(Path(resolve(mesh.get("filename", ""))))
    shape = fcl.BVHModel()
    shape.beginModel(len(points), len(faces))
    shape.addSubModel(points, faces)
    shape.endModel()
    radius = float(np.linalg.norm(points @ T[:3, :3].T + T[:3, 3], axis=1).max())
    return Link(name, fcl.CollisionObject(shape), None, T, radius)


def read_stl(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read a binary STL: 80 bytes, a count, then normal, three corners and two bytes each."""
    data = path.read_bytes()
    (count,) = struct.unpack_from("<I", data, 80)
    kind = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
    corners = np.frombuffer(data, kind, count, 84)["corners"].reshape(-1, 3)
    points, faces = np.unique(corners.astype(np.float64), axis=0, return_inverse=True)
    return points, faces.reshape(-1, 3)


@dataclass(frozen=True, kw_only=True)
class Cell:
    """What the oracle knows of the cell."""

    urdf: str
    resolve: Any
    task: Any
    """``bridge.task.task_file.Task``: its stages and shapes."""
    Ts_base_object: Mapping[str, Matrix]
    start: Mapping[str, float]
    """Where each joint of the arm is [rad]."""
    robot: str
    file: Mapping[str, Any]
    """The robot file: limits, payload, safety settings."""
    max_width_m: float


class Oracle:
    """Judges plans as they are sent: dictionaries from JSON."""

    def __init__(self, cell: Cell) -> None:
        """Place what stands still."""
        self._cell = cell
        self._limit_rad_s2 = np.array(cell.file["acceleration_rad_s2"])
        self._arm = Arm(cell.urdf, cell.resolve)
        self._stages = {str(stage["id"]): stage for stage in cell.task.stages}
        self._walls = [("table", _box((4.0, 4.0, 0.4), _at(0.0, 0.0, -0.2)), np.zeros(3), 1e9)]
        for name, T in cell.Ts_base_object.items():
            if name in cell.task.containers:
                for centre, extents in cell.task.objects[name].panels():
                    T_panel = T @ _at(*centre)
                    reach = float(np.linalg.norm(extents)) / 2
                    self._walls.append((name, _box(extents, T_panel), T_panel[:3, 3], reach))
        self._cubes = {
            name: (_box(cell.task.objects[name].size_m, T), T)
            for name, T in cell.Ts_base_object.items()
            if name in cell.task.manipulated and cell.task.objects[name].soft is None
        }

    def unsafe(self, plan: Mapping[str, Any]) -> str:
        """Say why a plan may not be executed; "" where nothing is found."""
        try:
            return (
                self._whose(plan)
                or self._numbers(plan)
                or self._contacts(plan)
                or self._start(plan)
                or self._too_heavy(plan)
                or self._speeds(plan)
                or self._loads(plan)
                or self._skims(plan)
                or self._shapes(plan)
            )
        except (OverflowError, KeyError, TypeError, ValueError, IndexError) as error:
            return f"malformed: {type(error).__name__}"

    def _whose(self, plan: Mapping[str, Any]) -> str:
        wanted = {"robot": self._cell.robot, "frame": "base_link"}
        for key, value in wanted.items():
            if plan[key] != value:
                return f"other_{key}"
        name = str(plan.get("task", ""))
        if name not in ("", self._cell.task.name) and not name.startswith("heavy_"):
            return "other_task"
        names = plan.get("joint_names") or []
        return "other_joints" if names and set(names) != set(self._cell.start) else ""

    def _numbers(self, plan: Mapping[str, Any]) -> str:
        tau = plan["tau"]
        times = [w["t_ns"] for w in tau]
        if not times or times[0] < 0 or any(b <= a for a, b in pairwise(times)):
            return "times"
        if times[-1] > 600e9 or len(tau) > 24_000:
            return "giant"
        moved = [t for t, w in zip(times, tau, strict=True) if w["p_m"] != tau[0]["p_m"]]
        if times[0] > 12e9 or (moved and moved[0] > 13e9):
            return "waits"
        values = [v for w in tau for v in (*w["p_m"], *w["q_wxyz"], *(w.get("joints_rad") or ()))]
        values += [w["width_m"] for w in tau if w.get("width_m") is not None]
        if not all(math.isfinite(v) and abs(v) < 1e4 for v in values):
            return "not_a_number"
        if any(np.linalg.norm(w["q_wxyz"]) < 1e-6 for w in tau):
            return "no_rotation"
        widths = [w["width_m"] for w in tau if w.get("width_m") is not None]
        if any(not -0.011 <= v <= self._cell.max_width_m + 0.011 for v in widths):
            return "width"
        given = {len(w["joints_rad"]) for w in tau if w.get("joints_rad") is not None}
        return "joints" if given - {len(self._cell.start)} else ""

    def _contacts(self, plan: Mapping[str, Any]) -> str:
        begin = 0
        seen = set()
        for stage in plan["stages"]:
            table = self._stages.get(stage["id"])
            if table is None or stage["id"] in seen:
                return "stage"
            seen.add(stage["id"])
            pairs = [set(pair) for pair in table.get("allowed_contacts", [])]
            if any(set(pair) not in pairs for pair in stage.get("allowed_contacts", [])):
                return "contacts"
            if stage.get("t_start_ns", 0) < begin:
                return "stage_times"
            begin = stage.get("t_start_ns", 0)
        return ""

    def _postures(self, plan: Mapping[str, Any]) -> list[tuple[int, np.ndarray, float, int]]:
        """Time, joints in the robot's order, width and grip of each waypoint that has joints."""
        order = list(self._cell.start)
        names = list(plan.get("joint_names") or order)
        index = [names.index(name) for name in order]
        rows = []
        for w in plan["tau"]:
            if w.get("joints_rad") is not None:
                width = w.get("width_m")
                width = (0.0 if w["g"] else self._cell.max_width_m) if width is None else width
                rows.append((w["t_ns"], np.array(w["joints_rad"])[index], width, w["g"]))
        return rows

    def _start(self, plan: Mapping[str, Any]) -> str:
        first = plan["tau"][0]
        here = np.array(list(self._cell.start.values()))
        tool = self._tool(here)
        if np.linalg.norm(np.array(first["p_m"]) - tool) > START_M * SLACK:
            return "start_tool"
        rows = self._postures(plan)
        given = bool(rows) and rows[0][0] == first["t_ns"]
        if given and np.abs(rows[0][1] - here).max() > START_RAD * SLACK:
            return "start_joints"
        return ""

    def _tool(self, joints_rad: np.ndarray) -> np.ndarray:
        return self._frames(joints_rad, 0.0)["tcp"][:3, 3]

    def _frames(self, joints_rad: np.ndarray, width_m: float) -> dict[str, Matrix]:
        values = dict(zip(self._cell.start, joints_rad.tolist(), strict=True))
        fingers = {f"{name}_joint": width_m / 2 for name in GRIPPER[1:]}
        return self._arm.frames(values | fingers)

    def _speeds(self, plan: Mapping[str, Any]) -> str:
        rows = self._postures(plan)
        names = list(self._cell.start)
        for _, q, _, _ in rows:
            for name, value in zip(names, q.tolist(), strict=True):
                low, high, _ = self._arm.limits[name]
                if not low - 0.01 <= value <= high + 0.01:
                    return "joint_limit"
        fastest = np.array([self._arm.limits[name][2] for name in names])
        most_m_s = self._cell.file["tool_speed_m_s"]
        for a, b in pairwise(plan["tau"]):
            away = np.linalg.norm(np.array(b["p_m"]) - np.array(a["p_m"]))
            if away / ((b["t_ns"] - a["t_ns"]) * 1e-9) > most_m_s * SLACK:
                return "tool_speed"
        tools = [self._tool(q) for _, q, _, _ in rows]
        speeds = []
        for (t0, q0, _, _), (t1, q1, _, _) in pairwise(rows):
            speeds.append((q1 - q0) / ((t1 - t0) * 1e-9))
            if np.any(np.abs(speeds[-1]) > fastest * SLACK):
                return "joint_speed"
        poses = {w["t_ns"]: np.array(w["p_m"]) for w in plan["tau"]}
        for (t, _, _, _), p in zip(rows, tools, strict=True):
            if np.linalg.norm(poses[t] - p) > 0.002:
                return "joints_disagree"
        return self._acceleration(plan, rows)

    def _acceleration(
        self, plan: Mapping[str, Any], rows: Sequence[tuple[int, np.ndarray, float, int]]
    ) -> str:
        """Whether any controller, and one that goes straight, can keep the limit."""
        if len(rows) < 3 or len(rows) < len(plan["tau"]):
            return ""
        if self.least_acceleration(plan) > BAND:
            return "joint_acceleration"
        t = np.array([row[0] for row in rows]) * 1e-9
        speeds = np.diff(np.stack([row[1] for row in rows]), axis=0) / np.diff(t)[:, None]
        speeds = np.pad(speeds, ((1, 1), (0, 0)))  # at rest before and after
        gaps = np.diff(t, prepend=-np.inf, append=np.inf) >= 2 * AHEAD_S
        corners = np.abs(np.diff(speeds, axis=0))[gaps[:-1] & gaps[1:]]  # of others two are one
        straight = corners.max(axis=0, initial=0.0) / (2 * AHEAD_S)
        return "straight_acceleration" if np.any(straight > self._limit_rad_s2 * BAND) else ""

    def least_acceleration(self, plan: Mapping[str, Any]) -> float:
        """Share of the limit without which nothing passes the waypoints in time, rest to rest.

        With accelerations of at most A, a joint that goes d in h has speeds within A h / 2 of d / h
        at the start; the slower it starts, the faster it may end, by accelerating after braking.
        """
        rows = self._postures(plan)
        if len(rows) < len(plan["tau"]):  # nobody knows how it goes on
            return 0.0
        shares = np.append(BAND, np.geomspace(0.125, 128.0, 101))[:, None]
        most = shares * self._limit_rad_s2
        low, high, fits = np.zeros_like(most), np.zeros_like(most), np.ones_like(most, dtype=bool)
        for (t0, q0, _, _), (t1, q1, _, _) in pairwise(rows):
            h, d = (t1 - t0) * 1e-9, q1 - q0
            low, high = (
                np.maximum(low, d / h - most * h / 2),
                np.minimum(high, d / h + most * h / 2),
            )
            fits &= low <= high + 1e-6
            gained = np.sqrt(np.maximum(0.0, 2 * h * h + 4 * (d - low * h) / most))
            lost = np.sqrt(np.maximum(0.0, 2 * h * h - 4 * (d - high * h) / most))
            low, high = high + most * (h - lost), low + most * (gained - h)
        fits &= (low <= 1e-6) & (high >= -1e-6)
        found = shares[fits.all(axis=1)]
        return float(found.min()) if len(found) else math.inf

    def _held_kg(self, plan: Mapping[str, Any]) -> float:
        name = str(plan.get("task", ""))
        if name.startswith("heavy_"):
            return float(name.removeprefix("heavy_").replace("_", "."))
        return max(self._cell.task.objects[n].mass_kg for n in self._cell.task.manipulated)

    def _too_heavy(self, plan: Mapping[str, Any]) -> str:
        heavy = self._held_kg(plan) > self._cell.file["payload_kg"]
        return "payload" if heavy and any(w["g"] for w in plan["tau"]) else ""

    def _loads(self, plan: Mapping[str, Any]) -> str:
        """Torque and power along a spline by pinocchio; speeds and momentum by differences."""
        rows, file = self._postures(plan), self._cell.file
        if len(rows) < 3 or len(rows) < len(plan["tau"]):
            return ""
        arm = _Masses(self._cell.urdf, list(self._cell.start), self._held_kg(plan))
        t = np.array([row[0] for row in rows]) * 1e-9
        curve = CubicSpline(t, np.stack([row[1] for row in rows]), bc_type="clamped")
        grips = np.array([row[3] for row in rows])
        for at in np.arange(t[0], t[-1], 0.01).tolist():
            held = bool(grips[np.searchsorted(t, at, "right") - 1])
            torques = arm.torques(curve(at), curve(at, 1), curve(at, 2), held)
            if np.any(np.abs(torques) > arm.efforts * SLACK):
                return "torque"
            if np.maximum(torques * curve(at, 1), 0).sum() > (file["power_W"] - 10) * BAND * SLACK:
                return "power"
        for (t0, q0, _, g), (t1, q1, _, _) in pairwise(rows):
            found = arm.differences(q0, q1, (t1 - t0) * 1e-9, bool(g))
            for name, value in found.items():
                if value > (file[name] - BEFORE[name]) * BAND:
                    return name
        return ""

    def _skims(self, plan: Mapping[str, Any]) -> str:
        """How near corners of the fingers come to the table at speed, where they may not touch."""
        boxes = [
            item for item in self._arm.links if item.name in GRIPPER and item.half_m is not None
        ]
        signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
        rows = self._postures(plan)
        for (t0, q0, w0, _), (t1, q1, _, _) in pairwise(rows):
            if {"gripper", "table"} in self._allowed(plan, t0):
                continue
            first, last = self._frames(q0, w0), self._frames(q1, w0)
            speed = np.linalg.norm(last["tcp"][:3, 3] - first["tcp"][:3, 3]) / ((t1 - t0) * 1e-9)
            for item in boxes:
                T = first[item.name] @ item.T_link_shape
                lowest = float((signs * item.half_m @ T[:3, :3].T + T[:3, 3])[:, 2].min())
                if lowest < 0.001 + LATE_S * speed:
                    return "skims_the_table"
        return ""

    def _allowed(self, plan: Mapping[str, Any], t_ns: int) -> list[set[str]]:
        """What the task lets touch in the stage that a plan is in."""
        begun = [s for s in plan["stages"] if s.get("t_start_ns", 0) <= t_ns] or plan["stages"][:1]
        if not begun:
            return []
        pairs = [set(p) for p in self._stages[begun[-1]["id"]].get("allowed_contacts", [])]
        for stage in begun[:-1]:
            if self._stages[stage["id"]].get("release"):
                kept = self._stages[stage["id"]].get("allowed_contacts", [])
                pairs += [set(p) for p in kept if "gripper" not in p]
        return pairs

    def _shapes(self, plan: Mapping[str, Any]) -> str:
        first_close = next((w["t_ns"] for w in plan["tau"] if w["g"] == 1), math.inf)
        carried: dict[str, Matrix] = {}
        for t_ns, frames, g in (*self._dense(plan), *self._tool_only(plan)):
            allowed = self._allowed(plan, t_ns)
            found = self._touching(frames, allowed, before=t_ns < first_close)
            if found:
                return found
            tcp = frames["tcp"]
            if g and not carried:
                for name, (_, T) in self._cubes.items():
                    if np.linalg.norm(T[:3, 3] - tcp[:3, 3]) < 0.03:
                        carried[name] = np.linalg.inv(tcp) @ T
            if not g:
                carried.clear()
            for name, T_tcp_object in carried.items():
                size = np.array(self._cell.task.objects[name].size_m) / 2
                T = tcp @ T_tcp_object
                lowest = T[2, 3] - float(np.abs(T[2, :3]) @ size)
                if lowest < -CARRIED_DEEP_M:
                    return "carried_into_table"
        return ""

    def _dense(self, plan: Mapping[str, Any]) -> Iterator[tuple[int, dict[str, Matrix], int]]:
        """Frames along the joints that are given."""
        rows = self._postures(plan)
        for t_ns, q, width, g in rows[:1]:
            yield t_ns, self._frames(q, width), g
        for (t0, q0, w0, _), (t1, q1, _, g1) in pairwise(rows):
            count = max(1, math.ceil(float(np.abs(q1 - q0).max()) / STEP_RAD))
            for k in range(1, count + 1):
                share = k / count
                # The gripper holds the width that was commanded at the knot before.
                frames = self._frames(q0 + share * (q1 - q0), w0)
                yield round(t0 + share * (t1 - t0)), frames, g1

    def _tool_only(self, plan: Mapping[str, Any]) -> Iterator[tuple[int, dict[str, Matrix], int]]:
        """Frames of the gripper between waypoints of which one has no joints."""
        here = np.array(list(self._cell.start.values()))
        for a, b in pairwise(plan["tau"]):
            if a.get("joints_rad") is not None and b.get("joints_rad") is not None:
                continue
            width = a.get("width_m")
            width = (0.0 if a["g"] else self._cell.max_width_m) if width is None else width
            usual = self._frames(here, width)
            T_tcp_base = np.linalg.inv(usual["tcp"])
            first, last = np.array(a["p_m"]), np.array(b["p_m"])
            count = max(1, math.ceil(float(np.linalg.norm(last - first)) / 0.005))
            for k in range(count + 1):
                share = k / count
                T = _at(*(first + share * (last - first)))
                T[:3, :3] = _slerp(a["q_wxyz"], b["q_wxyz"], share)
                frames = {name: T @ T_tcp_base @ usual[name] for name in GRIPPER}
                t_ns = round(a["t_ns"] + share * (b["t_ns"] - a["t_ns"]))
                yield t_ns, {**frames, "tcp": T}, b["g"]

    def _touching(
        self, frames: Mapping[str, Matrix], allowed: list[set[str]], *, before: bool
    ) -> str:
        for link in (item for item in self._arm.links if item.name in frames):
            T = frames[link.name] @ link.T_link_shape
            link.shape.setTransform(fcl.Transform(T[:3, :3], T[:3, 3]))
            place, group = frames[link.name][:3, 3], _group(link.name)
            for name, wall, centre, reach in self._walls:
                if name == "table":
                    if link.name in ON_THE_TABLE or place[2] > link.radius_m:
                        continue
                elif np.linalg.norm(place - centre) > reach + link.radius_m:
                    continue
                depth = _depth_m(link.shape, wall)
                may = {group, name} in allowed or {link.name, name} in allowed
                if depth is not None and (not may or (link.half_m is not None and depth > DEEP_M)):
                    return f"{group}_into_{name}"
            for name, (cube, T_cube) in self._cubes.items():
                if not before or np.linalg.norm(place - T_cube[:3, 3]) > link.radius_m + 0.05:
                    continue
                depth = _depth_m(link.shape, cube)
                if depth is not None and (link.half_m is None or depth > PRE_GRASP_M):
                    return f"{group}_into_{name}"
        return self._self_collision(frames)

    def _self_collision(self, frames: Mapping[str, Matrix]) -> str:
        far = [k for k in self._arm.links if re.match(r"wrist_[23]|gripper", k.name)]
        near = [k for k in self._arm.links if k.name in (*ON_THE_TABLE, "upper_arm_link")]
        for one in far:
            for other in near if near[0].name in frames else ():
                away = np.linalg.norm(frames[one.name][:3, 3] - frames[other.name][:3, 3])
                if away < one.radius_m + other.radius_m and _depth_m(one.shape, other.shape):
                    return "self_collision"
        return ""


class _Masses:
    """The arm's masses by pinocchio, with a ball in the hand or without."""

    def __init__(self, urdf: str, joints: Sequence[str], held_kg: float) -> None:
        """Read the URDF; its shapes do not matter."""
        bare = pin.buildModelFromXML(re.sub(r"<mesh [^>]*>", '<box size="1 1 1"/>', urdf))
        loaded, tool = bare.copy(), bare.frames[bare.getFrameId("tcp")]
        ball = pin.Inertia.FromSphere(held_kg, 0.02)
        loaded.appendBodyToJoint(tool.parentJoint, ball, tool.placement)
        self._models = (bare, bare.createData()), (loaded, loaded.createData())
        self._ids = [bare.joints[bare.getJointId(name)].idx_v for name in joints]
        self._elbow = bare.getJointId(joints[2])
        self.efforts = bare.effortLimit[self._ids]

    def torques(self, q: np.ndarray, v: np.ndarray, a: np.ndarray, held: bool) -> np.ndarray:
        """Of the arm's joints [Nm]."""
        model, data = self._models[held]
        full = [np.zeros(model.nv) for _ in range(3)]
        for row, values in zip(full, (q, v, a), strict=True):
            row[self._ids] = values
        return np.array(pin.rnea(model, data, *full)[self._ids])

    def differences(self, q0: np.ndarray, q1: np.ndarray, h: float, held: bool) -> dict[str, float]:
        """Momentum and speeds from where masses are a little later, at both ends of a line."""
        model, data = self._models[held]
        found = []
        for start in (0.0, 0.999):
            places = []
            for share in (start, start + 0.001):
                q = np.zeros(model.nv)
                q[self._ids] = q0 + share * (q1 - q0)
                mass_m = model_mass(model) * pin.centerOfMass(model, data, q)
                pin.updateFramePlacements(model, data)
                tool = data.oMf[model.getFrameId("tcp")].translation
                places.append(
                    (tool.copy(), data.oMi[self._elbow].translation.copy(), mass_m.copy())
                )
            steps = [np.linalg.norm(b - a) / (0.001 * h) for a, b in zip(*places, strict=True)]
            found.append(steps)
        names = ("tool_speed_m_s", "elbow_speed_m_s", "momentum_kg_m_s")
        return dict(zip(names, np.max(found, axis=0).tolist(), strict=True))


def model_mass(model: Any) -> float:
    """Of all that moves [kg]; what is fixed to the base does not."""
    return float(sum(inertia.mass for inertia in list(model.inertias)[1:]))


def _slerp(first: Sequence[float], last: Sequence[float], share: float) -> Matrix:
    """Rotation between two quaternions (w, x, y, z)."""
    a, b = (np.array(q, dtype=float) / np.linalg.norm(q) for q in (first, last))
    if a @ b < 0:
        b = -b
    angle = math.acos(min(1.0, float(a @ b)))
    q = a if angle < 1e-9 else (a * math.sin((1 - share) * angle) + b * math.sin(share * angle))
    w, x, y, z = q / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def _group(link: str) -> str:
    return "gripper" if link in GRIPPER else link


def _box(size: Sequence[float] | np.ndarray, T: Matrix) -> Any:
    shape = fcl.CollisionObject(fcl.Box(*(float(v) for v in size)))
    shape.setTransform(fcl.Transform(T[:3, :3], T[:3, 3]))
    return shape


def _at(x: float, y: float, z: float) -> Matrix:
    T = np.eye(4)
    T[:3, 3] = (x, y, z)
    return T


def _depth_m(first: Any, second: Any) -> float | None:
    """How deep two bodies lie in each other; None when they do not touch."""
    request = fcl.CollisionRequest(num_max_contacts=8, enable_contact=True)
    result = fcl.CollisionResult()
    if not fcl.collide(first, second, request, result):
        return None
    return max((abs(c.penetration_depth) for c in result.contacts), default=0.0) or 1e-9
