"""gst plan v1: the stages, constraints and trajectory tau = {(p_t, q_t, g_t)} of one attempt."""

import json
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from bridge.task.record import check_record, load_record, made_of, parse_record

SCHEMA_VERSION = 1
STUDY_ARMS = ("without", "with", "control")
"""How a study treats a start: the first plan is executed; the gate chooses among several; a coin
does. A robot's arm is another thing."""


@dataclass(frozen=True, kw_only=True)
class Waypoint:
    """One commanded instant of the tool centre point, in the plan's frame."""

    t_ns: int
    """Time from the start of the trajectory."""
    p_m: tuple[float, float, float]
    q_wxyz: tuple[float, float, float, float]
    g: int
    """Gripper: 1 closed, 0 open."""
    width_m: float | None = None
    joints_rad: tuple[float, ...] | None = None


@dataclass(frozen=True, kw_only=True)
class Stage:
    """One step of the plan with the contacts it allows and the state it should end in."""

    id: str
    text: str
    subgoal: tuple[dict[str, Any], ...] = ()
    path: tuple[dict[str, Any], ...] = ()
    grasp: str | None = None
    release: str | None = None
    push: str | None = None
    """Object that the closed fingers push."""
    allowed_contacts: tuple[tuple[str, str], ...] = ()
    terminal: tuple[dict[str, Any], ...] = ()
    predicted_objects: dict[str, dict[str, list[float]]] = field(default_factory=dict)
    t_start_ns: int = 0
    t_end_ns: int = 0


@dataclass(frozen=True, kw_only=True)
class Ranking:
    """Which of a planner's candidates a plan is."""

    rank: int
    """0 is the one the planner likes best."""
    cost: float
    """What it is ranked by; less is better."""
    seed: int


@dataclass(frozen=True, kw_only=True)
class SteeredBy:
    """What of a refusal changed this plan."""

    clause: str
    """The factor that failed, and its cause: ``terminal.inside``."""
    bodies: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What will be commanded, and why; the authority over the viewers' trajectory topics."""

    id: str
    planner: str
    policy: str
    condition: str
    robot: str
    frame: str
    instruction: str
    stages: tuple[Stage, ...]
    tau: tuple[Waypoint, ...]
    task: str = ""
    parent_id: str | None = None
    round: int = 0
    start_id: str | None = None
    grounding_source: str = ""
    entities: dict[str, Any] = field(default_factory=dict)
    keypoints_m: tuple[tuple[float, float, float], ...] = ()
    joint_names: tuple[str, ...] = ()
    task_sha256: str = ""
    """Of the task file it was made for; empty: not known."""
    scene_hash: str | None = None
    """Of the rebuilt scene it was made in; None: in none."""
    candidate: Ranking | None = None
    steered_by: SteeredBy | None = None
    study_arm: str = ""
    """One of ``STUDY_ARMS``; empty outside a study."""

    def to_json(self) -> bytes:
        """Serialise, refusing what the schema refuses."""
        record = json.loads(json.dumps({"schema_version": SCHEMA_VERSION, **asdict(self)}))
        for stage in record["stages"]:
            if stage["push"] is None:  # plans that push nothing are written as they always were
                del stage["push"]
        for name in LATER_FIELDS:  # likewise what plans had not from the beginning
            if not record[name]:
                del record[name]
        check_record(record, name="plan")
        return json.dumps(record, separators=(",", ":")).encode()

    @staticmethod
    def from_json(data: bytes) -> "Plan":
        """Parse and check. Raises ``InvalidRecordError`` naming what does not fit."""
        return made_of(Plan, parse_record(data, name="plan"), name="plan")

    @staticmethod
    def outline_from_json(data: bytes) -> "Plan":
        """Parse and check everything but the trajectory, of which the first waypoint alone is kept.

        Checking every waypoint takes longer than reading the rest of an episode.
        """
        record = load_record(data, name="plan")
        if isinstance(record.get("tau"), list):
            record["tau"] = record["tau"][:1]
        return made_of(Plan, check_record(record, name="plan"), name="plan")

    def times_ns(self) -> Int[np.ndarray, " num_waypoints"]:
        """Waypoint times from the start of the trajectory."""
        return np.array([waypoint.t_ns for waypoint in self.tau], dtype=np.int64)

    def positions_m(self) -> Float[np.ndarray, "num_waypoints 3"]:
        """Commanded tool positions."""
        return np.array([waypoint.p_m for waypoint in self.tau], dtype=np.float64)

    def quaternions_wxyz(self) -> Float[np.ndarray, "num_waypoints 4"]:
        """Commanded tool orientations."""
        return np.array([waypoint.q_wxyz for waypoint in self.tau], dtype=np.float64)

    def stage_at(self, t_ns: int) -> Stage | None:
        """Return the stage that covers a time from the start, or None after the last."""
        for stage in self.stages:
            if stage.t_start_ns <= t_ns < stage.t_end_ns:
                return stage
        return self.stages[-1] if self.stages and t_ns >= self.stages[-1].t_end_ns else None


LATER_FIELDS = ("task_sha256", "scene_hash", "candidate", "steered_by", "study_arm")
"""Written only where they say something: plans without them keep their bytes."""
