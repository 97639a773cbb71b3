"""What decides one replay of one trajectory, and so names its file; and its row in a table."""

import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from bridge.episode import schema, streams
from bridge.episode.provenance import hash_settings
from bridge.episode.reader import Episode
from bridge.errors import GstError
from bridge.robots.robot import read_robot
from bridge.task.record import parse_record
from bridge.task.task_file import Task
from bridge.task.verdict import Verdict
from twin.replay.config import ReplayConfig
from twin.replay.deciding import goes_with_success, what_decides
from twin.replay.scene import StartState
from twin.replay.verdict import KINEMATIC_ENGINE, engine_of

REPLAY_VERSION = 29
"""Raise it when the same inputs give another replay, so that old files are redone."""


WITHOUT = -1
"""The ``plan_index`` of an execution whose plan nobody recorded."""


@dataclass(frozen=True, kw_only=True)
class ReplayJob:
    """Everything that decides one replay; its content names the file."""

    episode_path: Path
    episode_sha256: str
    plan_id: str
    plan_index: int
    """Position among the plans of the episode, because ids may repeat; ``WITHOUT`` one."""
    trajectory: str
    start_ns: int
    end_ns: int | None
    """Of the recorded execution, None for a plan that was never executed."""
    task: Task
    start: StartState
    scene_hash: str | None
    config: ReplayConfig
    folder: Path
    duration_s: float = 0.0
    """Of the plan; what takes longer is begun first."""
    end: StartState = field(default_factory=StartState)
    """Where the objects were localised after the execution."""
    run_path: Path | None = None
    """Whose scene folder is used; None: the task's shapes and the table plane."""
    shapes: Mapping[str, str] = field(default_factory=dict)
    """Hashes of the scene's files that a replay reads."""
    calibration_id: str | None = None
    render: bool = False
    """Also draw what the recorded cameras would have seen."""
    robot: str = ""
    """Robot file whose description is used; "": the recorded one."""
    problem: str = ""
    """Why the plan's execution, of which there was one, cannot be replayed."""

    @property
    def was_executed(self) -> bool:
        """Whether the recording says so, also of one that cannot be replayed."""
        return self.end_ns is not None or bool(self.problem)

    @property
    def needs_planned(self) -> bool:
        """Whether it is compared with the planned replay, which must then be there before."""
        return self.trajectory == "executed" and self.config.mode == "dynamic"

    def planned(self) -> "ReplayJob":
        """The planned replay of the same plan from the same start."""
        return replace(self, trajectory="planned")

    def cost(self) -> float:
        """How long it takes, compared with others."""
        if self.config.mode == "kinematic":
            return 0.1 * self.duration_s
        bodies = 1 + len(self.task.soft_objects)
        return (1 + self.config.samples) * bodies * self.duration_s

    def needed_paths(self) -> tuple[Path, ...]:
        """What a process on another machine must see."""
        scene = () if self.run_path is None else (self.run_path,)
        robot = (Path(self.robot).resolve(),) if self.robot.endswith((".toml", ".urdf")) else ()
        return (self.episode_path, self.folder, *scene, *robot)

    def path(self) -> Path:
        """Where the derived episode goes."""
        plan = re.sub(r"[^A-Za-z0-9_-]", "-", self.plan_id)[:60] or "plan"
        mode = self.config.mode
        engine = KINEMATIC_ENGINE if mode == "kinematic" else self.config.engine
        named = (self.episode_path.stem, "replay", self.trajectory, mode, plan, engine)
        return self.folder / ".".join((*named, hash_settings(self.settings()), "mcap"))

    def length_ns(self) -> int:
        """How long the recorded execution took; 0 for a plan that was never executed."""
        return 0 if self.end_ns is None else self.end_ns - self.start_ns

    def settings(self) -> dict[str, Any]:
        """What the settings hash covers: settings, inputs, engine and code version."""
        found: dict[str, Any] = {
            "replay_version": REPLAY_VERSION,
            "engine": engine_of(self.task, self.config),
            "episode_sha256": self.episode_sha256,
            "plan_index": self.plan_index,
            "start_ns": self.start_ns,
            "scene_hash": self.scene_hash,
            "task": asdict(self.task),
            "Ts_base_object": {name: T.tolist() for name, T in self.start.Ts_base_object.items()},
            "config": asdict(self.config),
            "shapes": dict(self.shapes),
            "calibration_id": self.calibration_id,
            "render": self.render,
        }
        if self.robot:
            found["robot"] = hash_settings({"urdf": read_robot(self.robot).description()})
        if self.config.samples:
            spreads = self.start.covariances
            found["covariances"] = {name: spreads[name].tolist() for name in sorted(spreads)}
        if self.trajectory == "executed":
            found["end"] = {name: T.tolist() for name, T in self.end.Ts_base_object.items()}
        return found


MAY_STAY_OPEN = ("settled", "shape", "allowed_contacts")
"""Predicates that a recording without an answer to them may succeed without."""


def row_of_existing(job: ReplayJob) -> dict[str, Any] | None:
    """Return the row of a replay that is there already, None when it must be made."""
    if not job.path().is_file():
        return None
    try:
        episode = Episode.open(job.path())
        verdict, divergence = streams.verdicts(episode)[-1][1], divergence_of(episode)
    except (GstError, IndexError):
        return None
    return judged(job, verdict, divergence, skipped=True)


def divergence_of(episode: Episode) -> dict[str, Any] | None:
    """The gst divergence record of a replay; None where it was compared with nothing."""
    records = [
        parse_record(message.data, name="divergence")
        for message in episode.messages(episode.topics_of_type(schema.DIVERGENCE))
    ]
    return records[-1] if records else None


def row_of_failure(job: ReplayJob, message: str) -> dict[str, Any]:
    """Return the row of a trajectory that was not evaluated, with the reason."""
    return {**_row(job), "error": message, "reason": message}


def _row(job: ReplayJob) -> dict[str, Any]:
    return {
        "episode": job.episode_path.stem,
        "plan": job.plan_id,
        "task": job.task.name,
        "trajectory": job.trajectory,
        "mode": job.config.mode,
        "executed": job.was_executed,
        "file": job.path().name,
        "skipped": False,
        "warnings": [],
        **dict.fromkeys(("accepted", "reason", "error", "predicates", "divergence")),
    }


def judged(
    job: ReplayJob,
    verdict: Verdict,
    divergence: Mapping[str, Any] | None = None,
    *,
    skipped: bool = False,
) -> dict[str, Any]:
    """A trajectory's row: verdict, and where it diverges from the others (None: not compared)."""
    return {
        **_row(job),
        "skipped": skipped,
        "accepted": verdict.accepted,
        "reason": verdict.reason,
        "warnings": list(verdict.warnings),
        "predicates": predicates_hold(verdict),
        "p_success": verdict.p_success,
        "decides": [*what_decides(verdict), *goes_with_success(verdict)],
        "divergence": None if divergence is None else dict(divergence),
    }


def predicates_hold(verdict: Verdict) -> bool | None:
    """Whether the success predicates hold; None when what is known does not say.

    One look afterwards seldom tells whether a thing lies still, kept its shape or was touched:
    those may stay open. A thing that nobody found was not seen to be where it belongs.
    """
    values = [
        item["value"]
        for item in verdict.findings
        if item["value"] is not None or item["kind"] not in MAY_STAY_OPEN
    ]
    if False in values:
        return False
    return None if None in values or not values else True
