"""Replay one trajectory, planned or executed, and judge it: I(tau) = ik x clearance x terminal."""

from collections.abc import Iterable
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from bridge.episode.streams import JointTrack
from bridge.geometry.signals import runs_of_true
from bridge.robots.robot import robot_of
from bridge.task import predicate
from bridge.task.causes import Cause
from bridge.task.check import REFERENCES
from bridge.task.plan import Plan
from bridge.task.task_file import Task
from bridge.task.verdict import Factor, Verdict
from twin.physics.engines import engine_version
from twin.replay.checks import limited_to_task, start_failures, stops_of_arm, task_failures
from twin.replay.clearance.monitor import ClearanceMonitor
from twin.replay.clearance.surroundings import posture_clearance
from twin.replay.config import ReplayConfig
from twin.replay.dynamics import free_start, simulate, soft_models
from twin.replay.execution import path_of_execution
from twin.replay.failure import Failure, factor_from
from twin.replay.grasps import grasps_seen
from twin.replay.motion import held_of, motion_failures, payload_unknown
from twin.replay.path import JointPath, check_path, path_of_plan
from twin.replay.result import ReplayResult, States
from twin.replay.scene import ReplayScene
from twin.replay.varied import to_measure
from twin.robot.collision import hulls_of
from twin.robot.model import load_robot

HELD_BEFORE = "the goal held before anything moved"
REFUSED_BEFORE = "not simulated: refused before physics"
MANY = 8
"""Of more findings than this, those that hold are not worth reading one by one."""


def terminal_factor(
    states: States,
    scene: ReplayScene,
    config: ReplayConfig,  # only its mode counts
    *,
    unreachable_ns: int | None,  # from when on waypoints cannot be reached
) -> Factor:
    """Judge the settled state at the end.

    A soft body that burst, or is turned inside out, makes it false whatever the task asks: the
    middle of a burst body may well lie in the basket.
    """
    if config.mode == "kinematic":
        return Factor(value=None, detail="a kinematic replay does not move objects")
    burst = states.burst
    if burst is not None:
        body, t_ns, cause = burst.object_id, burst.t_ns, Cause.EXPLODED
        detail = f"{body}: {burst.found}"
        return Factor(value=False, first_t_ns=t_ns, cause=cause, bodies=(body,), detail=detail)
    if unreachable_ns is not None:
        detail = f"the trajectory cannot be executed beyond {unreachable_ns * 1e-9:.2f} s"
        return Factor(value=None, detail=detail)
    end_ns = int(states.stamps_ns[-1])
    for name, found in states.broken.items():
        failure = Failure(t_ns=end_ns, cause=Cause.SHAPE, bodies=(name,), detail=f"{name} {found}")
        return factor_from([failure])
    findings = predicate.evaluate_success(scene.task, states)
    value = predicate.all_hold(findings)
    if value is True:
        many = len(findings) > MANY
        why = "every object is where it belongs" if many else _once(f.detail for f in findings)
        return Factor(value=True, detail=why)
    if value is None:
        return Factor(value=None, detail=_why_open(findings, scene))
    index = next(i for i, finding in enumerate(findings) if finding.value is False)
    spec = scene.task.success[index]
    return Factor(
        value=False,
        first_t_ns=end_ns,
        cause=findings[index].kind,
        bodies=tuple(spec[key] for key in REFERENCES if key in spec),
        detail=_once(finding.detail for finding in findings if finding.value is False),
    )


def _why_open(findings: list[predicate.PredicateResult], scene: ReplayScene) -> str:
    """What was not localised is said in the words of the clearance, which is open for it too."""
    if not findings:
        return "the task asks for nothing"
    lost = scene.missing()
    told = []
    for spec, finding in zip(scene.task.success, findings, strict=True):
        if any(spec.get(key) in lost for key in REFERENCES):
            told.append(scene.describe_missing())
        elif finding.value is None:
            told.append(finding.detail)
    return _once(told)


def _once(sentences: Iterable[str]) -> str:
    return "; ".join(dict.fromkeys(sentences))


