"""Judge plans one at a time, from where the objects are seen at rest.

What cannot be decided is answered with ``accepted: null`` and a reason; nothing is ever accepted
by default. How much is simulated for a verdict is counted in steps, so it does not depend on the
machine's speed; the wall clock is the last resort against what hangs.
"""

import hashlib
import queue
import threading
import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.episode.topics import JOINT_STATES, ROBOT_DESCRIPTION, cell_topic
from bridge.errors import GstError
from bridge.robots.robot import Robot, robot_name, robot_of
from bridge.task.causes import Cause
from bridge.task.find import Attached, find_task_file
from bridge.task.plan import Plan
from bridge.task.task_file import ObjectModel, Task, TaskFile
from bridge.task.verdict import Factor, Verdict
from twin.errors import TwinError
from twin.gate.config import GateConfig
from twin.replay.config import START_RAD
from twin.replay.failure import with_reasons
from twin.scene.shape.known import yaw_period_rad

FRAMES = 3
"""Frames per camera that are averaged to find the objects."""
MAX_FRAME_AGE_S = 5.0
"""A camera that has been silent for longer, on the cell's clock, is not trusted."""
MAX_SILENCE_S = 30.0
"""When nothing at all arrived for this long, not counting the time spent on a verdict, the cell is
not trusted to be as it was last seen."""
MAX_JOINT_AGE_S = 1.0
"""Joint states that are older, on the cell's clock or since they arrived, do not say where the
robot is."""
OTHER_SCENE_M = 0.1
"""A plan whose planner expected an object to be farther than this from where it is seen was made
for another scene."""
MOVED_M, MOVED_RAD = 0.01, 0.3
"""An object seen this far from where the verdict has it, or turned by this much, before the answer
is given, has been moved, unless localisation is less sure than that."""
SIGMAS = 4.0
"""What localisation says of its own errors, so many times, is no motion."""


def who_moved(before: Mapping[str, Any], after: Mapping[str, Any], task: Task) -> list[str]:
    """Name the objects that lie elsewhere than before, with how far."""
    told = []
    for name, old in before.items():
        new = after[name]
        shift_m = float(np.linalg.norm(new.T_base_object[:3, 3] - old.T_base_object[:3, 3]))
        turn_rad = turn_between(old.T_base_object, new.T_base_object, task.objects[name])
        sigma_m, sigma_rad = _sigmas(old)
        near = shift_m <= max(MOVED_M, SIGMAS * sigma_m)
        if not (near and turn_rad <= max(MOVED_RAD, SIGMAS * sigma_rad)):  # also what is no number
            told.append(f"{name} by {shift_m * 1e3:.0f} mm and {np.degrees(turn_rad):.0f} degrees")
    return told


def of_another_scene(plan: Plan, found: Mapping[str, Any], task: Task) -> str:
    """Name the first object that a plan's ``entities`` have elsewhere than it is seen; "" if none.

    Objects that look alike may be confused; entities without a position say nothing.
    """
    for name, entity in plan.entities.items():
        p_m = entity.get("p_m") if isinstance(entity, Mapping) else None
        if name not in found or not isinstance(p_m, list | tuple) or len(p_m) != 3:
            continue
        looks = {k: (m.shape, m.mesh, m.size_m, m.color_srgb) for k, m in task.objects.items()}
        like = [key for key in found if looks[key] == looks[name]]
        places = np.stack([found[key].T_base_object[:3, 3] for key in like])
        away_m = float(np.linalg.norm(places - np.array(p_m, dtype=np.float64), axis=1).min())
        if not away_m <= OTHER_SCENE_M:
            return (
                f"it has {name} {away_m * 1e3:.0f} mm from where it is seen, and at most "
                f"{OTHER_SCENE_M * 1e3:.0f} mm are a planner's error"
            )
    return ""


def turn_between(
    T_first: Float[np.ndarray, "4 4"], T_second: Float[np.ndarray, "4 4"], model: ObjectModel
) -> float:
    """Turn about the base's vertical between two poses, among those that look the same [rad]."""
    period = 2 * np.pi if model.soft is not None else yaw_period_rad(model)
    yaws = [np.arctan2(T[1, 0], T[0, 0]) for T in (T_first, T_second)]
    return float(abs(np.mod(yaws[1] - yaws[0] + period / 2, period) - period / 2))


