"""A small synthetic run: four trials, replays, held-out views. Its numbers mean nothing."""

import asyncio
import shutil
import sys
from collections.abc import Iterator
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import httpx
import numpy as np
import pytest
from joint_samples import at_positions
from small_plans import plan_of
from starlette.applications import Starlette
from verdicts import verdict_of

from bridge.episode import schema
from bridge.episode.cdr.messages import CompressedColor, PoseSample
from bridge.episode.metadata import Derived, EpisodeInfo, Outcome
from bridge.episode.provenance import hash_file
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter
from bridge.media.color import encode_jpeg
from bridge.robots.default import ARM_JOINTS
from bridge.task.plan import Plan, Stage, Waypoint
from bridge.task.verdict import Factor, Verdict
from dashboards.app import create_app
from dashboards.comparison import stop_updates
from dashboards.guard import Admission
from dashboards.library import Library
from evaluator.compare import compare_run
from evaluator.report.review import refresh
from evaluator.result import write_results

sys.path.insert(0, str(Path(__file__).parent))

from serving import judged

START_NS = 1_760_000_000_000_000_000
EXECUTION_NS = START_NS + 1_000_000_000
END_S = 6.0
BASE = "http://127.0.0.1:8600"
STAGES = (("approach", 0.0, 1.5), ("grasp", 1.5, 2.2), ("carry", 2.2, 3.8), ("release", 3.8, 4.5))


@dataclass(frozen=True)
class Trial:
    """What one synthetic trial should say."""

    id: str
    condition: str
    start_id: str
    _: KW_ONLY
    recorded: bool
    planned: bool | None
    executed: bool | None = None
    rejected_first: bool = False


TRIALS = (
    Trial("trial_0001", "without_replanning", "s1", recorded=False, planned=False, executed=False),
    Trial("trial_0002", "without_replanning", "s2", recorded=True, planned=False, executed=True),
    Trial(
        "trial_0003",
        "with_replanning",
        "s1",
        recorded=True,
        planned=True,
        executed=True,
        rejected_first=True,
    ),
    Trial("trial_0004", "with_replanning", "s2", recorded=True, planned=None),
)


def _ns(t_s: float) -> int:
    return round(t_s * 1e9)


def _tool(t_s: float) -> np.ndarray:
    share = float(np.clip(t_s / 4.5, 0, 1))
    return np.array([0.4 + 0.15 * share, -0.2 + 0.4 * share, 0.12 + 0.1 * np.sin(np.pi * share)])


def _joints(t_s: float) -> np.ndarray:
    return np.array([0.3, -1.2, 1.5, -1.8, -1.57, 0.1]) + 0.3 * np.sin(t_s * np.arange(0.4, 1, 0.1))