def findings_of(task: Task, rollout: predicate.Rollout, side: str) -> list[Any]:
    """What each predicate says of a recorded or replayed rollout, as the verdict keeps it.

    Where contacts are known they are asked for, whether or not the task does.
    """
    findings = predicate.evaluate_success(task, rollout)
    asked = any(finding.kind == predicate.ALLOWED_CONTACTS for finding in findings)
    if rollout.contacts is not None and not asked:
        findings.append(predicate.evaluate_contacts(task, rollout))
    records = [{"side": side, **asdict(finding)} for finding in findings]
    return [{"object": record.pop("object_id"), **record} for record in records]


def reason_of(verdict: Verdict) -> str | None:
    """The first factor that fails, or what is open, or the first warning."""
    name = verdict.first_failing
    if name is not None:
        failing = verdict.factors()[name]
        return f"{name}: {failing.cause}: {failing.detail}"
    if verdict.accepted is None:
        names: dict[str | None, list[str]] = {}
        for name, factor in verdict.factors().items():
            if factor.value is None:
                names.setdefault(factor.detail, []).append(name)
        undecided = [f"{' and '.join(open_for)}: {why}" for why, open_for in names.items()]
        return "undecided: " + "; ".join(undecided)
    return verdict.warnings[0] if verdict.warnings else None


KINEMATIC_ENGINE = "pinocchio"
SOFT_ENGINE = "xpbd"


@dataclass(frozen=True, kw_only=True)
class Commanded:
    """What the arm is to do, and what was found wrong with that already."""

    path: JointPath
    trajectory: str
    failures: list[Failure] = field(default_factory=list)
    """Of inverse kinematics and of the path itself."""
    unreachable_ns: int | None = None
    checks: dict[str, list[Failure]] = field(default_factory=dict)
    """Of the checks beside I(tau)."""
    unknown: str | None = None
    """A limit that nobody knows."""


def command_of(plan: Plan, scene: ReplayScene, config: ReplayConfig) -> Commanded:
    """What a plan commands, and what is wrong with that before anything moves.

    Waypoints, inverse kinematics, limits and self-collision; the start is checked where the scene
    knows where the arm is.
    """
    robot = load_robot(scene.urdf)
    hulls = hulls_of(robot)
    open_ = any(waypoint.joints_rad is None for waypoint in plan.tau)
    free = posture_clearance(scene, hulls, config) if open_ else None
    path, failures, unreachable_ns = path_of_plan(
        plan, robot, clearance=free, start_rad=scene.start_rad
    )
    held = held_of(plan, scene.task)
    checks = {"task": task_failures(plan, scene.task), "limits": motion_failures(path, robot, held)}
    if scene.start_rad is not None:
        checks["start"] = start_failures(plan, path, scene.start_rad, robot)
    return Commanded(
        path=path,
        failures=failures + check_path(path, robot, hulls),
        unreachable_ns=unreachable_ns,
        trajectory="planned",
        checks=checks,
        unknown=payload_unknown(robot, held),
    )


def replay_plan(
    plan: Plan,
    scene: ReplayScene,
    config: ReplayConfig,
    *,
    commanded: Commanded | None = None,
    refuse_early: bool = False,
    known: ReplayResult | None = None,
) -> ReplayResult:
    """Replay what a plan commands: waypoints, inverse kinematics, motors, objects.

    Args:
        commanded: What ``command_of`` found, if it was asked: varied replays command the same.
        refuse_early: Simulate nothing once a check that needs no physics says no. The commanded
            path itself must then keep clear, too.
        known: A replay of the same plan by physics, of which this one is a variation: what the two
            have in common is taken from it. Not with soft bodies, nor where it was refused.
    """
    if refuse_early or scene.task.soft_objects:
        known = None
    commanded = commanded or command_of(plan, scene, config)
    commanded = replace(commanded, path=commanded.path.with_late_gripper(config.grip_delay_s))
    case = _Case(commanded=commanded, plan=plan, scene=scene, config=config).ready()
    return case.judged(case.moved(refuse_early=refuse_early, known=known))


