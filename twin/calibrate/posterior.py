"""What a session's own trials say of what nobody measured: draws from wide priors, weighed by them.

Friction, masses, the force of the fingers and what localisation is off as a whole are the same in
all trials of a task in a session. Draws from priors as wide as what is not known are replayed
through every trial that was executed; a draw that ends as the trial did counts for more (importance
sampling, Gordon, Salmond and Smith 1993, without their motion). Most draws differ in numbers that
no trial shows one by one, such as force and friction of the fingers: only together they matter, and
the draws that are left keep them together. Friction and mass belong to the objects of a task, so
each task is weighed by its own trials alone.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.special import betaln, ndtri
from scipy.stats import qmc

from bridge.episode import streams
from bridge.episode.catalogue import outcome_of
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.errors import GstError, UsageError
from bridge.process_pool import Failed, runner_of
from bridge.task.plan import Plan
from bridge.task.predicate import all_hold, evaluate_success
from bridge.task.task_file import ObjectModel
from bridge.terminal import Output
from twin.physics.unseen import draw_unseen
from twin.replay.config import UNKNOWN_LOG, PosteriorDraw, ReplayConfig
from twin.replay.dynamics import free_start, simulate, soft_models
from twin.replay.monte_carlo import rigid_movers, with_draw
from twin.replay.path import path_of_plan
from twin.replay.rebuilt_scene import for_task, read_rebuilt_scene
from twin.replay.scene import ReplayScene, localised_starts
from twin.robot.collision import hulls_of
from twin.robot.model import load_robot
from twin.scene.store.calibration import read_calibration, write_part
from twin.scene.store.folder import scene_hash_of

FRICTION = (0.05, 1.2)
"""Of a pair of surfaces: from steel on PTFE to rubber on what is dry (handbooks' tables of sliding
friction). A coefficient that is published has not been measured here; every one is as likely as
its double."""
BIAS_M = 0.005
"""Standard deviation, along x and y each, of what localisation is off as a whole; the same."""
WRONG = (0.4, 1.6)
"""What is known beforehand of how often the twin is wrong about a session's trials at the right
draw: a beta distribution, one in five on average, and most sessions either never or often."""
NEAR_M = 0.01
"""Standard deviation of where an object ends about where the twin has it end, at the right draw."""
ASTRAY = 0.1
"""Weight that a draw keeps however far from there: what falls ends anywhere."""


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One executed plan, what it began from and how it ended."""

    info: EpisodeInfo
    sha256: str
    plan: Plan
    scene: ReplayScene
    config: ReplayConfig
    success: bool
    ends_m: Mapping[str, Float[np.ndarray, "2"]]
    """Where objects that move were localised afterwards, x and y; without those not found."""

    def to_record(self) -> dict[str, Any]:
        """What a posterior says of its source, so that others can be kept apart from it."""
        kept = {name: getattr(self.info, name) for name in ("cell", "task_sha256", "start_seed")}
        return {"sha256": self.sha256, "success": self.success, **kept}


@dataclass(frozen=True, kw_only=True)
class Ended:
    """How a trial ends with one draw."""

    success: bool
    ends_m: Mapping[str, Float[np.ndarray, "2"]]


def draw_beforehand(count: int, movers: Mapping[str, ObjectModel]) -> list[PosteriorDraw]:
    """Spread draws evenly over the priors (Sobol's sequence): the same ones every time.

    Args:
        movers: Rigid objects that move, each with edges and a centre of mass of its own.
    """
    unit = qmc.Sobol(d=6 + 4 * len(movers), scramble=True, seed=0).random(count)
    z = ndtri(np.clip(unit, 1e-6, 1 - 1e-6))
    frictions = FRICTION[0] * (FRICTION[1] / FRICTION[0]) ** unit[:, :2]
    factors, normals = np.exp(UNKNOWN_LOG * z[:, 2:4]), z[:, 6:].reshape(count, len(movers), 4)
    return [
        PosteriorDraw(
            finger_pair_friction=float(finger),
            surface_pair_friction=float(surface),
            mass_scale=float(mass),
            grip_scale=float(grip),
            bias_m=(float(bias[0]), float(bias[1])),
            unseen=tuple(
                (name, draw_unseen(np.array(model.size_m), float(share), normal[1:]))
                for (name, model), share, normal in zip(movers.items(), shares, own, strict=True)
            ),
            weight=1.0 / count,
            wrong_yes=WRONG[0] / sum(WRONG),
            wrong_no=WRONG[0] / sum(WRONG),
        )
        for (finger, surface), (mass, grip), bias, shares, own in zip(
            frictions, factors, BIAS_M * z[:, 4:6], unit[:, 6::4], normals, strict=True
        )
    ]


