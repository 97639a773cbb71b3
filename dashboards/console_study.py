"""What the operator's console knows of a study: the next trial, its start, what was answered.

Everything is read from the protocol, the episodes and their labels, so nothing is lost with the
server. Of a trial only task, start and, where nobody is blinded, policy and arm are read: never
a plan or a verdict.
"""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from bridge.episode.catalogue import Entry, label_episode, list_episodes, outcome_of
from bridge.episode.catalogue_store import UNLABELLED
from bridge.episode.metadata import CONDITION_OF, STUDY_ARM_TAG, WITH, Outcome, study_arm_of
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.errors import GstError, UsageError
from bridge.geometry import se3
from bridge.task.find import find_task_file
from bridge.task.protocol import PlannedTrial, Protocol
from bridge.task.task_file import Task, TaskFile
from dashboards.errors import NotHereError
from dashboards.frames import camera_tracks, read_frame
from dashboards.label_page import CAUSES, MAX_LENGTH, text_of
from dashboards.library import episode_path
from dashboards.queue_page import main_camera

VOID = "void"
"""The answer that a trial is void, for the first cause that the protocol names."""
RESULTS = ("success", "failure", "unknown", VOID)
NOT_EXECUTED, NONE_DONE = -1, 0
"""How far a trial came: the robot did nothing at all; it began, and finished no stage."""
MARGIN_M = 0.06
"""Around the objects of a drawn start."""


@dataclass(frozen=True, kw_only=True)
class PlacedObject:
    """One object of a start, as it is to be put down."""

    name: str
    x_m: float
    y_m: float
    yaw_deg: float
    outline: str
    """Points of a polygon, seen from above [mm]: the robot's x is up, its y is left."""
    heading: tuple[float, float, float, float]
    """A line from the middle along the object's own x, in the same drawing."""
    is_fixed: bool


@dataclass(frozen=True, kw_only=True)
class StartView:
    """A start drawn from above."""

    objects: tuple[PlacedObject, ...]
    view_box: str


@dataclass(frozen=True, kw_only=True)
class TrialView:
    """What the operator sees of one trial."""

    id: str
    number: int
    task: str
    instruction: str
    start_id: str
    treatment: str
    """Its code where arms are blinded, else policy and arm."""
    is_blind: bool
    start: StartView | None
    why_no_start: str
    picture_of: str | None
    """An earlier trial from the same start, with a picture of it."""
    stages: tuple[str, ...]
    num_objects: int
    """Objects to be moved; where there are several, those in place are counted."""


@dataclass(frozen=True, kw_only=True)
class Answered:
    """What the operator said of a trial, and which version of it."""

    trial_id: str
    outcome: Outcome | None
    version: str