def _pose(p_m: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    T[:3, 3] = p_m
    return T


def make_plan(trial: Trial, number: int = 1, parent: str | None = None) -> Plan:
    """Build a plan of four stages."""
    return plan_of(
        f"{trial.id}_p{number}",
        parent_id=parent,
        round=number - 1,
        planner="scripted",
        condition=trial.condition,
        task="cube_into_box",
        start_id=trial.start_id,
        robot="ur5_parallel_gripper",
        instruction="Put the cube into the box.",
        joint_names=ARM_JOINTS,
        stages=tuple(
            Stage(id=name, text=f"{name} the cube", t_start_ns=_ns(a), t_end_ns=_ns(b))
            for name, a, b in STAGES
        ),
        tau=tuple(
            Waypoint(
                t_ns=_ns(t),
                p_m=tuple(_tool(t).tolist()),
                q_wxyz=(0.0, 1.0, 0.0, 0.0),
                g=int(1.8 <= t < 4.0),
                width_m=0.04 if 1.8 <= t < 4.0 else 0.08,
                joints_rad=tuple(_joints(t).tolist()),
            )
            for t in np.linspace(0, 4.5, 19)
        ),
    )


def make_verdict(plan_id: str, accepted: bool | None, trajectory: str, engine: str) -> Verdict:
    """Build a dynamic verdict; a refusal names the cube slipping at 2.8 s."""
    terminal = Factor(value=accepted)
    if accepted is False:
        terminal = Factor(
            value=False,
            first_t_ns=_ns(2.8),
            cause="dropped",
            bodies=("cube", "table"),
            detail="the cube left the gripper during carry",
        )
    return verdict_of(
        plan_id,
        trajectory=trajectory,
        terminal=terminal,
        engine=engine,
        scene_hash="5ce4e0" * 8,
        reason="the object was lost" if accepted is None else None,
    )


def picture(t_s: float, tint: int) -> bytes:
    """Draw a small scene whose cube moves with time, as JPEG."""
    y, x = np.mgrid[0:120, 0:160]
    image = np.stack([120 + x // 4, 130 + y // 3, np.full_like(x, 150 + tint)], axis=2)
    image[70:] = (150, 120, 90)
    left = int(20 + 16 * t_s)
    image[60:80, left : left + 18] = (200, 40, 40)
    return encode_jpeg(np.clip(image, 0, 255).astype(np.uint8), quality=80)


class _Log:
    """Write samples of one episode at their source time."""

    def __init__(self, writer: EpisodeWriter) -> None:
        self._writer = writer

    def put(self, topic: str, type_name: str, data: bytes, stamp_ns: int) -> None:
        self._writer.write(
            topic,
            data,
            type_name=type_name,
            log_time_ns=stamp_ns + 2_000_000,
            publish_time_ns=stamp_ns,
        )

    def event(self, kind: str, stamp_ns: int, **fields: object) -> None:
        record = {"schema_version": 1, "stamp_ns": stamp_ns, "type": kind, **fields}
        self._writer.write(
            "/standin/event",
            record,
            type_name=schema.EVENT,
            log_time_ns=stamp_ns + 2_000_000,
            publish_time_ns=stamp_ns,
        )

    def joints(self, topic: str, names: tuple[str, ...], values: np.ndarray, ns: int) -> None:
        sample = at_positions(ns, names, np.asarray(values, dtype=np.float64))
        self.put(topic, schema.JOINT_STATE, sample.to_cdr(), ns)

    def pose(self, topic: str, p_m: np.ndarray, ns: int) -> None:
        sample = PoseSample(stamp_ns=ns, frame_id="base_link", T_frame_body=_pose(p_m))
        self.put(topic, schema.POSE_STAMPED, sample.to_cdr(), ns)

    def image(self, topic: str, data: bytes, ns: int) -> None:
        image = CompressedColor(stamp_ns=ns, frame_id="side", format="jpeg", data=data)
        self.put(topic, schema.COMPRESSED_IMAGE, image.to_cdr(), ns)


def copy_messages(source: Episode, writer: EpisodeWriter) -> None:
    for message in source.messages():
        writer.write(
            message.topic,
            message.data,
            type_name=message.type_name,
            log_time_ns=message.log_time_ns,
            publish_time_ns=message.publish_time_ns,
        )


def write_trial(run: RunFolder, trial: Trial, *, images: bool = True) -> Path:
    path = run.episodes_dir / f"{trial.id}.mcap"
    plan = make_plan(trial, 2 if trial.rejected_first else 1)
    with EpisodeWriter(path) as writer:
        writer.describe(
            EpisodeInfo(
                id=trial.id,
                kind="trial",
                task="cube_into_box",
                instruction="Put the cube into the box.",
                condition=trial.condition,
                policy="scripted",
                start_id=trial.start_id,
                start_seed=7,
                robot="ur5_parallel_gripper",
                cell="standin",
                stand_in=True,
            ),
            outcome=Outcome(
                result="success" if trial.recorded else "failure",
                k=int(trial.recorded),
                by="stand-in operator",
                detail=None if trial.recorded else "the cube slipped",
            ),
        )
        log = _Log(writer)
        if trial.rejected_first:
            first = make_plan(trial)
            log.put("/standin/plan", schema.PLAN, first.to_json(), START_NS + 1)
            said = make_verdict(first.id, False, "planned", "gate")
            log.put("/standin/verdict", schema.VERDICT, said.to_json(), START_NS + 2)
            log.event("replan", START_NS + 3, plan_id=plan.id, text="the twin refused the plan")
        log.put("/standin/plan", schema.PLAN, plan.to_json(), START_NS + 4)
        said = make_verdict(plan.id, trial.planned, "planned", "gate")
        log.put("/standin/verdict", schema.VERDICT, said.to_json(), START_NS + 5)
        log.event("execution_started", EXECUTION_NS, plan_id=plan.id)
        for name, a, b in STAGES:
            late = 0.12
            log.event("stage_started", EXECUTION_NS + _ns(a + late), plan_id=plan.id, stage_id=name)
            log.event("stage_ended", EXECUTION_NS + _ns(b + late), plan_id=plan.id, stage_id=name)
        log.event("execution_ended", EXECUTION_NS + _ns(4.7), plan_id=plan.id)
        for step in range(int(END_S * 20)):
            t_s = step / 20
            ns, done = START_NS + _ns(t_s), max(t_s - 1.12, 0.0)
            log.joints("/standin/joint_states", ARM_JOINTS, _joints(min(done, 4.5)), ns)
            width = 0.041 if 1.9 <= done < 4.1 else 0.08
            log.joints("/standin/gripper/state", ("gripper_width",), np.array([width]), ns)
            log.pose("/standin/tcp/pose", _tool(done), ns)
            if images and step % 5 == 0:
                log.image("/standin/cam/side/color/image", picture(t_s, 0), ns)
                log.image("/standin/cam/wrist/color/image", picture(t_s, 80), ns)
    return path


def write_replay(
    run: RunFolder, trial: Trial, trajectory: str, accepted: bool | None, engine: str = "bullet"
) -> Path:
    """Write a dynamic replay whose clock starts at zero."""
    plan = make_plan(trial, 2 if trial.rejected_first else 1)
    source = run.episodes_dir / f"{trial.id}.mcap"
    name = f"{trial.id}.replay.{trajectory}.dynamic.{plan.id}.{engine}.a1b2c3d4.mcap"
    with EpisodeWriter(run.derived_dir / name) as writer:
        writer.describe(
            EpisodeInfo(id=trial.id, kind="trial", task="cube_into_box", stand_in=True),
            derived=Derived(
                kind="replay",
                source_episode=trial.id,
                source_sha256=hash_file(source),
                plan_id=plan.id,
                trajectory=trajectory,
                mode="dynamic",
                scene_hash="5ce4e0" * 8,
                engine=engine,
                seed=0,
                settings={"eps_col_m": 0.002},
            ),
        )
        log = _Log(writer)
        said = make_verdict(plan.id, accepted, trajectory, engine)
        log.put("/standin/verdict", schema.VERDICT, said.to_json(), 0)
        for step in range(110):
            t_s = step / 20
            ns = _ns(t_s)
            offset = np.array([0.0, 0.0, 0.0015 * np.sin(2 * t_s)])
            log.joints("/standin/joint_states", ARM_JOINTS, _joints(min(t_s, 4.5)), ns)
            width = 0.04 if 1.85 <= t_s < 4.05 else 0.08
            log.joints("/standin/gripper/state", ("gripper_width",), np.array([width]), ns)
            log.pose("/standin/tcp/pose", _tool(t_s) + offset, ns)
            lost = accepted is False and t_s > 2.8
            height = 0.02 if t_s < 2.2 or lost else 0.02 + 0.08 * min(t_s - 2.2, 1.0)
            log.pose("/standin/object/cube/pose", np.array([0.45, 0.0, height]), ns)
            gap = np.array([0.03 + 0.02 * np.cos(1.5 * t_s)])
            log.joints("/standin/replay/clearance", ("min_clearance_m",), gap, ns)
    return run.derived_dir / name


def write_drawn(run: RunFolder, trial: Trial, trajectory: str, steps: range) -> None:
    """Draw a replay: the twin's cube lags a second behind the recorded one."""
    path = run.derived_dir / f"{trial.id}.replay.{trajectory}.kinematic.drawn.mcap"
    with EpisodeWriter(path) as writer:
        writer.describe(
            EpisodeInfo(id=trial.id, kind="trial", stand_in=True),
            derived=Derived(
                kind="replay",
                source_episode=trial.id,
                source_sha256=hash_file(run.episodes_dir / f"{trial.id}.mcap"),
                plan_id=make_plan(trial).id,
                trajectory=trajectory,
                mode="kinematic",
                engine="splat",
                seed=0,
            ),
        )
        log = _Log(writer)
        for step in steps:
            drawn = picture(step / 20 - 1, 0)
            log.image("/standin/cam/side/rendered/image", drawn, START_NS + _ns(step / 20))


def write_divergence(
    writer: EpisodeWriter, plan_id: str, between: tuple[str, str], first_t_ns: int
) -> None:
    """The cube lies 69 mm apart from an instant of the plan on."""
    first = {
        "between": list(between),
        "quantity": "object_position",
        "body": "cube",
        "first_t_ns": first_t_ns,
        "size": 0.069,
        "limit": 0.02,
        "unit": "m",
        "attribution": "contact",
        "detail": "cube lies 69 mm apart",
    }
    record = {
        "schema_version": 1,
        "plan_id": plan_id,
        "lag_s": None,
        "first": first,
        "quantities": [first],
        "not_compared": [],
    }
    topic = "/standin/replay/divergence"
    writer.write(topic, record, type_name=schema.DIVERGENCE, log_time_ns=1)


def write_views(run: RunFolder, source: str = "scan") -> Path:
    """Write three held-out views with their renderings."""
    path = run.derived_dir / f"{source}.views.0a1b2c3d.mcap"
    with EpisodeWriter(path) as writer:
        writer.describe(
            EpisodeInfo(id=source, kind="scan", stand_in=True),
            derived=Derived(kind="views", source_episode=source, source_sha256="", engine="splat"),
        )
        log = _Log(writer)
        for index, noise in enumerate((0, 30, 8)):
            ns = START_NS + index * 1_000_000_000
            log.image("/standin/cam/side/color/image", picture(index, 0), ns)
            log.image("/standin/cam/side/rendered/image", picture(index + 0.1, noise), ns)
    return path


def make_run(folder: Path) -> RunFolder:
    """Write the whole synthetic run, evaluated."""
    run = RunFolder.create(folder)
    for trial in TRIALS:
        write_trial(run, trial)
        write_replay(run, trial, "planned", trial.planned)
        if trial.executed is not None:
            write_replay(run, trial, "executed", trial.executed)
    with EpisodeWriter(run.episodes_dir / "scan.mcap") as writer:
        writer.describe(EpisodeInfo(id="scan", kind="scan", cell="standin", stand_in=True))
        _Log(writer).image("/standin/cam/side/color/image", picture(0.0, 0), START_NS)
        topic = "/standin/cam/side/depth/image"
        writer.write(topic, b"", type_name=schema.IMAGE, log_time_ns=START_NS)
    write_views(run)
    write_results(compare_run(run).results(), run.results_dir / "results.json")
    refresh(run)
    return run


@pytest.fixture(scope="session")
def synthetic() -> ModuleType:
    """Return this module: tests build their own runs from its functions."""
    return sys.modules[__name__]


@pytest.fixture(scope="session")
def shared_run(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    return make_run(tmp_path_factory.mktemp("runs") / "monday")


@pytest.fixture
def disagreement(tmp_path: Path) -> RunFolder:
    """Return one trial that succeeded, of which the twin says that it fails."""
    run = RunFolder.create(tmp_path / "run")
    write_trial(run, TRIALS[1])
    write_replay(run, TRIALS[1], "planned", False)
    return run


@pytest.fixture
def copy(shared_run: RunFolder, tmp_path: Path) -> RunFolder:
    """Return a copy of the evaluated run, in a folder whose name a shell would take apart."""
    return RunFolder(shutil.copytree(shared_run.path, tmp_path / "Zelle 3 (früh)"))


class Browser:
    """Ask an application for pages without a network."""

    def __init__(self, app: Starlette) -> None:
        """Remember the application."""
        self._app = app

    def get(self, address: str, **options: object) -> httpx.Response:
        """Return the answer; redirects are not followed."""
        return self._ask("GET", address, **options)

    def post(self, address: str, **options: Any) -> httpx.Response:
        """Send something as a page of the same server does; headers replace that page's."""
        headers = {"Origin": BASE, **options.pop("headers", {})}
        return self._ask("POST", address, headers=headers, **options)

    def _ask(self, method: str, address: str, **options: Any) -> httpx.Response:
        async def ask() -> httpx.Response:
            transport = httpx.ASGITransport(app=self._app)
            async with httpx.AsyncClient(transport=transport, base_url=BASE) as client:
                return await client.request(method, address, **options)

        return asyncio.run(ask())


@pytest.fixture(autouse=True)
def no_reader_left() -> Iterator[None]:
    """End what pages let read behind them."""
    yield
    stop_updates()


def browser_of(*runs: RunFolder, admission: Admission | None = None) -> Browser:
    """Return a browser on the pages of some runs, which are read as they are now."""
    for run in runs:
        judged(run)
    return Browser(create_app(Library.open([run.path for run in runs]), admission))


@pytest.fixture
def browser(shared_run: RunFolder) -> Browser:
    return browser_of(shared_run)


@pytest.fixture
def own_run(tmp_path: Path) -> RunFolder:
    """Return a small run that a test may damage: one trial, no replay, no results."""
    run = RunFolder.create(tmp_path / "own")
    write_trial(run, TRIALS[0])
    return run