def read_trials(run: RunFolder, output: Output) -> tuple[list[Trial], dict[str, str]]:
    """Executed and judged trials, localised where they were not; why others are none, by id."""
    trials, reasons = [], {}
    paths = run.episodes()
    with output.progress("localise", len(paths)) as advance:
        for index, path in enumerate(paths):
            try:
                episode = Episode.open(path)
                if episode.info.kind == "trial":
                    trials.append(_trial(run, episode))
            except GstError as error:
                reasons[path.stem] = str(error)
            advance(index + 1, path.stem)
    if not trials:
        why = "; ".join(f"{name}: {reason}" for name, reason in reasons.items())
        raise UsageError(f"{run.path} has no executed trial with an outcome. {why}".rstrip())
    return trials, reasons


def _trial(run: RunFolder, episode: Episode) -> Trial:
    outcome = outcome_of(run, episode)
    if outcome is None or outcome.result == "unknown":
        raise UsageError("nobody said how it ended")
    events = streams.events(episode)
    executed = [
        (stamp_ns, plan)
        for stamp_ns, plan in streams.plans(episode)
        if None not in streams.execution_ns(events, plan.id)
    ]
    if not executed:
        raise UsageError("no plan was executed from beginning to end")
    stamp_ns, plan = executed[-1]
    urdf = streams.robot_description(episode)
    if urdf is None:
        raise UsageError("no robot description was recorded")
    task = streams.task_file(episode, plan.task).task()
    states = localised_starts(run, episode, task, scene_hash=scene_hash_of(run))
    start, after = states.at(stamp_ns), states.after(plan.id)
    known = read_rebuilt_scene(run, task)
    scene = replace(known, urdf=urdf, Ts_base_object=start.Ts_base_object)
    if scene.missing():
        raise UsageError(f"at its start {scene.describe_missing()}")
    calibration = read_calibration(run)
    if calibration is not None:  # all but what is made anew
        record = {key: value for key, value in calibration.record.items() if key != "posterior"}
        calibration = replace(calibration, record=record)
    config = for_task(ReplayConfig(), calibration, task)
    return Trial(
        info=episode.info,
        sha256=episode.sha256(),
        plan=plan,
        scene=scene,
        config=config,
        success=outcome.result == "success",
        ends_m={
            name: T[:2, 3] for name, T in after.Ts_base_object.items() if name in scene.movable()
        },
    )


def end_of(trial: Trial, draw: PosteriorDraw) -> Ended:
    """Replay a trial's plan as a draw would have it."""
    scene, config = with_draw(draw, trial.scene, trial.config)
    robot = load_robot(scene.urdf)
    scene = free_start(scene, soft_models(scene))
    path, _, _ = path_of_plan(trial.plan, robot)
    states = simulate(path, scene, hulls_of(robot), config)
    back = np.array(draw.bias_m)
    return Ended(
        success=not states.broken and all_hold(evaluate_success(scene.task, states)) is True,
        ends_m={name: states.Ts_base_object[name][-1][:2, 3] - back for name in trial.ends_m},
    )


def log_nearness(trial: Trial, ended: Ended) -> float:
    """How well the places agree in which objects end."""
    total = 0.0
    for name, seen_m in trial.ends_m.items():
        off_m = float(np.linalg.norm(ended.ends_m.get(name, np.full(2, np.inf)) - seen_m))
        near = np.exp(-0.5 * (off_m / NEAR_M) ** 2)
        total += float(np.log(ASTRAY + (1 - ASTRAY) * near))
    return total


