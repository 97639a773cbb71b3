"""What a replay happens in: the task, the robot, and where the objects were localised before it."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from bridge.episode import streams
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.errors import GstError
from bridge.geometry import se3
from bridge.task.task_file import Task
from twin.physics.config import Unseen
from twin.replay.failure import with_reasons
from twin.scene.localise.episode import Phase, quiet_phases, write_localised
from twin.scene.shape.static import StaticSdf


@dataclass(frozen=True, kw_only=True)
class ReplayScene:
    """One start state. Objects that were not found are absent, never guessed."""

    task: Task
    Ts_base_object: dict[str, Float[np.ndarray, "4 4"]] = field(default_factory=dict)
    """Start poses of the objects that were localised, containers included."""
    urdf: str = ""
    """The robot description, package URIs allowed."""
    scene_hash: str | None = None
    """Content hash of the rebuilt scene; None when there is none."""
    table_height_m: float = 0.0
    """Height of the table top in the robot's base frame [m]."""

    reasons: Mapping[str, str] = field(default_factory=dict)
    """Why an object has no pose."""
    covariances: Mapping[str, Float[np.ndarray, "6 6"]] = field(default_factory=dict)
    """How sure each start pose is: (x, y, z, rotation about x, y, z), base frame; what samples are
    drawn from."""
    calibration_id: str | None = None
    """The calibration whose physics is used; None when there is none."""
    static_sdf: StaticSdf | None = None
    """Distances to what stands still; None: only the table and the containers are known."""
    lattices: Mapping[str, Mapping[str, np.ndarray]] = field(default_factory=dict)
    """Soft objects by the arrays of the scene's lattice; the task's mesh stands in for
    others."""
    unseen: Mapping[str, Unseen] = field(default_factory=dict)
    """Of rigid objects: edges and centre of mass as a draw has them; full and even where absent."""
    notes: tuple[str, ...] = ()
    """What the rebuilt scene does not have, or has in a state in which it is not used."""
    start_rad: Float[np.ndarray, " num_joints"] | None = None
    """Where the arm stands before the plan, as its encoders say; None: not known, not asked."""

    def missing(self) -> list[str]:
        """Objects of the task that have no pose."""
        return [name for name in self.task.objects if name not in self.Ts_base_object]

    def describe_missing(self) -> str:
        """Name the objects without a pose, with the reasons where they are known."""
        why = {name: self.reasons.get(name) for name in self.missing()}
        return f"not localised: {with_reasons(why)}"

    def containers(self) -> dict[str, Float[np.ndarray, "4 4"]]:
        """Poses of the objects that stand still: containers and those declared fixed."""
        return {
            name: T
            for name, T in self.Ts_base_object.items()
            if name in self.task.containers or self.task.objects[name].fixed
        }

    def movable(self) -> dict[str, Float[np.ndarray, "4 4"]]:
        """Poses of the objects that a trajectory may move."""
        fixed = self.containers()
        return {name: T for name, T in self.Ts_base_object.items() if name not in fixed}


@dataclass(frozen=True, kw_only=True)
class StartState:
    """Object poses at one start, and why others are missing."""

    Ts_base_object: dict[str, Float[np.ndarray, "4 4"]] = field(default_factory=dict)
    reasons: dict[str, str] = field(default_factory=dict)
    covariances: dict[str, Float[np.ndarray, "6 6"]] = field(default_factory=dict)
    """How sure each pose is: (x, y, z, rotation about x, y, z), base frame."""
    extents_m: dict[str, Float[np.ndarray, "3"]] = field(default_factory=dict)
    """Soft objects: their outer extents as they were seen."""
    seen_ns: int | None = None
    """Source time of the latest frame that was looked at."""


class StartStates:
    """The quiet phases of one episode with the poses localised in each."""

    def __init__(self, task: Task, phases: list[Phase], states: list[StartState]) -> None:
        """Use ``localised_starts``, or state them directly in a test."""
        self._task = task
        self._known = list(zip(phases, states, strict=True))

    def at(self, stamp_ns: int) -> StartState:
        """The state a plan found that began, or was made, at a source time [ns]."""
        known = self._known
        begun = [each for each in known if each[0].after_ns is None or each[0].after_ns < stamp_ns]
        if not begun:
            return self._nothing("no quiet frames before it")
        phase, state = begun[-1]
        if phase.before_ns is not None and stamp_ns > phase.before_ns:
            return self._nothing("the plan was made while another one was being executed")
        return state

    def after(self, plan_id: str) -> StartState:
        """The state that the last execution of a plan left behind."""
        end = ("end", plan_id)
        ends = [state for phase, state in self._known if (phase.name, phase.plan_id) == end]
        return ends[-1] if ends else self._nothing("no quiet frames after the execution")

    def _nothing(self, reason: str) -> StartState:
        return StartState(reasons=dict.fromkeys(self._task.objects, reason))


def localised_starts(
    run: RunFolder, episode: Episode, task: Task, *, scene_hash: str | None
) -> StartStates:
    """Localise an episode's objects once, keep the answer as a derived episode, and read it.

    An episode that cannot be localised gives no poses, but why. ``scene_hash``: of their scene.
    """
    phases = quiet_phases(episode)
    try:
        path = write_localised(run, episode, task, scene_hash=scene_hash)
        records = streams.localisations(Episode.open(path))
    except GstError as error:
        nothing = StartState(reasons=dict.fromkeys(task.objects, str(error)))
        return StartStates(task, phases, [nothing] * len(phases))
    return StartStates(task, phases, [_state_of(phase, task, records) for phase in phases])


def _state_of(phase: Phase, task: Task, records: list[dict[str, object]]) -> StartState:
    state = StartState(reasons=dict.fromkeys(task.objects, "no localisation record"))
    seen_ns: int | None = None
    for record in records:
        if (record.get("phase"), record.get("plan_id")) != (phase.name, phase.plan_id):
            continue
        name, pose = str(record["object"]), record.get("T_base_object")
        if name not in task.objects:
            continue
        if record["found"] and isinstance(pose, dict):
            state.Ts_base_object[name] = se3.pose_from_record(pose)
            state.reasons.pop(name, None)
            seen_ns = max(seen_ns or 0, int(str(record["stamp_ns"])))
            soft, covariance = record.get("soft_shape"), record.get("covariance")
            if isinstance(soft, dict):
                state.extents_m[name] = np.array(soft["extents_m"], dtype=np.float64)
            if covariance is not None:
                state.covariances[name] = np.array(covariance, dtype=np.float64).reshape(6, 6)
        else:
            state.reasons[name] = str(record.get("reason") or "not found")
    return replace(state, seen_ns=seen_ns)