class ConsoleStudy:
    """The trials of a locked protocol, as far as they are made."""

    def __init__(self, run: RunFolder, protocol: Protocol) -> None:
        """Remember whom to ask."""
        self.run = run
        self.protocol = protocol

    @cached_property
    def order(self) -> tuple[PlannedTrial, ...]:
        """All trials as they are to be made."""
        return tuple(self.protocol.order())

    def entries(self) -> list[Entry]:
        """Return the run's episodes; read anew when one came or was labelled."""
        return _entries(self.run, _stamp(self.run.episodes_dir), _stamp(self.run.notes_dir))

    def made(self) -> dict[int, Entry]:
        """Return the trials that were made, by their number in the order."""
        by_start: dict[tuple[str, str | None], list[Entry]] = {}
        for entry in self.entries():
            if entry.kind == "trial":
                by_start.setdefault((entry.task, entry.start_id), []).append(entry)
        found = {}
        for trial in self.order:
            for entry in by_start.get((trial.task, trial.start_id), ()):
                if self._is_of(entry, trial):
                    found[trial.number] = entry
                    break
        return found

    def _is_of(self, entry: Entry, trial: PlannedTrial) -> bool:
        code = self.protocol.code_of(trial.policy, trial.arm)
        if code and entry.policy == code:
            return True
        arm = study_arm_of(entry.tags) or ("with" if entry.condition == WITH else "without")
        return (entry.policy, arm) == (trial.policy, trial.arm)

    def unanswered(self, made: Mapping[int, Entry]) -> tuple[PlannedTrial, Entry] | None:
        """Return the first trial that was made and that nobody said anything of."""
        for trial in self.order:
            entry = made.get(trial.number)
            if entry is not None and not entry.error and entry.cause == UNLABELLED:
                return trial, entry
        return None

    def next(self, made: Mapping[int, Entry]) -> PlannedTrial | None:
        """Return the first trial that was not made."""
        return next((trial for trial in self.order if trial.number not in made), None)

    def episode_id(self, trial: PlannedTrial) -> str:
        """Name the episode of a trial that is not made; a name that is taken gets a number."""
        taken = {entry.id for entry in self.entries()}
        name = f"trial_{trial.number:04d}"
        others = (f"{name}_{number}" for number in range(2, len(taken) + 3))
        return next(each for each in (name, *others) if each not in taken)

    def about(self, trial: PlannedTrial, operator: str) -> tuple[dict[str, Any], TaskFile | None]:
        """Return what an episode of a trial says of itself, and its task file."""
        code = self.protocol.code_of(trial.policy, trial.arm)
        arm = {} if code else {"condition": CONDITION_OF[trial.arm]}
        tags = [] if code else [f"{STUDY_ARM_TAG}{trial.arm}"]
        file = self._task_file(trial.task)
        task = None if file is None else file.task()
        known = next((entry for entry in reversed(self.entries()) if entry.cell), None)
        where = {} if known is None else {"cell": known.cell, "robot": known.robot}
        info = {
            "task": trial.task,
            "instruction": "" if task is None else task.instruction,
            "policy": code or trial.policy,
            "trial": trial.number,
            "start_id": trial.start_id,
            "start_seed": self._start_seed(trial),
            "operator": operator,
            "stand_in": known is not None and known.stand_in,
            "tags": tags,
            **arm,
            **where,
        }
        return info, file

    def view(self, trial: PlannedTrial, entry_id: str) -> TrialView:
        """Gather what the operator sees of a trial."""
        file = self._task_file(trial.task)
        task = None if file is None else file.task()
        code = self.protocol.code_of(trial.policy, trial.arm)
        arm = "with replanning" if trial.arm == "with" else f"{trial.arm} replanning"
        if trial.arm == "control":
            arm = "control: a coin decides"
        return TrialView(
            id=entry_id,
            number=trial.number,
            task=trial.task,
            instruction="" if task is None else task.instruction,
            start_id=trial.start_id,
            treatment=code or f"{trial.policy}, {arm}",
            is_blind=bool(code),
            start=None if task is None else drawn_start(task, self._start_seed(trial)),
            why_no_start="" if task is not None else f"no task file {trial.task!r} is known here",
            picture_of=self._pictured(trial),
            stages=() if task is None else tuple(_stage_words(stage) for stage in task.stages),
            num_objects=1 if task is None else max(1, len(task.manipulated)),
        )

    def start_picture(self, number: int) -> tuple[bytes, str]:
        """Return the first picture of an earlier trial from the same start, and its media type.

        Raises:
            NotHereError: When there is no such trial or no picture of its start.
        """
        trial = next((each for each in self.order if each.number == number), None)
        source = None if trial is None else self._pictured(trial)
        if source is None:
            message = "no picture of that start was recorded."
            raise NotHereError(message)
        path = episode_path(self.run, source)
        track = main_camera(path)
        return read_frame(path, track.camera_id, track.stamps_ns[0])

    def answered(self, episode_id: str) -> Answered:
        """Return what was said of a trial that was made."""
        path = episode_path(self.run, episode_id)
        outcome = outcome_of(self.run, Episode.open(path))
        shown = outcome
        if outcome is not None and self.protocol.codes:  # its words may name the gate
            shown = replace(outcome, detail=None)
        told = repr(None if shown is None else asdict(shown))
        version = hashlib.sha256(told.encode("utf-8", "surrogatepass")).hexdigest()[:16]
        return Answered(trial_id=episode_id, outcome=outcome, version=version)

    def answer(self, trial: PlannedTrial, record: Mapping[str, Any], operator: str) -> Outcome:
        """Keep what the operator says of a trial; it is on disk when this returns.

        Args:
            record: ``trial`` (id of its episode), ``result`` (one of ``RESULTS``), ``reached``
                (stages that were finished, or ``NOT_EXECUTED``), ``placed`` (objects where they
                belong), ``cause`` and ``note``.

        Raises:
            UsageError: When a part is missing or is something else than it should be.
        """
        file = self._task_file(trial.task)
        task = None if file is None else file.task()
        outcome = outcome_from(record, task, operator, void_cause=self.protocol.void_causes[0])
        label_episode(self.run, str(record["trial"]), outcome)
        return outcome

    def _pictured(self, trial: PlannedTrial) -> str | None:
        for number, entry in self.made().items():
            if number == trial.number or entry.error or entry.start_id != trial.start_id:
                continue
            try:
                if camera_tracks(episode_path(self.run, entry.id)):
                    return entry.id
            except GstError:
                continue
        return None

    def _start_seed(self, trial: PlannedTrial) -> int:
        return int(trial.start_id.rpartition("/")[2])

    def _task_file(self, name: str) -> TaskFile | None:
        wanted = next((task for task in self.protocol.tasks if task.task == name), None)
        return None if wanted is None else _known_task(self.run, name, wanted.task_sha256)


