"""Plan one movement: around what is in the way, made short, timed, and checked exactly."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np

from bridge.geometry import se3
from bridge.task.causes import Cause
from bridge.task.plan import Plan, Stage, Waypoint
from twin.errors import TwinError
from twin.plan.path.world import SPARE_M, Carried, World, build_world
from twin.plan.problem import Joints, Pose, Poses, Postures, Problem, TimedPath
from twin.replay.clearance.bodies import own_links_touch
from twin.replay.clearance.monitor import MAX_CONTACT_DEPTH_M, Allowed, ClearanceMonitor
from twin.replay.config import ReplayConfig
from twin.robot.collision import hulls_of
from twin.robot.follow import follow_poses
from twin.robot.model import RobotModel

START_TOUCHES, BUDGET_SPENT = "start touches", "budget spent"
REASONS = {1: START_TOUCHES, 2: "goal touches", 3: BUDGET_SPENT, 4: "outside the joint limits"}
"""Why a search ends without a path, by the native search's number."""
_WIDER_M = 0.001
_STRAIGHT_M, _STRAIGHT_RAD = 0.005, 0.05
"""Longest parts of a straight tool movement."""
_JUMP = 6.0
"""A joint that moves more than so many times the median of its steps leaves its branch."""
_LEAST_JUMP_RAD = 0.2
_LAWS = ((1.0, True), (0.25, True), (1.0, False))
"""The first whose chords are free: share of the spacing, and whether corners are rounded."""


RANGE_RAD = 1.0
SHORTCUTS = 60
CONTACT_M_S = 0.1
"""Speed of the tool on straight movements, at whose ends something is touched."""
ACCELERATION_RAD_S2 = 5.0
"""Limit of joints whose acceleration the robot file does not limit."""
STEP_S = 0.02

Way = TypeVar("Way")
Found = TypeVar("Found")


@dataclass(frozen=True, kw_only=True)
class PathConfig:
    """How far a search goes, and how fast the arm may be told to go."""

    max_nodes: int = 5000
    max_postures: int = 150_000
    rounds: int = 4
    """Searches at most, each with what was refused before kept farther away."""
    speed_share: float = 0.95
    """Share of the limits of joint and tool speed that is used."""
    acceleration_share: float = 0.33
    """Share of the limits of acceleration; a third of the UR5's is what MoveIt assumes of it."""
    seed: int = 0
    tool_m_s: float = 0.0
    """Most speed of the tool; 0: what the robot file allows."""
    replay: ReplayConfig = field(default_factory=ReplayConfig)


class NoPathError(TwinError):
    """There is no path, or none was found with the work that was allowed."""

    def __init__(
        self, *, reason: str, bodies: tuple[str, ...] = (), detail: str = "", lacking_m: float = 0.0
    ) -> None:
        """Remember what is in the way, and how much farther apart it should have been."""
        self.reason, self.bodies, self.detail, self.lacking_m = reason, bodies, detail, lacking_m
        self.leg = ""
        """Which movement of several it was; whoever plans several says so."""
        super().__init__(reason)

    def __str__(self) -> str:
        """What is in the way of which movement."""
        leg = f" for {self.leg!r}" if self.leg else ""
        pair = f": {self.bodies[0]} and {self.bodies[1]}" if len(self.bodies) > 1 else ""
        more = f" ({self.detail})" if self.detail else ""
        return f"no path{leg}: {self.reason}{pair}{more}"


