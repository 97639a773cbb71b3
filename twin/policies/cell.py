"""Physics of the cell between two targets of a policy, and the limits at which it would stop."""

from itertools import pairwise

import numpy as np
from jaxtyping import Float, Float32

from bridge.episode.metadata import EpisodeInfo
from bridge.episode.streams import JointTrack
from bridge.robots.robot import GRIPPER_WIDTH
from bridge.task.plan import Plan
from bridge.task.predicate import all_hold, evaluate_success
from twin.physics.engines import PhysicsWorld, open_world
from twin.policies.errors import RefusedError, StoppedError
from twin.policies.limits import refuse_target
from twin.policies.starts import Start
from twin.replay.checks import stops_of_arm
from twin.replay.config import STATE_EVERY
from twin.replay.dynamics import Samples, free_start, mesh_hulls, soft_models, spawn
from twin.replay.observed import observed_plan
from twin.replay.path import JointPath
from twin.replay.result import ReplayResult
from twin.replay.verdict import Commanded, judge_states
from twin.robot.collision import hulls_of
from twin.robot.model import check_dynamics, load_robot


class TwinCell:
    """One cell in physics, from a start on. Close it at the end.

    A target is gone to in a straight line in joint space, as a controller interpolates it.
    """

    def __init__(self, start: Start) -> None:
        """Put the robot and the objects where they started, and let them come to rest."""
        self.robot = load_robot(start.scene.urdf)
        check_dynamics(self.robot)
        self.start = start
        self._hulls = hulls_of(self.robot)
        self._soft = soft_models(start.scene)
        self.scene = free_start(start.scene, self._soft)
        self._rate_hz = start.config.physics.rate_hz
        self._world: PhysicsWorld = open_world(
            start.config.engine,
            self._hulls.robot.urdf,
            mesh_hulls(self._hulls),
            start.config.physics,
        )
        spawn(self._world, self.scene, self._soft)
        self._world.reset_robot(start.joints_rad, start.width_m)
        self.target_rad = np.array(start.joints_rad, dtype=np.float64)
        self.target_width_m = float(start.width_m)
        self._world.robot.command(
            self.target_rad.tolist(), [0.0] * len(self.target_rad), self.target_width_m
        )
        for _ in range(round(start.config.settle_before_s * self._rate_hz)):
            self._world.step()
        self._steps = 0
        self._samples = Samples(self.scene, self._soft)
        self._samples.take(self._world, 0)
        self._knots = [(0, self.target_rad)]
        self._widths = [(0, self.target_width_m)]
        self.burst = False

    def steps_of(self, duration_s: float) -> int:
        """Physics steps in a stretch of time; at least one."""
        return max(1, round(duration_s * self._rate_hz))

    @property
    def t_ns(self) -> int:
        """Since the start."""
        return round(self._steps * 1e9 / self._rate_hz)

    def posture(self) -> tuple[Float[np.ndarray, " num_joints"], float]:
        """Joints [rad] and the distance between the pads [m], as encoders would say."""
        return self._world.robot.posture()

    def places(self) -> dict[str, Float[np.ndarray, "4 4"]]:
        """Where the objects are, ``T_base_object``."""
        moving = {name: self._world.T_base_object(name) for name in self.scene.movable()}
        return {**self.scene.Ts_base_object, **moving}

    def nodes_m(self) -> dict[str, Float32[np.ndarray, "num_nodes 3"]]:
        """Where the nodes of soft objects are, base frame [m]."""
        return {
            name: self._world.soft_bodies().nodes_m(name).astype(np.float32) for name in self._soft
        }

    def go(
        self, joints_rad: Float[np.ndarray, " num_joints"], width_m: float, duration_s: float
    ) -> None:
        """Go to a target in a stretch of time.

        Raises:
            StoppedError: A limit of the robot refuses the target, or stops the arm on the way.
        """
        joints_rad = np.asarray(joints_rad, dtype=np.float64)
        count = self.steps_of(duration_s)
        refuse_target(self.robot, self._knots, joints_rad, width_m, count / self._rate_hz)
        velocity = ((joints_rad - self.target_rad) / count * self._rate_hz).tolist()
        self.target_width_m = float(width_m)
        self._follow(count, joints_rad, velocity)
        self.target_rad = joints_rad
        self._knots.append((self.t_ns, joints_rad))
        if width_m != self._widths[-1][1]:
            self._widths.append((self._knots[-2][0], float(width_m)))
        self._stop_where_the_arm_would()

    def _follow(
        self, count: int, joints_rad: Float[np.ndarray, " num_joints"], velocity: list[float]
    ) -> None:
        """So many steps of physics, in a straight line from the target before."""
        first, way = self.target_rad, joints_rad - self.target_rad
        for index in range(1, count + 1):
            target = joints_rad if index == count else first + way * (index / count)
            self._world.robot.command(target.tolist(), velocity, self.target_width_m)
            self._world.step()
            self._steps += 1
            if self._steps % STATE_EVERY == 0 and not self._samples.take(self._world, self.t_ns):
                self.burst = True
                return

    def _stop_where_the_arm_would(self) -> None:
        off_rad = self.posture()[0] - self.target_rad
        pressed_N = np.array([self._world.arm_force_N()])
        now_ns = np.array([self.t_ns])
        for failure in stops_of_arm(now_ns, off_rad[None], pressed_N, self.robot.record):
            raise StoppedError(name=failure.cause, detail=failure.detail)

    def hold(self, duration_s: float) -> None:
        """Stay where the last target was."""
        self.go(self.target_rad, self.target_width_m, duration_s)

    def slow_down(self, duration_s: float) -> None:
        """Go on as slowly as the limits let an arm that moves, at best not at all."""
        step = self.target_rad - self._knots[-2][1] if len(self._knots) > 1 else 0.0
        for share in np.linspace(0.0, 1.0, 11):
            try:
                self.go(self.target_rad + share * step, self.target_width_m, duration_s)
            except RefusedError:
                continue
            return
        self._follow(self.steps_of(duration_s), self.target_rad, [0.0] * len(self.target_rad))

    def rest(self, duration_s: float) -> None:
        """Let everything settle, with the motors where they were sent; nothing stops that."""
        none = [0.0] * len(self.target_rad)
        self._follow(self.steps_of(duration_s), self.target_rad, none)

    def succeeds(self) -> bool:
        """Whether the task is done, as far as the states up to now tell."""
        states = self._samples.states(self._world)
        return all_hold(evaluate_success(self.scene.task, states)) is True

    def judged(self, info: EpisodeInfo) -> tuple[ReplayResult, Plan]:
        """Judge all that happened, and tell it in a plan's words."""
        states = self._samples.states(self._world)
        arm = JointTrack(
            names=self.robot.joints, stamps_ns=states.stamps_ns, position=states.joints_rad
        )
        widths = JointTrack(
            names=(GRIPPER_WIDTH,), stamps_ns=states.stamps_ns, position=states.width_m[:, None]
        )
        plan = observed_plan(arm, widths, self.robot, self.scene.task, info)
        commanded = Commanded(path=self._path(self._knots), trajectory="rollout")
        return judge_states(commanded, states, plan, self.scene, self.start.config), plan

    def _path(self, knots: list[tuple[int, Float[np.ndarray, " num_joints"]]]) -> JointPath:
        times, joints = zip(*knots, strict=True)
        width_times, widths = zip(*self._widths, strict=True)
        return JointPath(
            times_ns=np.array(times, dtype=np.int64),
            joints_rad=np.stack(joints),
            width_times_ns=np.array(width_times, dtype=np.int64),
            width_m=np.array(widths),
            first_close_ns=next(
                (t for (_, was), (t, w) in pairwise(self._widths) if w < was), None
            ),
        )

    def close(self) -> None:
        """Free the engine."""
        self._world.__exit__(None, None, None)
