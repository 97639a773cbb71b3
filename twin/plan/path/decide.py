"""The last word on a movement: the monitor's exact clearance."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bridge.task.causes import Cause
from bridge.task.plan import Plan, Stage
from twin.plan.path.world import Carried
from twin.plan.problem import Poses, Postures, Problem, TimedPath
from twin.replay.clearance.bodies import own_links
from twin.replay.clearance.monitor import MAX_CONTACT_DEPTH_M, Allowed, ClearanceMonitor
from twin.replay.config import ReplayConfig
from twin.robot.collision import hulls_of

_STAGE = "move"


@dataclass(frozen=True, kw_only=True)
class PathRefusal:
    """Two bodies that come too near on a movement."""

    bodies: tuple[str, str]
    lacking_m: float
    """How much farther apart they should have been."""
    t_ns: int
    detail: str


@dataclass(frozen=True, kw_only=True)
class Decision:
    """What the exact checks say of a movement."""

    refusals: tuple[PathRefusal, ...]
    clearance_m: float
    """Smallest distance over the pairs that may not touch."""

    @property
    def accepted(self) -> bool:
        """Whether nothing was refused."""
        return not self.refusals


def object_poses(
    problem: Problem, joints_rad: Postures, carried: Carried | None
) -> dict[str, Poses]:
    """Where the movable objects are along a movement: at their start, or in the hand."""
    poses = {
        name: np.repeat(T[None], len(joints_rad), axis=0)
        for name, T in problem.scene.movable().items()
    }
    if carried is not None:
        poses[carried.object_id] = problem.robot.Ts_base_tcp(joints_rad) @ carried.T_tcp_object
    return poses


def decide(
    problem: Problem,
    timed: TimedPath,
    *,
    width_m: float,
    config: ReplayConfig,
    carried: Carried | None = None,
    allowed: Allowed = frozenset(),
) -> Decision:
    """Check a movement exactly."""
    hulls, links = hulls_of(problem.robot), own_links(hulls_of(problem.robot))
    contacts = tuple((min(pair), max(pair)) for pair in sorted(allowed, key=sorted))
    monitor = ClearanceMonitor(problem.scene, _plan(problem, contacts), hulls, config)
    poses = object_poses(problem, timed.joints_rad, carried)
    stamps = np.round(timed.times_s * 1e9).astype(np.int64)
    refusals: list[PathRefusal] = []
    clearance_m = float("inf")
    for index, joints in enumerate(timed.joints_rad):
        Ts = {name: rows[index] for name, rows in poses.items()}
        clearance_m = min(clearance_m, monitor.measure(int(stamps[index]), joints, width_m, Ts))
        if links.touch():
            closest = hulls.self_distance()
            refusals.append(
                PathRefusal(
                    bodies=closest.links,
                    lacking_m=-closest.distance_m,
                    t_ns=int(stamps[index]),
                    detail=f"{closest.links[0]} touches {closest.links[1]}",
                )
            )
            break
    refusals += [
        PathRefusal(
            bodies=(failure.bodies[0], failure.bodies[1]),
            lacking_m=monitor.lacking_m[failure.bodies]
            if failure.cause != Cause.DEEP_CONTACT
            else -MAX_CONTACT_DEPTH_M - _least(monitor, failure.bodies),
            t_ns=failure.t_ns,
            detail=failure.detail,
        )
        for failure in monitor.failures
    ]
    return Decision(refusals=tuple(refusals), clearance_m=clearance_m)


def _least(monitor: ClearanceMonitor, bodies: Sequence[str]) -> float:
    """The smallest distance that two bodies had [m]."""
    wanted = frozenset(bodies)
    return min(
        (item.min_distance_m for item in monitor.contacts() if frozenset(item.bodies) == wanted),
        default=0.0,
    )


def _plan(problem: Problem, contacts: tuple[tuple[str, str], ...]) -> Plan:
    """The one stage that a movement is, as the monitor reads it."""
    return Plan(
        id=_STAGE,
        planner="",
        policy="",
        condition="",
        robot=problem.robot.name,
        frame=problem.robot.record.base_frame,
        instruction="",
        stages=(Stage(id=_STAGE, text="", allowed_contacts=contacts),),
        tau=(),
    )