def _stamp(folder: Path) -> int:
    return folder.stat().st_mtime_ns if folder.is_dir() else 0


@lru_cache(maxsize=4)
def _entries(run: RunFolder, _episodes_ns: int, _notes_ns: int) -> list[Entry]:
    return list_episodes(run)


@lru_cache(maxsize=64)
def _known_task(run: RunFolder, name: str, sha256: str) -> TaskFile | None:
    try:
        file = find_task_file(name, tasks_dir=run.path / "tasks")
    except GstError:
        return None
    return file if file.sha256 == sha256 else None


def _stage_words(stage: Mapping[str, Any]) -> str:
    return str(stage.get("text") or stage["id"])


def drawn_start(task: Task, start_seed: int) -> StartView:
    """Draw where a start's objects belong, as its seed declares them."""
    poses = task.draw_start(np.random.default_rng(start_seed))
    objects, corners = [], [np.zeros((1, 2))]
    for name, T_base_object in poses.items():
        model = task.objects[name]
        half_x, half_y = model.size_m[0] / 2, model.size_m[1] / 2
        box = np.array([[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0], [0, 0, 0], [0.8, 0, 0]])
        p_m = se3.apply(T_base_object, box * [half_x, half_y, 0])[:, :2]
        corners.append(p_m[:4])
        drawn = -1000 * p_m[:, ::-1]
        R = T_base_object[:3, :3]
        objects.append(
            PlacedObject(
                name=name,
                x_m=float(T_base_object[0, 3]),
                y_m=float(T_base_object[1, 3]),
                yaw_deg=float(np.degrees(np.arctan2(R[1, 0], R[0, 0]))),
                outline=" ".join(f"{x:.0f},{y:.0f}" for x, y in drawn[:4]),
                heading=(*drawn[4].tolist(), *drawn[5].tolist()),
                is_fixed=model.fixed or name in task.containers,
            )
        )
    seen = np.concatenate(corners)
    low, high = seen.min(axis=0) - MARGIN_M, seen.max(axis=0) + MARGIN_M
    width, height = 1000 * (high[1] - low[1]), 1000 * (high[0] - low[0])
    view_box = f"{-1000 * high[1]:.0f} {-1000 * high[0]:.0f} {width:.0f} {height:.0f}"
    return StartView(objects=tuple(objects), view_box=view_box)


def outcome_from(
    record: Mapping[str, Any], task: Task | None, operator: str, *, void_cause: str
) -> Outcome:
    """Read an answer of the console into the outcome that an episode is labelled with.

    Stages are done in order: those that were finished succeeded, the next one failed, and of the
    rest nobody knows.

    Args:
        task: The task; None where its file is not known, and then without stages.

    Raises:
        UsageError: When a part is missing or is something else than it should be.
    """
    result = record.get("result")
    if result not in RESULTS:
        message = f"result is one of {', '.join(RESULTS)}."
        raise UsageError(message)
    count = 1 if task is None else max(1, len(task.manipulated))
    stages = () if task is None else tuple(str(stage["id"]) for stage in task.stages)
    cause, note = (text_of(record, name, MAX_LENGTH[name]).strip() for name in ("cause", "note"))
    if result == "failure" and cause not in CAUSES:
        message = f"cause is one of: {', '.join(CAUSES)}."
        raise UsageError(message)
    first = {"failure": cause, VOID: void_cause}.get(str(result), "")
    detail = ": ".join(part for part in (first, note) if part)
    if result == VOID:
        result = "unknown"
        stages = ()
    elif result == "unknown":
        stages, detail = (), detail or "the operator cannot tell"
    placed = {"success": count, "failure": 0}.get(str(result), 0)
    if result == "failure" and count > 1:
        placed = _whole(record, "placed", 0, count - 1)
    return Outcome(
        result=str(result),
        unit="object" if count > 1 else "trial",
        k=placed,
        n=count,
        by=operator,
        detail=detail or None,
        stages=_stages(stages, record, is_success=result == "success"),
    )


def _stages(
    names: Sequence[str], record: Mapping[str, Any], *, is_success: bool
) -> tuple[dict[str, str], ...]:
    if not names or is_success:
        return tuple({"id": name, "result": "success"} for name in names)
    reached = _whole(record, "reached", NOT_EXECUTED, len(names))
    if reached == NOT_EXECUTED:
        return ()
    ended = ["success"] * reached + ["failure"] * (reached < len(names))
    ended += ["unknown"] * (len(names) - len(ended))
    return tuple({"id": name, "result": each} for name, each in zip(names, ended, strict=True))


def _whole(record: Mapping[str, Any], name: str, least: int, most: int) -> int:
    number = record.get(name)
    if not isinstance(number, int) or isinstance(number, bool) or not least <= number <= most:
        message = f"{name} is a whole number from {least} to {most}."
        raise UsageError(message)
    return number
