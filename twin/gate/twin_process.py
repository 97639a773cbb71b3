"""The twin in a process of its own: one that hangs is ended, one that dies takes nobody with it."""

import gc
import time
import traceback
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.episode.run_folder import RunFolder
from bridge.process_pool import Failed, Function, TimeIsUpError, Worker, WorkerLostError
from bridge.task.plan import Plan
from bridge.task.task_file import Task
from bridge.task.verdict import Verdict
from bridge.terminal import Output
from twin.gate.config import GateConfig
from twin.gate.gate import UndecidedError
from twin.replay.config import ReplayConfig
from twin.replay.scene import ReplayScene

SOFT = 2
"""A sample costs as much as so many more rigid ones for each soft object in it."""


@dataclass(frozen=True, kw_only=True)
class Question:
    """A plan, and everything its replay needs."""

    run_path: Path
    """Run folder with the rebuilt scene, or without one."""
    plan: Plan
    seen: ReplayScene
    """Task, robot, where it stands and objects, as seen; the rest is read from the run."""
    config: ReplayConfig
    max_steps: int
    """Simulated steps, the samples' among them."""
    until: float | None = None
    """Samples end once it is decided whether p_success is more; 0: whether half of them succeed."""
    any_robot: bool = False
    """The scene may be another robot's, for somebody named the robot (``--robot``)."""


def get_ready(_: None) -> None:
    """Import what takes seconds, so that the first plan does not wait for it."""
    import twin.replay.audit  # noqa: PLC0415
    import twin.replay.rebuilt_scene  # noqa: PLC0415
    import twin.replay.verdict  # noqa: PLC0415
    import twin.scene.localise.mesh_fit  # noqa: F401, PLC0415

    gc.freeze()  # nobody needs to look for garbage in what was imported


def look(item: tuple[Path, Any, Task]) -> dict[str, Any]:
    """Find a task's objects in frames; the run's scene knows the shapes of those scanned."""
    from twin.scene.localise.mesh_fit import scanned_surfaces  # noqa: PLC0415
    from twin.scene.localise.objects import localise_objects  # noqa: PLC0415

    run_path, frames, task = item
    scanned = scanned_surfaces(RunFolder.open(run_path), task)
    return dict(localise_objects(frames, task, surfaces=scanned.surfaces))


def answer(question: Question) -> Verdict:
    """Replay a plan in the rebuilt scene, audit a yes, then replay as many varied ones as fit.

    Nothing here looks at a clock: the same question has the same answer on every machine.
    Rounds of one start are tried against the same variations: their identity is the start's name.
    Raises UndecidedError for another robot or scene, or a nominal replay of too many steps.
    """
    from twin.replay.audit import audit  # noqa: PLC0415
    from twin.replay.checks import limited_to_task  # noqa: PLC0415
    from twin.replay.monte_carlo import with_samples  # noqa: PLC0415
    from twin.replay.rebuilt_scene import for_task  # noqa: PLC0415
    from twin.replay.verdict import command_of, reason_of, replay_plan  # noqa: PLC0415
    from twin.scene.store.calibration import read_calibration  # noqa: PLC0415

    run, plan = RunFolder.open(question.run_path), question.plan
    scene = _scene_of(question, run)
    config = for_task(question.config, read_calibration(run), question.seen.task)
    steps, costs = _steps_of(question, config), 1 + SOFT * len(scene.task.soft_objects)
    most_samples = (question.max_steps - steps) // (steps * costs)

    commanded = command_of(plan, scene, config)
    nominal = replay_plan(plan, scene, config, commanded=commanded, refuse_early=True)
    verdict = nominal.verdict
    if verdict.accepted is True:
        audited = audit(nominal, limited_to_task(plan, scene.task), scene, config)
        verdict = replace(verdict, checks={**verdict.checks, "audit": audited})
    verdict = replace(verdict, warnings=(*verdict.warnings, *scene.notes))
    early = verdict.terminal.value is None  # else samples are replayed as all other replays are
    again = partial(replay_plan, plan, commanded=commanded, refuse_early=early, known=nominal)
    return with_samples(
        replace(verdict, reason=reason_of(verdict)),
        lambda *drawn: again(*drawn).verdict,
        scene,
        replace(config, samples=min(config.samples, most_samples)),
        identity=plan.start_id or plan.id,
        until=question.until,
    )


def _scene_of(question: Question, run: RunFolder) -> ReplayScene:
    """Where the plan is tried."""
    from twin.replay.rebuilt_scene import read_rebuilt_scene, scene_of_other_robot  # noqa: PLC0415

    plan = question.plan
    other = "" if question.any_robot else scene_of_other_robot(run, plan.robot)
    if other:
        raise UndecidedError(
            f"{other}, and plan {plan.id} is for {plan.robot}. Scan the cell with the robot that "
            "is to act and rebuild it: robot-gst rebuild RUN, or name the robot: --robot"
        )
    scene, seen = read_rebuilt_scene(run, question.seen.task), question.seen
    if plan.scene_hash not in (None, scene.scene_hash):
        raise UndecidedError(
            f"plan {plan.id} was made in scene {str(plan.scene_hash)[:12]}; the run now has "
            f"{str(scene.scene_hash or 'none')[:12]}. Start its planner again."
        )
    return replace(
        scene,
        urdf=seen.urdf,
        Ts_base_object=seen.Ts_base_object,
        covariances=seen.covariances,
        start_rad=seen.start_rad,
    )