def _sigmas(item: Any) -> tuple[float, float]:
    covariance = getattr(item, "covariance", None)
    if covariance is None:
        return 0.0, 0.0
    return float(np.sqrt(np.trace(covariance[:3, :3]))), float(np.sqrt(covariance[5, 5]))


VALID_S = 5.0
"""A yes holds for so long on the cell's clock, if neither the arm nor an object moves."""
ENGINE_NONE = "none"
ROUNDING = 1e-9
POLL_S = 0.05
ANSWER_S = 0.1
"""Kept back from the wall-clock limit for answering."""
MAX_PLAN_BYTES, MAX_WAYPOINTS = 10_000_000, 20_000
"""Ten minutes of waypoints with joints at 30 Hz are no more; each takes a while to judge."""


class PlanTooLargeError(TwinError):
    """A payload is too large to be read as a plan."""


class UndecidedError(TwinError):
    """There is no basis for a verdict; the message says what is missing."""


@dataclass(frozen=True, kw_only=True)
class JudgedTasks:
    """Which task files a gate judges by: one alone, or whichever a plan names with its hash."""

    only: TaskFile | None = None
    """The one alone; None: any of the run's ``tasks/`` and of those that ship."""
    tasks_dir: Path | None = None
    """The run's folder of task files."""

    def find(self, name: str, sha256: str) -> Task:
        """Return the task that somebody names."""
        if self.only is None:
            if not name or not sha256:
                raise UndecidedError(
                    f"task {name!r} is named {'with' if sha256 else 'without'} the hash of its "
                    "file; a gate that judges any task needs both (task, task_sha256), or its "
                    "--task"
                )
            return find_task_file(
                name, tasks_dir=self.tasks_dir, attached=Attached(sha256=sha256)
            ).task()
        task = self.only.task()
        if name not in ("", task.name):
            raise UndecidedError(
                f"task {name!r} is asked for; this gate judges {task.name!r} alone. Start it "
                "without --task, or with another one."
            )
        if sha256 not in ("", self.only.sha256):
            raise UndecidedError(
                f"the file of task {task.name!r} that is asked for has sha256 {sha256[:12]}; this "
                f"gate judges by {self.only.origin}, sha256 {self.only.sha256[:12]}"
            )
        return task


Localise = Callable[[Any, Task, float], Mapping[str, Any]]
"""Frames, the task and when to be done, on the monotonic clock [s]; objects as localised."""
Joints = Float[np.ndarray, " num_joints"]
Replay = Callable[[Plan, Task, Mapping[str, Any], str, Joints, float], Verdict]
"""A plan, what it is judged by, the objects as localised, the URDF, where the arm's joints are
[rad] and when to be done, on the monotonic clock [s]."""


@dataclass(frozen=True, kw_only=True)
class Located:
    """Where the gate sees a task's objects."""

    found: bool | None
    """Whether all were found; None: nobody could look."""
    reason: str | None
    objects: Mapping[str, Any] = field(default_factory=dict)
    """As localised, by name; those that were not found too."""

    def records(self) -> list[dict[str, Any]]:
        """One gst localisation v1 record per object."""
        return [item.to_record() for item in self.objects.values()]