def replay_joints(
    track: JointTrack, widths: JointTrack, scene: ReplayScene, config: ReplayConfig, *, plan: Plan
) -> ReplayResult:
    """Replay what the joint encoders and the gripper said during an execution."""
    robot = load_robot(scene.urdf)
    path = path_of_execution(track, widths, plan, config, robot_of(scene.urdf))
    failures = check_path(path, robot, hulls_of(robot))
    commanded = Commanded(path=path, trajectory="executed", failures=failures)
    case = _Case(commanded=commanded, plan=plan, scene=scene, config=config).ready()
    return case.judged(case.moved())


def judge_states(
    commanded: Commanded, states: States, plan: Plan, scene: ReplayScene, config: ReplayConfig
) -> ReplayResult:
    """Judge what physics did while somebody else steered (``plan`` says what), as if replayed."""
    case = _Case(commanded=commanded, plan=plan, scene=scene, config=config)
    monitor = case.monitor()
    clear_m = _clearance_m(monitor, states)
    return case.judged(Moved(states=states, clearance_m=clear_m, monitor=monitor, by_physics=True))


@dataclass(frozen=True, kw_only=True)
class Moved:
    """How everything moved, and how much of that was computed."""

    states: States
    clearance_m: Float[np.ndarray, " num_steps"]
    """Not a number where a varied replay did not measure it."""
    monitor: ClearanceMonitor
    """What it saw, in those states or before them."""
    by_physics: bool
    measured: bool = True
    """Whether clearances are of the whole motion, not of its first state alone."""


@dataclass(frozen=True, kw_only=True)
class _Case:
    """What is commanded, in which scene, and how it is judged."""

    commanded: Commanded
    plan: Plan
    scene: ReplayScene
    config: ReplayConfig

    def ready(self) -> "_Case":
        """With what its task allows, and objects that lie in each other moved apart."""
        scene = self.scene
        if self.config.mode == "dynamic":
            scene = free_start(scene, soft_models(scene))
        return replace(self, scene=scene, plan=limited_to_task(self.plan, scene.task))

    def monitor(self) -> ClearanceMonitor:
        """One that has seen nothing yet."""
        hulls = hulls_of(load_robot(self.scene.urdf))
        return ClearanceMonitor(self.scene, self.plan, hulls, self.config)

    def moved(self, *, refuse_early: bool = False, known: ReplayResult | None = None) -> Moved:
        """Follow the path, with physics unless it is refused before."""
        path, scene, config = self.commanded.path, self.scene, self.config
        monitor, measured = self.monitor(), True
        _pre_grasp(monitor, path)
        by_physics = dynamic = config.mode == "dynamic"
        stamps_ns = path.dense_times_ns(config.states_hz)
        if dynamic and refuse_early:
            found = self.commanded.failures or monitor.failures
            measured = not (found or any(self.commanded.checks.values()))
            ahead = self.monitor()
            if measured:
                _clearance_m(ahead, follow(path, scene, stamps_ns))
            by_physics = measured and not ahead.failures
        if by_physics:
            states = simulate(path, scene, monitor.hulls, config, known=known)
        else:
            states = follow(path, scene, stamps_ns if measured else stamps_ns[:1])
        where = None if known is None else to_measure(known, states, scene, monitor)
        return Moved(
            states=states,
            clearance_m=_clearance_m(monitor, states, where),
            monitor=monitor,
            by_physics=by_physics,
            measured=measured,
        )

    def judged(self, moved: Moved) -> ReplayResult:
        """Every state, with the verdict on them."""
        states = replace(moved.states, contacts=moved.monitor.contacts())
        Ts_base_tcp = load_robot(self.scene.urdf).Ts_base_tcp(states.joints_rad)
        verdict = self._verdict(states, Ts_base_tcp, moved)
        return ReplayResult(
            **vars(states),
            verdict=replace(verdict, reason=reason_of(verdict)),
            Ts_base_tcp=Ts_base_tcp,
            clearance_m=moved.clearance_m,
        )

    def _verdict(
        self, states: States, Ts_base_tcp: Float[np.ndarray, "num_steps 4 4"], moved: Moved
    ) -> Verdict:
        """Every factor and check, and what is worth knowing beside them."""
        commanded, scene, config = self.commanded, self.scene, self.config
        path, checks, unreachable_ns = commanded.path, commanded.checks, commanded.unreachable_ns
        # What was executed is judged by where things end: it is known whether they were dropped.
        planned = moved.by_physics and commanded.trajectory == "planned"
        if planned:
            off_rad = states.joints_rad - path.joints_at(states.stamps_ns)
            record = load_robot(scene.urdf).record
            simulated = stops_of_arm(states.stamps_ns, off_rad, states.arm_force_N, record)
            checks = {**checks, "limits": checks["limits"] + simulated}
        terminal = Factor(value=None, detail=REFUSED_BEFORE)
        undecided: str | None = REFUSED_BEFORE
        if moved.by_physics or config.mode == "kinematic":
            terminal = terminal_factor(states, scene, config, unreachable_ns=unreachable_ns)
        if moved.measured:
            undecided = _clearance_undecided(scene, unreachable_ns, states)
        findings = findings_of(scene.task, states, "replayed") if moved.by_physics else ()
        return Verdict(
            plan_id=self.plan.id,
            trajectory=commanded.trajectory,
            mode=config.mode,
            engine=engine_of(scene.task, config),
            seed=config.seed,
            scene_hash=scene.scene_hash,
            calibration_id=scene.calibration_id,
            ik=factor_from(commanded.failures),
            clearance=factor_from(moved.monitor.failures, undecided=undecided),
            terminal=terminal,
            warnings=(HELD_BEFORE,) if predicate.already_true_at_start(scene.task, states) else (),
            findings=tuple(findings),
            checks={
                name: factor_from(found, undecided=commanded.unknown if name == "limits" else None)
                for name, found in checks.items()
            },
            grasps=grasps_seen(self.plan, path, states, Ts_base_tcp) if planned else (),
            nearest=moved.monitor.nearest() if moved.measured else None,
        )


