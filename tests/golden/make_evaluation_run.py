"""Write a small invented run that has data for every part of an evaluation.

Three tasks, one rigid and two soft, without and with replanning. Each trial has a plan with
predicted final states, a verdict before motion with a sampled probability, stages, an outcome, a
localisation before and after, and a planned and an executed replay. Beside them: held-out views,
and imported runs without plans. Nothing here was measured: outcomes and errors are drawn from one
seed. On purpose one label contradicts the localised object, one object is not found, one verdict is
missing.

    python tests/golden/make_evaluation_run.py FOLDER
"""

import io
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from PIL import Image

from bridge.episode import schema
from bridge.episode.metadata import Derived, EpisodeInfo, Outcome
from bridge.episode.point_cloud import PointCloudSample
from bridge.episode.provenance import hash_file
from bridge.episode.records import CompressedColor, DepthImage, JointSample, PoseSample
from bridge.episode.run import RunFolder
from bridge.episode.writer import EpisodeWriter
from bridge.geometry import se3
from bridge.task.plan import Plan, Waypoint
from bridge.task.plan import Stage as PlanStage
from bridge.task.robot import ARM_JOINTS
from bridge.task.task_file import Task, load_task
from bridge.task.verdict import Factor, Verdict

SEED = 20240917
START_NS = 100_000_000_000
STEP_NS = 100_000_000
NUM_STEPS = 30
CELL = "/standin"
WITHOUT, WITH = "without_replanning", "with_replanning"
TRIALS = {"cube_into_box": 8, "sloth_into_basket": 4, "five_ducks_into_basket": 4}
"""Trials per condition; each start is tried in both."""
CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)
TRUTH = {WITHOUT: 0.55, WITH: 0.8}
"""How often a trial succeeds."""


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One drawn trial."""

    id: str
    task: Task
    condition: str
    start: int
    success: bool
    done: int
    """Objects of the task that ended where they belong."""
    said: bool
    """What the planned replay says."""
    executed: bool
    p_success: float
    label: bool
    """What the operator said; once it is wrong on purpose."""
    found: bool = True
    """Whether the manipulated objects were localised afterwards."""

    @property
    def plan_id(self) -> str:
        """Name of the plan that was sent."""
        return f"plan_{self.id}"


def make_evaluation_run(folder: Path, *, trials: Mapping[str, int] | None = None) -> RunFolder:
    """Write the run into a new folder and return it.

    Args:
        folder: Must not exist.
        trials: Trials per condition by task; ``TRIALS`` without it.
    """
    rng = np.random.default_rng(SEED)
    run = RunFolder.create(folder)
    for name, count in (TRIALS if trials is None else trials).items():
        task = load_task(name)
        for condition in (WITHOUT, WITH):
            for start in range(1, count + 1):
                _write_trial(run, _draw(rng, task, condition, start), rng)
    _write_views(run, rng)
    _write_imported(run, rng)
    return run


def _draw(rng: np.random.Generator, task: Task, condition: str, start: int) -> Trial:
    several = len(task.manipulated)
    chance = float(np.clip(rng.normal(TRUTH[condition], 0.25), 0.05, 0.97))
    if several > 1:
        done = int(rng.binomial(several, 0.75 if condition == WITHOUT else 0.9))
        success = done == several
    else:
        success = bool(rng.random() < chance)
        done = int(success)
    said = success if rng.random() < 0.85 else not success
    trial = Trial(
        id=f"{task.name}_{'with' if condition == WITH else 'without'}_{start:02d}",
        task=task,
        condition=condition,
        start=start,
        success=success,
        done=done,
        said=said,
        executed=success if rng.random() < 0.95 else not success,
        p_success=round(float(np.clip(0.5 * chance + (0.45 if said else 0.05), 0, 1)), 2),
        label=success,
    )
    if task.name == "cube_into_box" and condition == WITHOUT and start == 1:
        return replace(trial, success=True, done=1, label=False)  # it lies in the box all the same
    if task.name == "cube_into_box" and condition == WITH and start == 2:
        return replace(trial, found=False)
    return trial


def _write_trial(run: RunFolder, trial: Trial, rng: np.random.Generator) -> None:
    starts, goals = _poses(trial, rng)
    plan = _plan(trial, goals)
    tool = _path(starts, goals, trial)
    joints = np.cumsum(rng.normal(0, 0.01, (NUM_STEPS, len(ARM_JOINTS))), axis=0)
    path = run.episodes_dir / f"{trial.id}.mcap"
    with EpisodeWriter(path) as writer:
        writer.describe(_info(trial, trial.id), outcome=_outcome(trial))
        log = Log(writer)
        log.raw("plan", schema.PLAN, plan.to_json(), START_NS - 3 * STEP_NS)
        if (trial.task.name, trial.start) != ("sloth_into_basket", 1):
            said = _verdict(trial, "planned").to_json()
            log.raw("verdict", schema.VERDICT, said, START_NS - STEP_NS)
        log.execution(plan)
        log.tool(tool + _wobble(rng, 0.004))
        log.joints(joints + rng.normal(0, 0.002, joints.shape))
    sha256 = hash_file(path)
    ended = _ended(trial, starts, goals)
    localised = {name: p_m + rng.normal(0, 0.002, 3) for name, p_m in ended.items()}
    _write_localised(run, trial, sha256, starts, localised)
    for trajectory, offset, noise in (("planned", 0.0, 0.0), ("executed", 0.003, 0.0005)):
        said = trial.said if trajectory == "planned" else trial.executed
        left = _ended(replace(trial, success=said, done=trial.done if said else 0), starts, goals)
        near = {name: p_m + rng.normal(0, 0.004, 3) for name, p_m in left.items()}
        derived = Derived(
            kind="replay",
            source_episode=trial.id,
            source_sha256=sha256,
            plan_id=trial.plan_id,
            trajectory=trajectory,
            mode="dynamic",
            engine="gst",
            seed=trial.start,
        )
        name = f"{trial.id}.replay.{trajectory}.dynamic.{trial.plan_id}.gst.a"
        with EpisodeWriter(run.derived_dir / f"{name}.mcap") as writer:
            writer.describe(_info(trial, name.replace(".", "-")), derived=derived)
            log = Log(writer)
            log.execution(plan)
            log.tool(tool + offset + _wobble(rng, noise))
            log.joints(joints + rng.normal(0, noise, joints.shape))
            log.objects(trial.task, starts, near)
            end_ns = START_NS + NUM_STEPS * STEP_NS
            log.raw("verdict", schema.VERDICT, _verdict(trial, trajectory).to_json(), end_ns)


def _info(trial: Trial, episode_id: str) -> EpisodeInfo:
    return EpisodeInfo(
        id=episode_id,
        kind="trial",
        task=trial.task.name,
        instruction=trial.task.instruction,
        condition=trial.condition,
        policy="scripted",
        start_id=f"s{trial.start}",
        start_seed=trial.start,
        robot="ur5",
        cell="standin",
        stand_in=True,
    )


def _outcome(trial: Trial) -> Outcome:
    several = len(trial.task.manipulated) > 1
    stages = [str(stage["id"]) for stage in trial.task.stages]
    passed = len(stages) * trial.done // len(trial.task.manipulated)
    passed = passed if trial.label or several else trial.start % len(stages)
    words = ["success"] * passed + ["failure"] * (passed < len(stages))
    words += ["unknown"] * (len(stages) - len(words))
    return Outcome(
        result="success" if trial.label else "failure",
        unit="object" if several else "trial",
        k=trial.done if several else int(trial.label),
        n=len(trial.task.manipulated),
        by="make_evaluation_run",
        stages=tuple({"id": i, "result": w} for i, w in zip(stages, words, strict=True)),
    )


def _poses(
    trial: Trial, rng: np.random.Generator
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Where every object starts, and where the plan puts those it moves [m]."""
    place = np.random.default_rng(SEED + 7 * trial.start)  # the same start in both conditions
    starts: dict[str, np.ndarray] = {}
    for name, model in trial.task.objects.items():
        spread = trial.task.start[name]
        x, y = (place.uniform(*ends) for ends in (spread.x_m, spread.y_m))
        starts[name] = np.array([x, y, model.rest_height_m]) + rng.normal(0, 0.001, 3)
    container = starts[trial.task.containers[0]]

    def rest(name: str) -> float:
        return trial.task.objects[name].rest_height_m

    goals = {
        name: container + np.array([0.012 * i - 0.02, 0.01, 0.008 + rest(name)])
        for i, name in enumerate(trial.task.manipulated)
    }
    return starts, goals


