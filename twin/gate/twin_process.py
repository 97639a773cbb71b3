"""The twin in a process of its own: one that hangs is ended, one that dies takes nobody with it."""

import threading
import time
import traceback
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from bridge.task.plan import Plan
from bridge.task.task_file import Task
from bridge.task.verdict import Verdict
from bridge.terminal import Output
from twin.crew.worker import Failed, Function, TimeIsUpError, Worker, WorkerDiedError
from twin.gate.config import GateConfig
from twin.gate.judge import UndecidedError
from twin.gate.work import Look, Question, answer, get_ready, look


class TwinProcess:
    """Localises and replays for a gate. A context manager; for one caller at a time."""

    def __init__(self, run_path: Path, task: Task, config: GateConfig, output: Output) -> None:
        """Start it; it imports what it needs while the gate connects."""
        self._run_path, self._task, self._output = run_path, task, output
        self._config = replace(config.replay, mode="dynamic", samples=config.samples)
        self._swapping = threading.Lock()
        self._closed = False
        self._worker: Worker | None = None
        self._start()

    def _start(self) -> Worker | None:
        """Begin anew, unless the gate is being stopped."""
        worker = Worker()
        with suppress(WorkerDiedError):  # at once: it is replaced when it should answer
            worker.begin(get_ready, None)
        with self._swapping:
            if not self._closed:
                self._worker = worker
                return worker
        worker.close()
        return None

    def localise(self, frames: Any, task: Task, ends_s: float) -> Mapping[str, Any]:
        """Find a task's objects.

        Raises:
            UndecidedError: When there is no answer in time, or none at all.
        """
        item = Look(run_path=self._run_path, frames=frames, task=task)
        found: Mapping[str, Any] = self._do("localisation", look, item, ends_s)
        return found

    def replay(self, plan: Plan, found: Mapping[str, Any], urdf: str, ends_s: float) -> Verdict:
        """Replay a plan from where its objects were found.

        Raises:
            UndecidedError: When there is no answer in time, or none at all.
        """
        question = Question(
            run_path=self._run_path,
            plan=plan,
            task=self._task,
            Ts_base_object={name: item.T_base_object for name, item in found.items()},
            covariances={
                name: item.covariance for name, item in found.items() if item.covariance is not None
            },
            urdf=urdf,
            config=self._config,
            left_s=max(0.0, ends_s - time.monotonic()),
        )
        verdict: Verdict = self._do("replay", answer, question, ends_s)
        return verdict

    def _do(self, what: str, function: Function, item: Any, ends_s: float) -> Any:
        worker = self._worker_now()
        try:
            if worker.busy:  # with its imports
                worker.finish(max(0.0, ends_s - time.monotonic()))
            worker.begin(function, item, max(0.0, ends_s - time.monotonic()))
            result = worker.finish(max(0.0, ends_s - time.monotonic()))
        except TimeIsUpError as error:
            self._replace(worker)
            raise UndecidedError(
                f"the {what} was not done before the deadline; it was stopped"
            ) from error
        except WorkerDiedError as error:
            self._replace(worker)
            raise UndecidedError(f"no {what}: {error}") from error
        if isinstance(result, Failed):
            if not result.known:
                self._output.say(result.trace or traceback.format_exc())
            raise UndecidedError(result.message)
        return result

    def _worker_now(self) -> Worker:
        worker = self._worker
        try:
            if worker is None and not self._closed:  # the system gave no process the last time
                worker = self._start()
        except OSError as error:
            raise UndecidedError(f"no process for the twin can be started: {error}") from error
        if worker is None:
            raise UndecidedError("the gate is being stopped")
        return worker

    def _replace(self, worker: Worker) -> None:
        with self._swapping:
            if self._worker is not worker:
                return
            self._worker = None
        worker.close()
        with suppress(OSError):  # the system gives no process: the next plan asks again
            self._start()

    def close(self) -> None:
        """End it, also in the middle of something."""
        with self._swapping:
            worker, self._worker, self._closed = self._worker, None, True
        if worker is not None:
            worker.close()

    def __enter__(self) -> "TwinProcess":
        """Use as a context manager."""
        return self

    def __exit__(self, *_: object) -> None:
        """End it."""
        self.close()