class Gate:
    """Judges plans one at a time; every answer comes within the wall-clock limit."""

    def __init__(
        self,
        *,
        tasks: JudgedTasks,
        config: GateConfig,
        perception: Any,  # a ``LiveView``, or what answers as one
        localise: Localise,
        replay: Replay,
        now_ns: Callable[[], int],
        judged_in: Callable[[], Mapping[str, str | None]] = dict,
    ) -> None:
        """Put together what sees, finds objects and replays; ``judged_in``: the run's hashes."""
        self.judged_in = judged_in
        self._cameras_of = judged_in().get("calibration_id")
        self._tasks = tasks
        self._config = config
        self._perception = perception
        self._localise = localise
        self._replay = replay
        self._now_ns = now_ns
        self._turn = threading.Lock()
        self._counting = threading.Lock()
        self._inside = 0
        self._contact_ns = 0
        self._seen: tuple[Task, object, Mapping[str, Any]] | None = None
        """The frames that were looked at last, for which task, and what was found in them."""

    def judge(self, payload: bytes) -> Verdict:
        """Judge one plan; the wall-clock limit counts from here, reading it included."""
        ends_s = time.monotonic() + self._config.deadline_s
        arrived_ns = self._now_ns()
        count = payload.count(b'"t_ns"')  # to look at each would take longer than to judge few
        if len(payload) > MAX_PLAN_BYTES or count > MAX_WAYPOINTS:
            raise PlanTooLargeError(
                f"a payload of {len(payload) / 1e6:.0f} MB with {count} waypoints is not read as "
                f"a plan; at most {MAX_PLAN_BYTES / 1e6:.0f} MB and {MAX_WAYPOINTS} are. Send "
                "fewer waypoints, or split the plan."
            )
        plan = Plan.from_json(payload)
        with self._counting:
            if self._inside > self._config.waiting:
                return no_verdict(plan, f"{self._inside} plans are being judged already; ask later")
            self._inside += 1
        try:
            verdict = self._in_time(plan, arrived_ns, ends_s)
            if verdict.basis is None:
                return verdict
            sha256 = hashlib.sha256(payload).hexdigest()
            return replace(verdict, basis={"plan_sha256": sha256, **verdict.basis})
        finally:
            with self._counting:
                self._inside -= 1

    def localise(self, task_name: str, task_sha256: str = "") -> Located:
        """Say where the objects are now, seen and found as for a verdict; for the planner.

        Bounded like a verdict. What hinders a verdict hinders this: the answer is then undecided.
        """
        ends_s = time.monotonic() + self._config.deadline_s
        if not self._turn.acquire(timeout=self._config.deadline_s):
            return Located(found=None, reason="a plan was being judged up to --deadline")
        silent_ns = self._now_ns() - max(self._perception.heard_ns(), self._contact_ns)
        try:
            task = self._tasks.find(task_name, task_sha256)
            running = self._perception.executing()
            if running is not None:
                raise UndecidedError(f"{running} is being executed; objects are localised at rest")
            self._refuse_silence(silent_ns)
            found = self._look(task, self._wait_for_frames(), ends_s)
            missing = _missing(found)
            return Located(
                found=not missing, reason=with_reasons(missing) if missing else None, objects=found
            )
        except GstError as error:
            return Located(found=None, reason=str(error))
        finally:
            self._contact_ns = self._now_ns() - silent_ns
            self._turn.release()

    def _refuse_silence(self, silent_ns: int) -> None:
        if silent_ns > MAX_SILENCE_S * 1e9:
            raise UndecidedError(f"nothing has arrived from the cell for {silent_ns * 1e-9:.0f} s")

    def _in_time(self, plan: Plan, arrived_ns: int, ends_s: float) -> Verdict:
        limit = f"the wall-clock limit of {self._config.deadline_s:g} s (--deadline)"
        if not self._turn.acquire(timeout=max(0.0, ends_s - time.monotonic())):
            return no_verdict(plan, f"an earlier plan was still being judged at {limit}")
        if time.monotonic() >= ends_s:
            self._turn.release()
            return no_verdict(plan, f"it had only just been read at {limit}")
        answers: queue.SimpleQueue[Verdict] = queue.SimpleQueue()

        def work() -> None:
            try:
                answers.put(self._decide(plan, arrived_ns, ends_s - ANSWER_S))
            finally:
                self._turn.release()

        # What runs in this process cannot be interrupted: past the limit it finishes unheard,
        # and until then holds the turn. A daemon thread does not keep the process from ending.
        worker = threading.Thread(target=work, name=f"judge {plan.id}", daemon=True)
        try:
            worker.start()
        except RuntimeError as error:
            self._turn.release()
            return no_verdict(plan, f"no thread to judge it in: {error}")
        try:
            return answers.get(timeout=max(0.0, ends_s - time.monotonic()))
        except queue.Empty:
            return no_verdict(plan, f"the replay was not done at {limit}")

    def _decide(self, plan: Plan, arrived_ns: int, ends_s: float) -> Verdict:
        silent_ns = self._now_ns() - max(self._perception.heard_ns(), self._contact_ns)
        try:
            task = self._tasks.find(plan.task, plan.task_sha256)
            urdf = self._check(plan)
            self._refuse_silence(silent_ns)
            start_rad = self._where_the_arm_is(arrived_ns, robot_of(urdf))
            verdict = self._judged(plan, task, urdf, start_rad, ends_s)
            # A cell that waits for the verdict may stand still meanwhile: not counted as silence.
            self._contact_ns = self._now_ns() - silent_ns
            return verdict
        except GstError as error:
            return no_verdict(plan, str(error))
        except Exception as error:  # noqa: BLE001  # a bug must not become a yes, nor silence
            traceback.print_exc()
            return no_verdict(plan, f"internal error: {type(error).__name__}: {error}")

    def _where_the_arm_is(self, arrived_ns: int, robot: Robot) -> Joints:
        """The arm's joints as the cell said last, in their order [rad]."""
        known = self._perception.joints()
        topic = cell_topic(self._config.cell, JOINT_STATES)
        if known is None:
            raise UndecidedError(f"no joint states have arrived on {topic}")
        heard, received_ns = known
        missing = [name for name in robot.joints if name not in heard.names]
        if missing:
            raise UndecidedError(
                f"the joint states on {topic} are of another robot: they name "
                f"{', '.join(heard.names) or 'nothing'}, and lack {', '.join(missing)}"
            )
        behind_ns = self._perception.newest_ns() - heard.stamp_ns
        silent_ns = arrived_ns - max(received_ns, self._contact_ns)
        age_s, limit_s = max(behind_ns, silent_ns) * 1e-9, MAX_JOINT_AGE_S
        if age_s > limit_s:
            raise UndecidedError(
                f"the joint states on {topic} are {age_s:.1f} s old, and only those of the last "
                f"{limit_s:g} s say where the robot is"
            )
        order = [heard.names.index(name) for name in robot.joints]
        values: Joints = np.asarray(heard.position, dtype=np.float64)
        if len(values) != len(heard.names) or not np.isfinite(values[order]).all():
            raise UndecidedError(f"the joint states on {topic} hold no numbers for every joint")
        return values[order]

    def _judged(
        self, plan: Plan, task: Task, urdf: str, start_rad: Joints, ends_s: float
    ) -> Verdict:
        frames = self._wait_for_frames()
        found = self._find_objects(task, frames, ends_s)
        elsewhere = of_another_scene(plan, found, task)
        if elsewhere:
            raise UndecidedError(f"plan {plan.id} was made for another scene: {elsewhere}")
        verdict = self._replay(plan, task, found, urdf, start_rad, ends_s)
        if verdict.accepted is not True:
            return verdict
        if verdict.calibration_id != self._cameras_of:
            raise UndecidedError(
                "the run has been calibrated since the gate started, and it sees by cameras where "
                "they were then. Start it again"
            )
        verdict = self._likely(verdict)
        if verdict.accepted is True:
            self._look_again(task, found, frames, ends_s)
            self._feel_again(start_rad, robot_of(urdf))
            verdict = replace(verdict, basis=self._basis(verdict, start_rad, found))
        return verdict

    def _basis(
        self, verdict: Verdict, start_rad: Joints, found: Mapping[str, Any]
    ) -> dict[str, Any]:
        """What a yes holds for, but for the plan."""
        objects = {
            name: {
                "p_m": item.T_base_object[:3, 3].tolist(),
                "margin_m": max(MOVED_M, SIGMAS * _sigmas(item)[0]),
            }
            for name, item in found.items()
        }
        return {
            "joints_rad": start_rad.tolist(),
            "objects": objects,
            "judged_ns": self._perception.newest_ns(),
            "valid_s": VALID_S,
            "scene_hash": verdict.scene_hash,
            "calibration_id": verdict.calibration_id,
        }

    def _check(self, plan: Plan) -> str:
        """Refuse plans this gate cannot judge; return the robot description."""
        urdf: str | None = self._perception.urdf()
        if urdf is None:
            raise UndecidedError(f"no robot description has arrived on {ROBOT_DESCRIPTION}")
        robot = robot_name(urdf)
        if plan.robot != robot:
            raise UndecidedError(
                f"plan {plan.id} is for robot {plan.robot!r}; the cell's robot is {robot!r}"
            )
        base_frame = robot_of(urdf).base_frame
        if plan.frame != base_frame:
            raise UndecidedError(
                f"plan {plan.id} is given in frame {plan.frame!r}; only {base_frame!r}, the "
                "robot's base, is judged"
            )
        running = self._perception.executing()
        if running is not None:
            raise UndecidedError(f"{running} is being executed; objects are judged at rest")
        return urdf

    def _look(self, task: Task, frames: Any, ends_s: float) -> Mapping[str, Any]:
        """Localise; the same frames are not searched twice: planners ask again from one start."""
        stamps = [(getattr(frame, "camera_id", ""), int(frame.stamp_ns)) for frame in frames]
        if self._seen is None or self._seen[:2] != (task, stamps):
            self._seen = task, stamps, self._localise(frames, task, ends_s)
        return self._seen[2]

    def _find_objects(self, task: Task, frames: Any, ends_s: float) -> Mapping[str, Any]:
        found = self._look(task, frames, ends_s)
        missing = _missing(found)
        if missing:
            raise UndecidedError(f"not every object was found: {with_reasons(missing)}")
        return found

    def _wait_for_frames(self) -> Any:
        ends = time.monotonic() + self._config.frame_wait_s
        while True:
            live = self._frames()
            if live.frames:
                return live.frames
            if time.monotonic() >= ends:
                raise UndecidedError(
                    f"no usable frames within {self._config.frame_wait_s:g} s: "
                    f"{'; '.join(live.reasons)}"
                )
            time.sleep(POLL_S)

    def _frames(self) -> Any:
        return self._perception.frames(
            max_age_ns=round(MAX_FRAME_AGE_S * 1e9), max_per_camera=FRAMES
        )

    def _likely(self, verdict: Verdict) -> Verdict:
        """Refuse what too few samples confirm."""
        wanted = self._config.min_p_success
        if wanted <= 0:
            return verdict
        p = verdict.p_success
        if p is None:
            raise UndecidedError(
                f"--max-steps {self._config.max_steps} leaves no step for a varied replay, and "
                f"{wanted:.0%} of them are to succeed"
            )
        if p["value"] >= wanted:
            return verdict
        told = f"{p['k']:g} of {p['n']:g} varied replays succeed"
        if abs(p["value"] - p["k"] / p["n"]) > ROUNDING:
            told += f", and as far as trials bear them out here {p['value']:.0%} would"
        detail = "; ".join(filter(None, (f"{told}, {wanted:.0%} are asked for", verdict.reason)))
        unlikely = Factor(value=False, cause=Cause.PROBABILITY, detail=detail)
        return replace(
            verdict, terminal=unlikely, reason=f"terminal: {Cause.PROBABILITY}: {detail}"
        )

    def _look_again(self, task: Task, found: Mapping[str, Any], frames: Any, ends_s: float) -> None:
        """Before a yes: UndecidedError if something started or moved since, or nobody sees."""
        running = self._perception.executing()
        if running is not None:
            raise UndecidedError(f"{running} was started while the plan was being judged")
        live = self._frames()
        if not live.frames:
            raise UndecidedError(
                f"the cell was lost from sight while the plan was judged: {'; '.join(live.reasons)}"
            )
        now_ns, then_ns = (max(int(f.stamp_ns) for f in some) for some in (live.frames, frames))
        if now_ns <= then_ns:
            return
        moved = who_moved(found, self._find_objects(task, live.frames, ends_s), task)
        if moved:
            raise UndecidedError(f"moved while the plan was being judged: {'; '.join(moved)}")

    def _feel_again(self, start_rad: Joints, robot: Robot) -> None:
        """Before a yes: the arm must still be where the plan was judged from."""
        arrived_ns = self._contact_ns  # a cell that waits may be silent meanwhile
        off_rad = np.abs(self._where_the_arm_is(arrived_ns, robot) - start_rad)
        joint = int(np.argmax(off_rad))
        if not off_rad[joint] <= START_RAD:
            raise UndecidedError(
                f"the arm moved while the plan was being judged: {robot.joints[joint]} by "
                f"{off_rad[joint]:.3f} rad"
            )


def _missing(found: Mapping[str, Any]) -> dict[str, Any]:
    """Why objects were not found, by name."""
    return {name: item.reason for name, item in found.items() if not item.found}


def no_verdict(plan: Plan, reason: str) -> Verdict:
    """The answer when nothing can be decided: accepted null, with the reason."""
    undecided = Factor(value=None)
    return Verdict(
        plan_id=plan.id,
        trajectory="planned",
        mode="dynamic",
        ik=undecided,
        clearance=undecided,
        terminal=undecided,
        engine=ENGINE_NONE,
        seed=0,
        reason=reason,
    )