def trusted(right: Any, wrong: Any) -> tuple[Any, Any]:
    """Of how often an answer was right and wrong in trials in which a draw gave it.

    Returns:
        The log likelihood of exactly these, however often it is wrong in this session, and the
        probability that the next such answer is wrong.
    """
    a, b = WRONG[0] + wrong, WRONG[1] + right
    return betaln(a, b) - betaln(*WRONG), a / (a + b)


Piece = tuple[int, Trial, PosteriorDraw]


def _ended(piece: Piece) -> Ended:
    _, trial, draw = piece
    try:
        return end_of(trial, draw)
    except GstError:  # as the gate counts a sample that cannot be replayed
        return Ended(success=False, ends_m={})


def weighed(
    draws: Sequence[PosteriorDraw], trials: Sequence[Trial], *, workers: int | None, output: Output
) -> list[PosteriorDraw]:
    """Give each draw the weight that the trials leave it; in their order, weights sum to 1."""
    pieces = [(number, trial, draw) for number, draw in enumerate(draws) for trial in trials]
    logs = np.log([draw.weight for draw in draws])
    counts = np.zeros((len(draws), 2, 2), dtype=int)
    with runner_of(workers) as runner, output.progress("replays", len(pieces)) as advance:
        answers = runner.run(_ended, pieces, lambda piece: piece[1].plan.tau[-1].t_ns)
        for done, ((number, trial, _), ended) in enumerate(answers, start=1):
            if isinstance(ended, Failed):
                raise RuntimeError(ended.trace or ended.message)
            logs[number] += log_nearness(trial, ended)
            counts[number, int(ended.success), int(ended.success == trial.success)] += 1
            advance(done, trial.info.id)
    likelihoods, wrong = trusted(counts[:, :, 1], counts[:, :, 0])
    logs += likelihoods.sum(axis=1)
    weights = np.exp(logs - logs.max())
    weights /= weights.sum()
    return [
        replace(draw, weight=weight, wrong_yes=yes, wrong_no=no)
        for draw, weight, (no, yes) in zip(draws, weights.tolist(), wrong.tolist(), strict=True)
    ]


def effective(draws: Sequence[PosteriorDraw]) -> float:
    """How many equal draws would know as much: 1 / sum of squared weights (Kong 1992)."""
    return 1.0 / float(np.sum(np.square([draw.weight for draw in draws])))


def calibrate_posterior(
    run: RunFolder, *, num_draws: int, workers: int | None, output: Output
) -> tuple[dict[str, Any], str]:
    """Weigh draws by a run's trials, task by task, and write them to ``calibration.json``.

    Returns:
        The record, and the id of the calibration that holds now.
    """
    (usable, skipped), tasks = read_trials(run, output), dict[str, Any]()
    for name in sorted({trial.scene.task.name for trial in usable}):
        trials = [trial for trial in usable if trial.scene.task.name == name]
        beforehand = draw_beforehand(num_draws, rigid_movers(trials[0].scene.task))
        draws = weighed(beforehand, trials, workers=workers, output=output)
        tasks[name] = {
            "draws": [asdict(draw) for draw in draws],
            "effective_draws": effective(draws),
            "sources": {trial.info.id: trial.to_record() for trial in trials},
        }
    return write_part(run, "posterior", {"tasks": tasks, "skipped": skipped})


def describe_posterior(record: Mapping[str, Any], calibration_id: str) -> str:
    """Say what the trials left of the priors."""
    lines = [f"posterior: {len(record['tasks'])} tasks; calibration {calibration_id}"]
    for name, found in record["tasks"].items():
        draws, trials = found["draws"], found["sources"]
        good = sum(item["success"] for item in trials.values())
        lines.append(
            f"{name}: {len(draws)} draws weighed by {len(trials)} trials, {good} of which "
            f"succeeded; as much as {found['effective_draws']:.1f} equal ones"
        )
    lines += [f"  {name} not used: {why}" for name, why in record["skipped"].items()]
    return "\n".join(lines)