def _ended(
    trial: Trial, starts: Mapping[str, np.ndarray], goals: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Where objects lie in the end: the first ``done`` where they belong, the others beside it."""
    found = dict(starts)
    for place, name in enumerate(trial.task.manipulated):
        beside = goals[name] + [0.0, -0.22, -0.008]
        found[name] = goals[name] if place < trial.done else beside
    return found


def _path(
    starts: Mapping[str, np.ndarray], goals: Mapping[str, np.ndarray], trial: Trial
) -> Float[np.ndarray, "num_steps 3"]:
    name = trial.task.manipulated[0]
    share = np.linspace(0, 1, NUM_STEPS)[:, None]
    lift = 0.18 * np.sin(np.pi * share)
    return starts[name] + share * (goals[name] - starts[name]) + lift * [0, 0, 1]


def _wobble(rng: np.random.Generator, size_m: float) -> Float[np.ndarray, "num_steps 3"]:
    """An error that grows and shrinks slowly, as a controller's does."""
    phase = np.linspace(0, 2 * np.pi, NUM_STEPS)[:, None] + rng.uniform(0, 6, 3)
    return size_m * np.abs(np.sin(phase / 2)) * rng.uniform(0.4, 1.4, 3)


def _plan(trial: Trial, goals: Mapping[str, np.ndarray]) -> Plan:
    raw = trial.task.stages
    span = NUM_STEPS * STEP_NS // len(raw)
    stages = tuple(
        PlanStage(
            id=str(stage["id"]),
            text=str(stage["text"]),
            grasp=stage.get("grasp"),
            release=stage.get("release"),
            predicted_objects={
                name: {"p_m": goals[name].tolist(), "q_wxyz": [1.0, 0.0, 0.0, 0.0]}
                for name in (stage.get("release"),)
                if name is not None
            },
            t_start_ns=i * span,
            t_end_ns=(i + 1) * span,
        )
        for i, stage in enumerate(raw)
    )
    tau = tuple(
        Waypoint(t_ns=i * STEP_NS, p_m=(0.5, 0.0, 0.2), q_wxyz=(1.0, 0.0, 0.0, 0.0), g=0)
        for i in range(2)
    )
    return Plan(
        id=trial.plan_id,
        planner="make_evaluation_run",
        policy="scripted",
        condition=trial.condition,
        robot="ur5",
        frame="base_link",
        instruction=trial.task.instruction,
        task=trial.task.name,
        start_id=f"s{trial.start}",
        stages=stages,
        tau=tau,
    )


def _verdict(trial: Trial, trajectory: str) -> Verdict:
    said = trial.said if trajectory == "planned" else trial.executed
    failing = None if said else ("clearance", "terminal", "ik")[trial.start % 3]
    factors = {
        "ik": Factor(value=False, first_t_ns=900_000_000, cause="unreachable"),
        "clearance": Factor(
            value=False,
            first_t_ns=1_400_000_000,
            cause="collision",
            bodies=("gripper", trial.task.containers[0]),
        ),
        "terminal": Factor(value=False, cause="inside", detail="it lies beside the container"),
    }
    return Verdict(
        plan_id=trial.plan_id,
        trajectory=trajectory,
        mode="dynamic",
        **{name: no if name == failing else Factor(value=True) for name, no in factors.items()},
        engine="gst",
        seed=trial.start,
        p_success={"value": trial.p_success} if trajectory == "planned" else None,
        findings=tuple(
            {
                "side": "replayed",
                "kind": kind,
                "object": name,
                "value": failing != "terminal" or kind != "inside",
                "detail": "drawn",
            }
            for name in trial.task.manipulated
            for kind in ("inside", "settled", "released", "allowed_contacts")
        ),
    )


def _write_localised(
    run: RunFolder,
    trial: Trial,
    sha256: str,
    starts: Mapping[str, np.ndarray],
    ended: Mapping[str, np.ndarray],
) -> None:
    derived = Derived(kind="localised", source_episode=trial.id, source_sha256=sha256)
    with EpisodeWriter(run.derived_dir / f"{trial.id}.localised.scene.mcap") as writer:
        writer.describe(_info(trial, f"{trial.id}-localised"), derived=derived)
        log = Log(writer)
        log.localised(trial, "start", starts, START_NS - 5 * STEP_NS)
        log.localised(trial, "end", ended, START_NS + (NUM_STEPS + 5) * STEP_NS)


def _write_views(run: RunFolder, rng: np.random.Generator) -> None:
    """Two cameras, three instants each, one of them badly rendered."""
    derived = Derived(
        kind="views",
        source_episode="scan_01",
        source_sha256="",
        settings={"holdout": "every 8th frame", "num_splats": 1234},
    )
    with EpisodeWriter(run.derived_dir / "scan_01.views.scene.mcap") as writer:
        writer.describe(
            EpisodeInfo(id="scan_01-views", kind="scan", stand_in=True), derived=derived
        )
        log = Log(writer)
        for index, camera in enumerate(("wrist", "front")):
            for place in range(3):
                picture, mask, depth_m = _scenery(rng, index + 0.4 * place)
                wrong = 0.015 + 0.05 * (index == 1 and place == 2)
                rendered = np.roll(picture, 1, axis=1) * (0.97 - 2 * wrong)
                rendered = np.clip(rendered + rng.normal(0, 255 * wrong, picture.shape), 0, 255)
                stamp_ns = START_NS + place * 1_000_000_000
                log.picture(camera, "recorded/image", picture, stamp_ns)
                log.picture(camera, "rendered/image", rendered.astype(np.uint8), stamp_ns)
                log.picture(camera, "mask/objects", mask, stamp_ns)
                log.depth(camera, "recorded/depth", depth_m, stamp_ns)
                log.depth(camera, "rendered/depth", depth_m + 0.004, stamp_ns)


def _scenery(
    rng: np.random.Generator, turn: float
) -> tuple[np.ndarray, np.ndarray, Float[np.ndarray, "height width"]]:
    """A table with two blocks under soft light, large enough for MS-SSIM."""
    height, width = 176, 192
    y, x = np.mgrid[0:height, 0:width].astype(np.float64)
    picture = np.stack([150 + 0.3 * y, 140 + 0.25 * y, 128 + 0.2 * x], axis=2)
    depth_m = 1.4 - 0.004 * y
    mask = np.zeros((height, width), dtype=bool)
    for at, size, colour in (
        (60 + 20 * turn, 38, (190, 60, 48)),
        (122 - 12 * turn, 26, (52, 104, 170)),
    ):
        block = (abs(x - at) < size / 2) & (abs(y - 100) < size / 2)
        light = 0.75 + 0.25 * (x[block] - at) / size
        picture[block] = np.array(colour) * light[:, None]
        depth_m[block] -= 0.05
        mask |= block
    picture = np.clip(picture + rng.normal(0, 2.0, picture.shape), 0, 255).astype(np.uint8)
    white = np.repeat(mask[..., None], 3, axis=2).astype(np.uint8) * 255
    return picture, white, depth_m


def _write_imported(run: RunFolder, rng: np.random.Generator) -> None:
    """Runs without plans and without a common clock, recorded and simulated."""
    share = np.linspace(0, 1, NUM_STEPS)[:, None]
    for number in range(1, 4):
        for engine, offset in ((None, 0.0), ("pybullet", 0.012)):
            name = f"reach_{engine or 'real'}_{number:02d}"
            folder = run.episodes_dir if engine is None else run.derived_dir
            derived = None
            if engine is not None:
                derived = Derived(kind="replay", source_episode="", source_sha256="", engine=engine)
            with EpisodeWriter(folder / f"{name}.mcap") as writer:
                info = EpisodeInfo(id=name, kind="imported", task="reach", cell="elsewhere")
                writer.describe(replace(info, stand_in=True), derived=derived)
                ends = np.array([0.2, 0.1, 0.3]), np.array([0.5, -0.2 + offset, 0.2])
                path = ends[0] + share * (ends[1] - ends[0])
                Log(writer).tool(path + _wobble(rng, 0.003 + offset / 3))


@dataclass(frozen=True)
class Log:
    """Puts messages into one episode."""

    writer: EpisodeWriter

    def raw(self, topic: str, type_name: str, data: bytes, stamp_ns: int) -> None:
        """Write one message of the cell."""
        topic = f"{CELL}/{topic}"
        self.writer.write(topic, data, type_name=type_name, log_time_ns=stamp_ns)

    def json(self, topic: str, type_name: str, stamp_ns: int, **record: object) -> None:
        """Write one JSON record."""
        record = {"schema_version": 1, "stamp_ns": stamp_ns, **record}
        self.writer.write_json(f"{CELL}/{topic}", record, type_name=type_name, log_time_ns=stamp_ns)

    def execution(self, plan: Plan) -> None:
        """Write when the execution and its stages began and ended."""
        events = [(0, "execution_started", None)]
        for stage in plan.stages:
            events += [(stage.t_start_ns, "stage_started", stage.id)]
            events += [(stage.t_end_ns, "stage_ended", stage.id)]
        events += [(NUM_STEPS * STEP_NS, "execution_ended", None)]
        for t_ns, kind, stage_id in events:
            about = {"type": kind, "plan_id": plan.id, "stage_id": stage_id}
            self.json("event", schema.EVENT, START_NS + t_ns, **about)

    def tool(self, path_m: Float[np.ndarray, "num_steps 3"]) -> None:
        """Write the poses of the tool centre point."""
        self._track("tcp/pose", path_m, range(NUM_STEPS))

    def objects(
        self, task: Task, starts: Mapping[str, np.ndarray], ends: Mapping[str, np.ndarray]
    ) -> None:
        """Write where moved objects are at first and from half-way on; soft ones with nodes."""
        for name in task.manipulated:
            path = np.array([starts[name], ends[name], ends[name]])
            steps = (0, NUM_STEPS // 2, NUM_STEPS)
            self._track(f"object/{name}/pose", path, steps)
            model = task.objects[name]
            if model.soft is None:
                continue
            for step, p_m, press in zip(steps, path, (1.0, 0.97, 0.97), strict=True):
                nodes = p_m + CORNERS * np.array(model.size_m) / 2 * [1.0, 1.0, press]
                stamp_ns = START_NS + step * STEP_NS
                sample = PointCloudSample(stamp_ns=stamp_ns, frame_id="base_link", points_m=nodes)
                topic = f"object/{name}/nodes"
                self.raw(topic, schema.POINT_CLOUD, sample.to_cdr(), stamp_ns)

    def _track(
        self, topic: str, path_m: Float[np.ndarray, "num_steps 3"], steps: Sequence[int]
    ) -> None:
        for step, p_m in zip(steps, path_m, strict=True):
            stamp_ns = START_NS + step * STEP_NS
            T = se3.transform_from(np.array([1.0, 0, 0, 0]), np.asarray(p_m, dtype=np.float64))
            sample = PoseSample(stamp_ns=stamp_ns, frame_id="base_link", T_frame_body=T)
            self.raw(topic, schema.POSE_STAMPED, sample.to_cdr(), stamp_ns)

    def joints(self, position: Float[np.ndarray, "num_steps num_joints"]) -> None:
        """Write the joints of the arm."""
        for step, row in enumerate(position):
            stamp_ns = START_NS + step * STEP_NS
            none = np.zeros(0)
            sample = JointSample(
                stamp_ns=stamp_ns, names=ARM_JOINTS, position=row, velocity=none, effort=none
            )
            self.raw("joint_states", schema.JOINT_STATE, sample.to_cdr(), stamp_ns)

    def localised(
        self, trial: Trial, phase: str, places: Mapping[str, np.ndarray], stamp_ns: int
    ) -> None:
        """Write where the twin saw every object, before or after the execution."""
        for name, model in trial.task.objects.items():
            found = trial.found or phase == "start" or name not in trial.task.manipulated
            p_m = places[name]
            record: dict[str, object] = {
                "object": name,
                "found": found,
                "T_base_object": {"p_m": p_m.tolist(), "q_wxyz": [1.0, 0, 0, 0]} if found else None,
                "method": "drawn",
                "reason": None if found else "hidden by the arm",
                "phase": phase,
                "plan_id": trial.plan_id,
            }
            if model.soft is not None and found:
                record["soft_shape"] = {
                    "centroid_m": p_m.tolist(),
                    "axes": np.eye(3).tolist(),
                    "extents_m": (np.array(model.size_m) * [1.0, 1.0, 0.95]).tolist(),
                    "extents_sigma_m": [0.004] * 3,
                }
            self.json("localisation", schema.LOCALISATION, stamp_ns, **record)

    def picture(self, camera: str, name: str, image_u8: np.ndarray, stamp_ns: int) -> None:
        """Write one image, lossless."""
        buffer = io.BytesIO()
        Image.fromarray(image_u8).save(buffer, format="png")
        image = CompressedColor(
            stamp_ns=stamp_ns, frame_id=camera, format="png", data=buffer.getvalue()
        )
        self.raw(f"cam/{camera}/{name}", schema.COMPRESSED_IMAGE, image.to_cdr(), stamp_ns)

    def depth(
        self, camera: str, name: str, depth_m: Float[np.ndarray, "height width"], stamp_ns: int
    ) -> None:
        """Write one depth image."""
        depth_mm = np.rint(1000 * depth_m).astype(np.uint16)
        image = DepthImage(stamp_ns=stamp_ns, frame_id=camera, depth_mm=depth_mm)
        self.raw(f"cam/{camera}/{name}", schema.IMAGE, image.to_cdr(), stamp_ns)


if __name__ == "__main__":
    print(make_evaluation_run(Path(sys.argv[1])).path)