@dataclass(frozen=True, kw_only=True)
class Mover:
    """What every movement is asked with: the scene, the hand, what may touch."""

    problem: Problem
    config: PathConfig
    width_m: float
    """Between the pads."""
    carried: Carried | None = None
    allowed: Allowed = frozenset()
    """Pairs that may touch, but not lie in each other."""

    def around(self, start_rad: Joints, goals_rad: Postures) -> TimedPath:
        """Find a collision-free, short, timed movement to one of some postures."""
        config = self.config
        wider: dict[frozenset[str], float] = {}
        refusals: tuple[NoPathError, ...] = ()
        for turn in range(config.rounds):
            world = self._world(wider)
            _let_ends_be(world, np.vstack([start_rad[None], goals_rad]), wider)
            knots = self._searched(world, start_rad, goals_rad, turn, refusals)
            # A margin grows with speed: what was refused is searched again wider, driven slower.
            slower = replace(config, speed_share=config.speed_share * 0.75**turn)
            path = timed_path(world, knots, slower)
            refusals = self.refused(path)
            if not refusals:
                return path
            for refusal in refusals:
                pair = frozenset(refusal.bodies)
                wider[pair] = wider.get(pair, 0.0) + max(refusal.lacking_m, 0.0) + _WIDER_M
        raise refusals[0]

    def straight(
        self, start_rad: Joints, T_base_goal: Pose, *, tool_m_s: float = CONTACT_M_S
    ) -> TimedPath:
        """Move the tool straight to a pose, on the branch of the inverse kinematics it starts on.

        For the last centimetres, where contact is wanted: pairs that may touch are left to the
        exact check.
        """
        knots = _straight_knots(self.problem.robot, start_rad, T_base_goal)
        path = timed_path(self._world({}), knots, self.config, tool_m_s=tool_m_s)
        if refusals := self.refused(path):
            raise refusals[0]
        return path

    def _searched(
        self,
        world: World,
        start_rad: Joints,
        goals_rad: Postures,
        turn: int,
        refusals: tuple[NoPathError, ...],
    ) -> Postures:
        """One native search."""
        outcome, pair, knots, _ = world.motion.find(
            np.ascontiguousarray(start_rad, dtype=np.float64),
            np.ascontiguousarray(goals_rad, dtype=np.float64),
            self.config.seed + turn,
            RANGE_RAD,
            self.config.max_nodes,
            self.config.max_postures,
            SHORTCUTS,
        )
        if outcome:
            bodies = world.names[pair] if pair >= 0 else ()
            detail = f"after a refusal: {refusals[0].detail}" if refusals else ""
            raise NoPathError(reason=REASONS[outcome], bodies=bodies, detail=detail)
        return np.asarray(knots)

    def _world(self, wider_m: Mapping[frozenset[str], float]) -> World:
        """What the search keeps clear of, refused pairs farther."""
        return build_world(
            self.problem,
            width_m=self.width_m,
            eps_col_m=self.config.replay.eps_col_m,
            carried=self.carried,
            allowed=self.allowed,
            wider_m=wider_m,
        )

    def refused(self, path: TimedPath) -> tuple[NoPathError, ...]:
        """Return what the monitor's exact clearance, the last word, refuses of a movement."""
        hulls = hulls_of(self.problem.robot)
        links_touch = own_links_touch(hulls)
        monitor = ClearanceMonitor(self.problem.scene, self._plan(), hulls, self.config.replay)
        poses = self._object_poses(path.joints_rad)
        stamps = np.round(path.times_s * 1e9).astype(np.int64)
        refusals: list[NoPathError] = []
        for index, joints in enumerate(path.joints_rad):
            Ts = {name: rows[index] for name, rows in poses.items()}
            monitor.measure(int(stamps[index]), joints, self.width_m, Ts)
            if links_touch():
                distance_m, links = hulls.self_distance()
                told = f"{links[0]} touches {links[1]}"
                refusals.append(_refused(links, told, -distance_m))
                break
        for failure in monitor.failures:
            one, other = failure.bodies
            if failure.cause == Cause.DEEP_CONTACT:
                found = [c for c in monitor.contacts() if {*c.bodies} == {one, other}]
                least_m = min((contact.min_distance_m for contact in found), default=0.0)
                lacking_m = -MAX_CONTACT_DEPTH_M - least_m
            else:
                lacking_m = monitor.lacking_m[failure.bodies]
            refusals.append(_refused(failure.bodies, failure.detail, lacking_m))
        return tuple(refusals)

    def _object_poses(self, joints_rad: Postures) -> dict[str, Poses]:
        """Where the movable objects are along a movement: at their start, or in the hand."""
        poses = {
            name: np.repeat(T[None], len(joints_rad), axis=0)
            for name, T in self.problem.scene.movable().items()
        }
        if self.carried is not None:
            T_tcp = self.problem.robot.Ts_base_tcp(joints_rad)
            poses[self.carried.object_id] = T_tcp @ self.carried.T_tcp_object
        return poses

    def _plan(self) -> Plan:
        """The one stage that a movement is, as the monitor reads it."""
        pairs = tuple((min(pair), max(pair)) for pair in sorted(self.allowed, key=sorted))
        return Plan(
            id="move",
            planner="",
            policy="",
            condition="",
            robot=self.problem.robot.name,
            frame=self.problem.robot.record.base_frame,
            instruction="",
            stages=(Stage(id="move", text="", allowed_contacts=pairs),),
            tau=(),
        )


def _refused(bodies: tuple[str, ...], detail: str, lacking_m: float) -> NoPathError:
    return NoPathError(reason="refused", bodies=bodies, detail=detail, lacking_m=lacking_m)


def first_free(ways: Iterable[Way], move: Callable[[Way], Found], nothing: str = "") -> Found:
    """Move the first way that is free; where none is, say why the last one is not."""
    failure = NoPathError(reason="unreachable", detail=nothing)
    for way in ways:
        try:
            return move(way)
        except NoPathError as error:
            failure = error
    raise failure


