"""What the gate's own process does: finding objects and replaying plans."""

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.episode.run_folder import RunFolder
from bridge.task.plan import Plan
from bridge.task.task_file import Task
from bridge.task.verdict import Verdict
from twin.replay.config import ReplayConfig

SAMPLING = 0.9
"""Share of the time left in which samples are begun; a late one would cost the verdict too."""


@dataclass(frozen=True, kw_only=True)
class Look:
    """Frames in which a task's objects are to be found."""

    run_path: Path
    """Run folder whose scene knows the shapes of scanned objects, where it has been rebuilt."""
    frames: Any
    task: Task


@dataclass(frozen=True, kw_only=True)
class Question:
    """A plan, and everything its replay needs."""

    run_path: Path
    """Run folder with the rebuilt scene, or without one."""
    plan: Plan
    task: Task
    Ts_base_object: dict[str, Float[np.ndarray, "4 4"]]
    covariances: dict[str, Float[np.ndarray, "6 6"]]
    urdf: str
    config: ReplayConfig
    left_s: float
    """No sample is begun that would not be done by then."""


def get_ready(_: None) -> None:
    """Import what takes seconds, so that the first plan does not wait for it."""
    import twin.replay.place.rebuilt  # noqa: PLC0415
    import twin.replay.verdict.rollout  # noqa: PLC0415
    import twin.scene.localise.objects  # noqa: PLC0415
    import twin.scene.localise.scanned  # noqa: F401, PLC0415


def look(item: Look) -> dict[str, Any]:
    """Find the objects."""
    from twin.scene.localise.objects import LocaliseConfig, localise_objects  # noqa: PLC0415
    from twin.scene.localise.scanned import scanned_surfaces  # noqa: PLC0415

    config = LocaliseConfig()
    scanned = scanned_surfaces(RunFolder.open(item.run_path), item.task, config.mesh.num_samples)
    found = localise_objects(item.frames, item.task, config, surfaces=scanned.surfaces)
    return dict(found)


def answer(question: Question) -> Verdict:
    """Replay a plan in the rebuilt place, then as many varied ones as were asked for and fit.

    Rounds of one start are tried against the same variations: their identity is the start's name.
    """
    from twin.replay.chance.samples import replay_samples, with_probability  # noqa: PLC0415
    from twin.replay.place.calibrated import calibrated, for_task  # noqa: PLC0415
    from twin.replay.place.rebuilt import read_place  # noqa: PLC0415
    from twin.replay.place.scene import ReplayScene  # noqa: PLC0415
    from twin.replay.verdict.rollout import replay_plan  # noqa: PLC0415
    from twin.scene.store.calibration import read_calibration  # noqa: PLC0415

    started_s = time.monotonic()
    run, plan = RunFolder.open(question.run_path), question.plan
    place = read_place(run, question.task)
    scene = place.scene(
        question.task, question.urdf, question.Ts_base_object, covariances=question.covariances
    )
    config = for_task(calibrated(question.config, read_calibration(run)), question.task)

    def judge(there: ReplayScene, settings: ReplayConfig) -> Verdict:
        return replay_plan(plan, there, settings).verdict

    verdict = judge(scene, config)
    samples = replay_samples(
        judge,
        scene,
        config,
        plan_id=plan.id,
        identity=plan.start_id or plan.id,
        ends_s=started_s + SAMPLING * question.left_s,
        expected_s=time.monotonic() - started_s,
    )
    return _with_remarks(with_probability(verdict, samples), place.remarks)


def _with_remarks(verdict: Verdict, remarks: tuple[str, ...]) -> Verdict:
    """Say what the scene could not tell; a yes that knows less than it might says so first."""
    if not remarks:
        return verdict
    warnings = (*verdict.warnings, *remarks)
    return replace(verdict, warnings=warnings, reason=verdict.reason or warnings[0])
