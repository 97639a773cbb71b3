"""Physics of the cell between two targets of a policy, and the limits at which it would stop."""

from collections import deque
from collections.abc import Mapping
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32

from bridge.episode.metadata import EpisodeInfo
from bridge.episode.streams import JointTrack
from bridge.robots.robot import GRIPPER_WIDTH
from bridge.robots.stop import PressedStop
from bridge.task.causes import Cause
from bridge.task.plan import Plan
from bridge.task.predicate import all_hold, evaluate_success
from twin.physics.arm import Arm
from twin.physics.engines import PhysicsWorld, open_world
from twin.policies.errors import RefusedError, StoppedError
from twin.policies.limits import refuse_target
from twin.policies.response import Controller, carrying_Nm, largest_Nm
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

FORCE_EVERY = 2
"""Steps of which the force on the arm is the mean: about the 8 ms of a controller's period."""
SIGHTS = 180
"""Of the last three seconds."""


class Sight(NamedTuple):
    """What there is to see at an instant."""

    t_ns: int
    joints_rad: Float[np.ndarray, " num_joints"]
    width_m: float
    places: Mapping[str, Float[np.ndarray, "4 4"]]
    """Of objects, ``T_base_object``."""
    nodes_m: Mapping[str, Float32[np.ndarray, "num_nodes 3"]]
    """Of soft objects."""


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
        self._largest_Nm = largest_Nm(self.robot)
        self.target_rad = np.array(start.joints_rad, dtype=np.float64)
        self.target_width_m = float(start.width_m)
        self._controller = Controller(
            start.response, self.target_rad, self.target_width_m, self._rate_hz
        )
        for _ in range(round(start.config.settle_before_s * self._rate_hz)):
            self._command()
            self._world.step()
        self._steps = 0
        self._samples = Samples(self.scene, self._soft)
        self._samples.take(self._world, 0)
        self._sights = deque([self._sight()], maxlen=SIGHTS)
        self._knots = [(0, self.target_rad)]
        self._widths = [(0, self.target_width_m)]
        self._pressed = PressedStop(self.robot.record.contact_force_N)
        self._forces_N = deque([0.0], maxlen=FORCE_EVERY)
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

    def sight(self, t_ns: int) -> Sight:
        """What there was to see at an instant not long ago; before the start, at the start."""
        before = (each for each in reversed(self._sights) if each.t_ns <= t_ns)
        return next(before, self._sights[0])

    def _sight(self) -> Sight:
        joints_rad, width_m = self.posture()
        moving = {name: self._world.T_base_object(name) for name in self.scene.movable()}
        nodes_m = {
            name: self._world.soft_bodies().nodes_m(name).astype(np.float32) for name in self._soft
        }
        places = {**self.scene.Ts_base_object, **moving}
        return Sight(self.t_ns, joints_rad, width_m, places, nodes_m)

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
        self.target_width_m = float(width_m)
        stop = self._follow(count, joints_rad)
        self.target_rad = joints_rad
        self._knots.append((self.t_ns, joints_rad))
        if width_m != self._widths[-1][1]:
            self._widths.append((self._knots[-2][0], float(width_m)))
        if stop is not None:
            self._hold_here()
            raise stop

    def _command(self) -> None:
        told, arm = self._controller, self._world.robot
        if told.is_soft and isinstance(arm, Arm):
            joints_rad = arm.posture()[0]
            most_Nm = np.minimum(told.strength_Nm(joints_rad), self._largest_Nm)
            arm.soften(most_Nm, carrying_Nm(self.robot, joints_rad))
        arm.command(told.joints_rad.tolist(), told.velocity_rad_s.tolist(), told.width_m)

    def _follow(
        self, count: int, joints_rad: Float[np.ndarray, " num_joints"], *, stops: bool = True
    ) -> StoppedError | None:
        """So many steps of physics: targets in a straight line from the one before.

        Returns:
            What stopped the arm on the way.
        """
        first, way = self.target_rad, joints_rad - self.target_rad
        for index in range(1, count + 1):
            target = joints_rad if index == count else first + way * (index / count)
            self._controller.step(target, self.target_width_m)
            self._command()
            self._world.step()
            self._steps += 1
            self._forces_N.append(self._world.arm_force_N())
            stop = self._stop_of_arm() if stops and self._steps % FORCE_EVERY == 0 else None
            if stop is not None:
                return stop
            if self._steps % STATE_EVERY:
                continue
            if not self._samples.take(self._world, self.t_ns):
                self.burst = True
                return None
            self._sights.append(self._sight())
        return None

    def _stop_of_arm(self) -> StoppedError | None:
        """Why the arm stops by itself, if it does."""
        off_rad, now_ns = self.posture()[0] - self._controller.joints_rad, np.array([self.t_ns])
        record, nothing = self.robot.record, np.zeros(0)
        for failure in stops_of_arm(now_ns, off_rad[None], nothing, record):
            return StoppedError(name=failure.cause, detail=failure.detail)
        lasted_ns = round(FORCE_EVERY * 1e9 / self._rate_hz)
        pressed = self._pressed.found(float(np.mean(self._forces_N)), lasted_ns)
        return StoppedError(name=Cause.CONTACT_FORCE, detail=pressed) if pressed else None

    def _hold_here(self) -> None:
        """Where an arm that stopped stays."""
        self.target_rad = self.posture()[0]
        self._controller = Controller(
            self.start.response, self.target_rad, self.target_width_m, self._rate_hz
        )

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
        self.rest(duration_s)

    def rest(self, duration_s: float) -> None:
        """Let everything settle, with the motors where they were sent; nothing stops that."""
        self._follow(self.steps_of(duration_s), self.target_rad, stops=False)

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