def _let_ends_be(world: World, ends_rad: Postures, wider_m: Mapping[frozenset[str], float]) -> None:
    """Ask of a refused pair no more than it has at the ends, which nobody chooses here."""
    for number, names in enumerate(world.names):
        if frozenset(names) in wider_m:
            at_ends_m = min(world.motion.distance(row, number)[0] for row in ends_rad)
            least_m = world.limits_m[number] - wider_m[frozenset(names)]
            limit_m = min(world.limits_m[number], max(least_m, at_ends_m - SPARE_M))
            world.motion.set_limit(number, limit_m)


def timed_path(
    world: World, knots_rad: Postures, config: PathConfig, *, tool_m_s: float | None = None
) -> TimedPath:
    """Give a path of straight lines its times: corners rounded where that is free."""
    speed, acceleration, limit_m_s = limits_of(world.robot, config)
    wanted = [value for value in (limit_m_s, tool_m_s, config.tool_m_s) if value]
    rows = np.ascontiguousarray(knots_rad, dtype=np.float64)
    tool = min(wanted, default=0.0)
    times, joints = np.zeros(len(rows)), rows
    for share, rounding in _LAWS:
        step_s = share * STEP_S
        times, joints, *_ = world.motion.time(rows, speed, acceleration, tool, step_s, rounding)
        if world.motion.blocked(joints) < 0:
            break
    return TimedPath(times_s=times, joints_rad=joints)


def limits_of(robot: RobotModel, config: PathConfig) -> tuple[Joints, Joints, float]:
    """Return the speeds and accelerations of joints and the tool's speed that are used."""
    record = robot.record
    most = record.acceleration_rad_s2 or (ACCELERATION_RAD_S2,) * len(robot.joints)
    tool = record.tool_speed_m_s or 0.0
    return (
        config.speed_share * robot.velocity_limit_rad_s,
        config.acceleration_share * np.array(most),
        config.speed_share * tool,
    )


def _straight_knots(robot: RobotModel, start_rad: Joints, T_base_goal: Pose) -> Postures:
    """Joints along a straight line of the tool, one branch all the way."""
    T_start = robot.T_base_tcp(start_rad)
    (q_start, p_start), (q_goal, p_goal) = se3.split(T_start), se3.split(T_base_goal)
    way_m = float(np.linalg.norm(p_goal - p_start))
    turn_rad = 2 * np.arccos(min(1.0, abs(float(q_start @ q_goal))))
    count = int(np.ceil(max(way_m / _STRAIGHT_M, turn_rad / _STRAIGHT_RAD, 1.0)))
    shares = np.linspace(0.0, 1.0, count + 1)[1:]
    turns = (se3.interpolate_quaternion(q_start, q_goal, np.array(s)) for s in shares)
    places = p_start + shares[:, None] * (p_goal - p_start)
    Ts = np.stack([se3.transform_from(q, p) for q, p in zip(turns, places, strict=True)])
    followed = follow_poses(robot, Ts, start_rad=start_rad)
    if not followed.reached.all():
        share = shares[int(np.argmin(followed.reached))]
        detail = f"no joints reach the pose at {share * way_m * 1e3:.0f} of {way_m * 1e3:.0f} mm"
        raise NoPathError(reason="unreachable", detail=detail)
    knots = np.concatenate([start_rad[None], followed.joints_rad])
    steps = np.abs(np.diff(knots, axis=0)).max(axis=1)
    if steps.max() > max(_LEAST_JUMP_RAD, _JUMP * float(np.median(steps))):
        share = shares[int(steps.argmax())]
        detail = f"the arm would jump at {share * way_m * 1e3:.0f} of {way_m * 1e3:.0f} mm"
        raise NoPathError(reason="branch", detail=detail)
    return knots


def reversed_path(path: TimedPath) -> TimedPath:
    """The same movement backwards; its limits hold as well."""
    return replace(
        path, times_s=path.times_s[-1] - path.times_s[::-1], joints_rad=path.joints_rad[::-1].copy()
    )


def waypoints_of(
    robot: RobotModel, path: TimedPath, *, g: int, width_m: float, begin_s: float = 0.0
) -> tuple[Waypoint, ...]:
    """The movement as a plan's tau = {(p_t, q_t, g_t)} with its joints."""
    q, p = se3.split(robot.Ts_base_tcp(path.joints_rad))
    rows = zip(path.times_s.tolist(), p.tolist(), q.tolist(), path.joints_rad.tolist(), strict=True)
    return tuple(
        Waypoint(
            t_ns=round((begin_s + t_s) * 1e9),
            p_m=(x, y, z),
            q_wxyz=(w, i, j, k),
            g=g,
            width_m=width_m,
            joints_rad=tuple(joints_rad),
        )
        for t_s, (x, y, z), (w, i, j, k), joints_rad in rows
    )