def _steps_of(question: Question, config: ReplayConfig) -> int:
    """Simulated steps of the nominal replay; no more than a verdict may take."""
    from twin.replay.dynamics import num_steps  # noqa: PLC0415
    from twin.replay.path import check_usable  # noqa: PLC0415
    from twin.robot.model import load_robot  # noqa: PLC0415

    check_usable(question.plan, load_robot(question.seen.urdf))  # impossible times are no steps
    steps = max(1, num_steps(question.plan.tau[-1].t_ns, config))
    if steps > question.max_steps:
        raise UndecidedError(
            f"its replay takes {steps} simulated steps, and a verdict at most "
            f"{question.max_steps} (--max-steps)"
        )
    return steps


def asked(gate: GateConfig, run_path: Path, plan: Plan, seen: ReplayScene) -> Question:
    """A question as a gate with these settings has it."""
    config = replace(gate.replay, mode="dynamic", samples=gate.samples)
    config.refuse_soft(seen.task.soft_objects)
    return Question(
        run_path=run_path,
        plan=plan,
        seen=seen,
        config=config,
        max_steps=gate.max_steps,
        until=gate.min_p_success,
        any_robot=bool(gate.robot),
    )


def judge_of(run_path: Path, scene: ReplayScene) -> Callable[[Plan], Verdict]:
    """Judge here as a gate does without samples; UndecidedError: a replay has too many steps."""
    return lambda plan: answer(asked(GateConfig(samples=0), run_path, plan, scene))


class TwinProcess(AbstractContextManager["TwinProcess"]):
    """Localises and replays for a gate. A context manager; for one caller at a time."""

    def __init__(self, run_path: Path, config: GateConfig, output: Output) -> None:
        """Start it; it imports what it needs while the gate connects."""
        self._run_path, self._config, self._output = run_path, config, output
        self._closed = False
        self._worker: Worker | None = None
        self._start()

    def _start(self) -> Worker:
        worker = self._worker = Worker()
        with suppress(WorkerLostError):  # at once: it is replaced when it should answer
            worker.begin(get_ready, None)
        if self._closed:  # meanwhile
            worker.close()
        return worker

    def localise(self, frames: Any, task: Task, ends_s: float) -> Mapping[str, Any]:
        """Find a task's objects."""
        return dict(self._do("localisation", look, (self._run_path, frames, task), ends_s))

    def replay(
        self,
        plan: Plan,
        task: Task,
        found: Mapping[str, Any],
        urdf: str,
        start_rad: Float[np.ndarray, " num_joints"],
        ends_s: float,
    ) -> Verdict:
        """Replay a plan from where its objects were found and the arm stands."""
        seen = ReplayScene(
            task=task,
            Ts_base_object={name: item.T_base_object for name, item in found.items()},
            covariances={n: x.covariance for n, x in found.items() if x.covariance is not None},
            urdf=urdf,
            start_rad=start_rad,
        )
        question = asked(self._config, self._run_path, plan, seen)
        verdict: Verdict = self._do("replay", answer, question, ends_s)
        return verdict

    def _do(self, what: str, function: Function, item: Any, ends_s: float) -> Any:
        if self._closed:
            raise UndecidedError("the gate is being stopped")
        try:
            worker = self._worker or self._start()  # the system gave no process the last time
        except OSError as error:
            raise UndecidedError(f"no process for the twin can be started: {error}") from error
        try:
            if worker.busy:  # with its imports
                worker.finish(max(0.0, ends_s - time.monotonic()))
            worker.begin(function, item, max(0.0, ends_s - time.monotonic()))
            result = worker.finish(max(0.0, ends_s - time.monotonic()))
        except WorkerLostError as error:
            worker.close()
            self._worker = None
            if not self._closed:
                with suppress(OSError):  # the system gives no process: the next plan asks again
                    self._start()
            late = f"the {what} was not done before the wall-clock limit (--deadline)"
            is_late = isinstance(error, TimeIsUpError)
            told = f"{late}; it was stopped" if is_late else f"no {what}: {error}"
            raise UndecidedError(told) from error
        if isinstance(result, Failed):
            if not result.known:
                self._output.say(result.trace or traceback.format_exc())
            raise UndecidedError(result.message)
        return result

    def close(self) -> None:
        """End it, also in the middle of something."""
        self._closed, worker = True, self._worker  # which another thread may take away
        if worker is not None:
            worker.close()

    def __exit__(self, *_: object) -> None:
        """End it."""
        self.close()
