"""What if: one plan replayed otherwise, by another process, one job at a time.

A job replays the plan as it was set, and with one quantity at several values; where the verdict
flips, values between are tried. Nothing but the run's ``results/what_if/`` is written.
"""

import hashlib
import json
import math
import threading
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from bridge.errors import GstError, UsageError
from bridge.process_pool import Failed, Worker, WorkerLostError
from bridge.whole_file import write_whole
from dashboards.errors import DashboardError
from dashboards.loading import LOADING
from twin.replay.config import ChangeConfig

FOLDER = "what_if"
"""In the run's ``results/``."""
REPLAY_S = 300.0
"""What takes longer is given up."""
BETWEEN = 4
"""Values tried between the last that keeps the verdict and the first that flips it."""
LARGEST = 1e9
"""Beyond this no number is read; the limits of each quantity are far below."""
MAX_NAME = 200
"""Characters of an object's name."""
KEPT = 20
"""Answers of one trial that are remembered, the newest."""


@dataclass(frozen=True, kw_only=True)
class Quantity:
    """Something that can be otherwise."""

    title: str
    unit: str
    nominal: float
    values: tuple[float, ...]
    """Those that are tried, lowest first; a slider goes from the first to the last."""
    is_factor: bool = True

    def distance(self, value: float) -> float:
        """How far from nominal: factors by their logarithm."""
        if self.is_factor:
            return abs(math.log(value / self.nominal))
        return abs(value - self.nominal)

    def middle(self, a: float, b: float) -> float:
        """The value half way between two."""
        return math.sqrt(a * b) if self.is_factor else (a + b) / 2


_FACTORS = (0.25, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0)
_SHIFTS = (-0.04, -0.03, -0.02, -0.01, 0.0, 0.01, 0.02, 0.03, 0.04)
QUANTITIES: Mapping[str, Quantity] = {
    "friction": Quantity(title="Friction of objects", unit="x", nominal=1.0, values=_FACTORS),
    "grip_force": Quantity(title="Grip force", unit="x", nominal=1.0, values=_FACTORS),
    "mass": Quantity(title="Mass of objects", unit="x", nominal=1.0, values=_FACTORS),
    "grip_delay_s": Quantity(
        title="Delay of the gripper",
        unit="s",
        nominal=0.0,
        values=(0.0, 0.1, 0.2, 0.3, 0.4, 0.6, 0.8),
        is_factor=False,
    ),
    "x_m": Quantity(title="Object along x", unit="m", nominal=0.0, values=_SHIFTS, is_factor=False),
    "y_m": Quantity(title="Object along y", unit="m", nominal=0.0, values=_SHIFTS, is_factor=False),
    "turn_rad": Quantity(
        title="Object turned",
        unit="rad",
        nominal=0.0,
        values=(-0.6, -0.4, -0.2, 0.0, 0.2, 0.4, 0.6),
        is_factor=False,
    ),
}


class BusyError(DashboardError):
    """One job at a time."""


@dataclass(frozen=True, kw_only=True)
class Question:
    """What is asked of one trial."""

    run_path: Path
    episode_id: str
    plan_id: str
    change: ChangeConfig
    basis: str = ""
    """Names what the replay is made of; answers that were made of something else are not shown."""
    sweep: str = ""
    """Quantity that goes through its values, the others staying as set; empty: none does."""

    @property
    def folder(self) -> Path:
        """Where episodes and answers go."""
        return self.run_path / "results" / FOLDER


def answers_path(run_path: Path, episode_id: str) -> Path:
    """The file of a trial's answers; its name is a hash, for ids may hold anything.

    Args:
        run_path: The run folder.
        episode_id: Of the trial.
    """
    name = hashlib.sha256(episode_id.encode("utf-8", "surrogatepass")).hexdigest()[:16]
    return run_path / "results" / FOLDER / f"{name}.json"


