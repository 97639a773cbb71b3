"""From tool poses to a timed joint trajectory: straight lines at 20 Hz within the joints' speed."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from bridge.clock import ns_from_s
from bridge.geometry import se3
from bridge.sources.standin.kinematics import Kinematics, slerp_poses
from bridge.task.plan import Waypoint
from bridge.task.robot import MAX_WIDTH_M

WAYPOINT_S = 0.05

TimeLaw = Callable[[Float[np.ndarray, " num_times"]], Float[np.ndarray, " num_times"]]
"""Share of a leg's way done at each share of its time; both run from 0 to 1."""


def minimum_jerk(s: Float[np.ndarray, " num_times"]) -> Float[np.ndarray, " num_times"]:
    """At rest at both ends: Flash and Hogan (1985)."""
    return np.asarray(s**3 * (10 - 15 * s + 6 * s**2))


@dataclass(frozen=True, kw_only=True)
class Leg:
    """One movement of the tool, or a wait when it stays where it is."""

    name: str
    stage: str
    T_base_tcp: Float[np.ndarray, "4 4"]
    duration_s: float
    g: int
    width_m: float | None = None
    """Commanded opening at its end, evenly from the one before; None: shut or wide open by g."""
    law: TimeLaw = minimum_jerk
    step_s: float = WAYPOINT_S
    """Between its waypoints."""


@dataclass(frozen=True, kw_only=True)
class Track:
    """What has been planned so far: waypoints, and when each stage begins and ends."""

    tau: tuple[Waypoint, ...]
    bounds: Mapping[str, tuple[int, int]]
    T_base_tcp: Float[np.ndarray, "4 4"]
    """Where the tool is at the end."""

    @staticmethod
    def at_rest(
        T_base_tcp: Float[np.ndarray, "4 4"], joints_rad: Float[np.ndarray, "6"]
    ) -> "Track":
        """Start with an open gripper."""
        return Track(
            tau=(_waypoint(0, T_base_tcp, joints_rad, 0, MAX_WIDTH_M),),
            bounds={},
            T_base_tcp=T_base_tcp,
        )


def follow_legs(
    before: Track, legs: Sequence[Leg], kinematics: Kinematics, max_joint_speed_rad_s: float
) -> Track:
    """Go on along straight lines at 20 Hz with smooth speed, slower where a joint would race.

    Raises:
        UnreachablePoseError: When the arm cannot follow.
    """
    tau, bounds = list(before.tau), dict(before.bounds)
    T_from, t_ns = before.T_base_tcp, tau[-1].t_ns
    joints = np.array(tau[-1].joints_rad, dtype=np.float64)
    for leg in legs:
        count = max(round(leg.duration_s / leg.step_s), 1)
        while True:
            Ts, rows = _sample_leg(T_from, leg, joints, count, kinematics)
            steps = np.abs(np.diff(np.vstack([joints, rows]), axis=0))
            speed = float(steps.max()) / leg.step_s
            if speed <= max_joint_speed_rad_s:
                break
            count = int(np.ceil(count * 1.02 * speed / max_joint_speed_rad_s))
        begin_ns = t_ns
        for T, row, width in zip(Ts, rows, _widths(tau[-1].width_m, leg, count), strict=True):
            t_ns += ns_from_s(leg.step_s)
            tau.append(_waypoint(t_ns, T, row, leg.g, width))
        bounds[leg.stage] = (bounds.get(leg.stage, (begin_ns, 0))[0], t_ns)
        T_from, joints = leg.T_base_tcp, rows[-1]
    return Track(tau=tuple(tau), bounds=bounds, T_base_tcp=T_from)


def _sample_leg(
    T_from: Float[np.ndarray, "4 4"],
    leg: Leg,
    joints_rad: Float[np.ndarray, "6"],
    count: int,
    kinematics: Kinematics,
) -> tuple[Float[np.ndarray, "num_poses 4 4"], Float[np.ndarray, "num_poses 6"]]:
    Ts = slerp_poses(T_from, leg.T_base_tcp, leg.law(np.arange(1, count + 1) / count))
    rows = []
    for T in Ts:
        joints_rad = kinematics.joints_for(T, joints_rad)
        rows.append(joints_rad)
    return Ts, np.array(rows)


def _widths(before_m: float | None, leg: Leg, count: int) -> list[float]:
    if leg.width_m is None:
        return [0.0 if leg.g else MAX_WIDTH_M] * count
    first = MAX_WIDTH_M if before_m is None else before_m
    return [first + (leg.width_m - first) * k / count for k in range(1, count + 1)]


def _waypoint(
    t_ns: int,
    T: Float[np.ndarray, "4 4"],
    joints_rad: Float[np.ndarray, "6"],
    g: int,
    width_m: float,
) -> Waypoint:
    q, p = se3.split(T)
    w, x, y, z = (float(value) for value in q)
    return Waypoint(
        t_ns=t_ns,
        p_m=(float(p[0]), float(p[1]), float(p[2])),
        q_wxyz=(w, x, y, z),
        g=g,
        width_m=width_m,
        joints_rad=tuple(float(value) for value in joints_rad),
    )