def _clearance_m(
    monitor: ClearanceMonitor,
    states: States,
    where: Bool[np.ndarray, " num_steps"] | None = None,  # everywhere
) -> Float[np.ndarray, " num_steps"]:
    moving = {n: Ts for n, Ts in states.Ts_base_object.items() if n in monitor.scene.movable()}
    found = np.full(len(states.stamps_ns), np.nan)
    for first, end in [(0, len(found))] if where is None else runs_of_true(where):
        monitor.leap()
        for index in range(max(first - 1, 0), end):
            found[index] = monitor.measure(
                int(states.stamps_ns[index]),
                states.joints_rad[index],
                float(states.width_m[index]),
                {name: Ts[index] for name, Ts in moving.items()},
                {name: nodes[index] for name, nodes in states.nodes_m.items()},
            )
    return found


def follow(path: JointPath, scene: ReplayScene, stamps_ns: Int[np.ndarray, " num_steps"]) -> States:
    """Follow the joints exactly; no physics, so nothing is known of objects that can move."""
    fixed = {
        name: np.repeat(T[None], len(stamps_ns), axis=0) for name, T in scene.containers().items()
    }
    return States(
        stamps_ns=stamps_ns,
        joints_rad=path.joints_at(stamps_ns),
        width_m=path.width_at(stamps_ns),
        Ts_base_object=fixed,
        finger_contact={},
    )


def _pre_grasp(monitor: ClearanceMonitor, path: JointPath) -> None:
    times = path.dense_times_ns()
    if path.first_close_ns is not None:
        times = times[times < path.first_close_ns]
    for t_ns, joints, width in zip(times, path.joints_at(times), path.width_at(times), strict=True):
        monitor.check_pre_grasp(int(t_ns), joints, float(width))


def engine_of(task: Task, config: ReplayConfig) -> str:
    """Name what moved things."""
    if config.mode == "kinematic":
        return KINEMATIC_ENGINE
    soft = f"+{SOFT_ENGINE}" if task.soft_objects else ""
    return f"{engine_version(config.engine)}{soft}"


def _clearance_undecided(
    scene: ReplayScene, unreachable_ns: int | None, states: States
) -> str | None:
    if states.burst is not None:
        return f"known only until {states.burst.object_id} burst"
    if unreachable_ns is not None:
        return f"known only up to the unreachable pose at {unreachable_ns * 1e-9:.2f} s"
    if scene.missing():
        return scene.describe_missing()
    return None