def read_change(record: Any) -> ChangeConfig:
    """Check what a page sent.

    Raises:
        UsageError: When a part is unknown, no number, or beyond its limits.
    """
    if not isinstance(record, dict):
        raise UsageError("change is an object of numbers.")
    names = {each.name for each in fields(ChangeConfig)}
    values: dict[str, Any] = {}
    for name, value in record.items():
        if name not in names:
            message = f"no quantity {name!r}. There are: {', '.join(sorted(names))}."
            raise UsageError(message)
        if name == "object":
            if not isinstance(value, str) or len(value) > MAX_NAME:
                message = f"object is a name of at most {MAX_NAME} characters."
                raise UsageError(message)
            values[name] = value
            continue
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        if not is_number or not abs(value) < LARGEST:
            message = f"{name} is a number."
            raise UsageError(message)
        values[name] = float(value)
    return ChangeConfig(**values)


@dataclass
class Answer:
    """What came out so far."""

    question: Question
    state: str = "running"
    """running, done, cancelled or broken."""
    message: str = ""
    total: int = 1
    outcomes: list[dict[str, Any]] = field(default_factory=list)
    flip: dict[str, Any] | None = None
    """The smallest change of the swept quantity that flips the verdict."""

    def to_record(self) -> dict[str, Any]:
        """Return plain values for the page and for the file."""
        question = self.question
        return {
            "episode": question.episode_id,
            "plan": question.plan_id,
            "basis": question.basis,
            "change": asdict(question.change),
            "sweep": question.sweep,
            "state": self.state,
            "message": self.message,
            "total": self.total,
            "outcomes": sorted(self.outcomes, key=lambda each: each["value"] or 0.0),
            "flip": self.flip,
        }


Replay = Callable[[tuple[Question, ChangeConfig]], dict[str, Any]]


def replay_one(asked: tuple[Question, ChangeConfig]) -> dict[str, Any]:
    """Replay the plan of a question otherwise; done by the process that works, not by the server.

    Args:
        asked: The question, and what is otherwise this time.
    """
    with LOADING:
        from twin.replay.what_if import WhatIf, replay_changed  # noqa: PLC0415  # loads the twin

    question, change = asked
    return replay_changed(
        WhatIf(
            run_path=question.run_path,
            episode_id=question.episode_id,
            plan_id=question.plan_id,
            change=change,
            folder=question.folder,
        )
    )


class WhatIfJobs:
    """The one job of this server, and what was answered before."""

    def __init__(self, replay: Replay = replay_one) -> None:
        """Start nothing yet; ``replay`` is what a process does for each value."""
        self._replay = replay
        self._lock = threading.Lock()
        self._answer: Answer | None = None
        self._worker: Worker | None = None
        self._cancelled = False

    def start(self, question: Question) -> dict[str, Any]:
        """Begin a job; its first state is returned.

        Raises:
            BusyError: While another one runs; says which.
        """
        with self._lock:
            running = self._answer
            if running is not None and running.state == "running":
                message = (
                    f"a job on {running.question.episode_id} is running; wait for it or cancel it."
                )
                raise BusyError(message)
            answer = Answer(question=question)
            if question.sweep:
                answer.total = len(QUANTITIES[question.sweep].values)
            self._answer, self._cancelled = answer, False
            record = answer.to_record()
        threading.Thread(target=self._work, args=(answer,), daemon=True).start()
        return record

    def state(self, run_path: Path, episode_id: str, basis: str = "") -> dict[str, Any]:
        """What is answered of a trial, and whether a job runs, for this trial or another.

        Args:
            run_path: The run folder.
            episode_id: Of the trial.
            basis: Only answers that were made of this are told.
        """
        with self._lock:
            answer = self._answer
            busy = answer is not None and answer.state == "running"
            mine = answer is not None and (
                answer.question.run_path == run_path and answer.question.episode_id == episode_id
            )
            current = answer.to_record() if answer is not None and mine else None
        return {
            "busy": busy,
            "current": current,
            "answers": [
                each
                for each in read_answers(answers_path(run_path, episode_id))
                if each.get("basis") == basis
            ],
        }

    def cancel(self) -> None:
        """End the job; the process that works is killed and leaves no finished file."""
        with self._lock:
            self._cancelled = True
            worker = self._worker
        if worker is not None:
            worker.close()

    def _work(self, answer: Answer) -> None:
        state, message = "done", ""
        try:
            self._ask_all(answer)
        except WorkerLostError as error:
            state, message = "broken", f"{error}. Ask again, or replay it on the command line."
        except (GstError, OSError) as error:
            state, message = "broken", str(error)
        finally:
            with self._lock:
                if self._cancelled:
                    state, message = "cancelled", "cancelled; what was found before is kept."
                worker, self._worker = self._worker, None
            if worker is not None:
                worker.close()
            if answer.outcomes:
                keep_answer(answer.question, answer.to_record() | {"state": state})
            with self._lock:
                answer.state, answer.message = state, message

    def _ask_all(self, answer: Answer) -> None:
        question = answer.question
        if not question.sweep:
            self._ask(answer, None)
            return
        quantity = QUANTITIES[question.sweep]
        for value in sorted(quantity.values, key=quantity.distance):
            self._ask(answer, value)
        self._find_flip(answer, quantity)

    def _find_flip(self, answer: Answer, quantity: Quantity) -> None:
        """Narrow down where the verdict changes, on the side where less change is needed."""
        ranked = sorted(answer.outcomes, key=lambda each: quantity.distance(each["value"]))
        before = ranked[0]["accepted"]
        flipped = [each for each in ranked if each["accepted"] is (not before)]
        if before is None or not flipped:
            return
        far = flipped[0]["value"]
        kept = [
            each["value"]
            for each in ranked
            if each["accepted"] is before
            and quantity.distance(each["value"]) < quantity.distance(far)
            and (each["value"] - quantity.nominal) * (far - quantity.nominal) >= 0
        ]
        near = max(kept, key=quantity.distance)
        with self._lock:
            answer.total += BETWEEN
        for _ in range(BETWEEN):
            middle = float(f"{quantity.middle(near, far):.4g}")
            accepted = self._ask(answer, middle)
            if accepted is (not before):
                far = middle
            elif accepted is before:
                near = middle
        found = next(each for each in answer.outcomes if each["value"] == far)
        with self._lock:
            answer.flip = {"value": far, "kept": near, "accepted": found["accepted"]}

    def _ask(self, answer: Answer, value: float | None) -> bool | None:
        question = answer.question
        change = question.change
        if value is not None:
            change = read_change(asdict(change) | {question.sweep: value})
        row = self._do(question, change)
        outcome = {
            "value": value,
            "accepted": row["accepted"],
            "why": row["error"] or row["reason"] or "",
            "file": row["file"],
        }
        with self._lock:
            answer.outcomes.append(outcome)
        accepted: bool | None = row["accepted"]
        return accepted

    def _do(self, question: Question, change: ChangeConfig) -> dict[str, Any]:
        with self._lock:
            if self._cancelled:
                raise WorkerLostError("cancelled")
            if self._worker is None:
                self._worker = Worker(quiet=True)
            worker = self._worker
        worker.begin(self._replay, (question, change))
        found = worker.finish(REPLAY_S)
        if isinstance(found, Failed):
            raise DashboardError(found.message)
        return dict(found)


_KEEPING = threading.Lock()


def read_answers(path: Path) -> list[dict[str, Any]]:
    """The answers that were kept of a trial, newest first; none where the file is damaged."""
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError):
        return []
    return [each for each in found if isinstance(each, dict)] if isinstance(found, list) else []


def keep_answer(question: Question, record: Mapping[str, Any]) -> None:
    """Put an answer before those that were kept; one to the same question is replaced.

    Args:
        question: Says which trial's file it is.
        record: As ``Answer.to_record`` makes it.
    """
    path = answers_path(question.run_path, question.episode_id)
    same = ("plan", "basis", "change", "sweep")
    with _KEEPING:
        others = [
            each
            for each in read_answers(path)
            if any(each.get(name) != record[name] for name in same)
        ]
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_whole(path, json.dumps([record, *others][:KEPT], indent=1).encode())
        except OSError:  # a run that can only be read keeps no answers
            return
