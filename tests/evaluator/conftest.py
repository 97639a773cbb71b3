"""Small invented run folders, written with the same writer the recorder uses."""

import importlib.util
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import lean_checks
import numpy as np
import pytest
import small_plans
import verdicts

from bridge.episode import schema
from bridge.episode.cdr.messages import PoseSample
from bridge.episode.metadata import Derived, EpisodeInfo, Outcome
from bridge.episode.provenance import hash_file
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter
from bridge.task.plan import Plan, Stage, Waypoint
from bridge.task.verdict import Factor, Verdict
from evaluator.compare import Comparison, compare_run

START_NS = 10_000_000_000
STEP_NS = 100_000_000
NUM_POSES = 11


def verdict_of(accepted: bool | None, *, plan_id: str, trajectory: str = "planned") -> Verdict:
    """Build a verdict that says this, failing on clearance where it fails."""
    clearance = Factor(value=True)
    terminal = Factor(value=True)
    if accepted is False:
        clearance = Factor(
            value=False, first_t_ns=1_500_000_000, cause="collision", bodies=("gripper", "box")
        )
    if accepted is None:
        terminal = Factor(value=None)
    return verdicts.verdict_of(
        plan_id, trajectory=trajectory, clearance=clearance, terminal=terminal, seed=1
    )


def plan_of(plan_id: str) -> Plan:
    """Build the smallest plan the schema accepts."""
    return small_plans.plan_of(
        plan_id,
        instruction="Put the cube into the box.",
        stages=(Stage(id="grasp", text="Grasp."),),
        tau=(
            Waypoint(t_ns=0, p_m=(0.4, 0.0, 0.2), q_wxyz=(1.0, 0.0, 0.0, 0.0), g=0),
            Waypoint(t_ns=STEP_NS, p_m=(0.5, 0.0, 0.2), q_wxyz=(1.0, 0.0, 0.0, 0.0), g=1),
        ),
    )


@dataclass(frozen=True, kw_only=True)
class RunMaker:
    """Write trials and replays into one run folder."""

    run: RunFolder

    def trial(
        self,
        name: str,
        *,
        recorded: str | None = "success",
        condition: str = "without_replanning",
        start_id: str | None = "s1",
        gate: bool | str | None = "none",
        gate_engine: str = "test",
        late_gate: bool | str | None = "none",
        late_gate_made_ns: int | None = None,
        sent: bool = True,
        stand_in: bool = True,
        kind: str = "trial",
        offset_m: float = 0.0,
        tags: tuple[str, ...] = (),
        localised_m: float | None = None,
        num_poses: int = NUM_POSES,
        start_ns: int = START_NS,
        outcome: Outcome | None = None,
    ) -> str:
        """Write one recorded trial; the plan is named after it. Returns the plan's id."""
        info = EpisodeInfo(
            id=name,
            kind=kind,
            task="cube_into_box",
            condition=condition,
            policy="scripted",
            start_id=start_id,
            cell="standin",
            stand_in=stand_in,
            tags=tags,
        )
        if outcome is None and recorded is not None:
            outcome = Outcome(result=recorded, k=int(recorded == "success"))
        plan_id = f"plan_{name}"
        with EpisodeWriter(self.run.episodes_dir / f"{name}.mcap") as writer:
            writer.describe(info, outcome=outcome)
            log = _Log(writer)
            if localised_m is not None:
                log.localised(localised_m)
            plan = plan_of(plan_id)
            log.raw("/standin/plan", schema.PLAN, plan.to_json(), start_ns - 2 * STEP_NS)
            never_sent = plan_of(f"{plan_id}_unsent")
            log.raw("/standin/plan", schema.PLAN, never_sent.to_json(), start_ns - 2 * STEP_NS)
            if gate != "none":
                assert not isinstance(gate, str)
                said = replace(verdict_of(gate, plan_id=plan_id), engine=gate_engine).to_json()
                log.raw("/standin/verdict", schema.VERDICT, said, start_ns - STEP_NS)
            if sent:
                log.event("execution_started", plan_id, start_ns)
            if late_gate != "none":
                assert not isinstance(late_gate, str)
                said = verdict_of(late_gate, plan_id=plan_id).to_json()
                writer.write(
                    "/standin/verdict",
                    said,
                    type_name=schema.VERDICT,
                    log_time_ns=start_ns + STEP_NS,
                    publish_time_ns=late_gate_made_ns or start_ns + STEP_NS,
                )
            log.poses("/standin/tcp/pose", start_ns, offset_m, num_poses)
            if sent:
                log.event("execution_ended", plan_id, start_ns + num_poses * STEP_NS)
        return plan_id

    def localised(self, name: str, x_m: float, *, source_sha256: str | None = None) -> Path:
        """Write what the twin localised in a trial before its execution."""
        source = self.run.episodes_dir / f"{name}.mcap"
        path = self.run.derived_dir / f"{name}.localised.noscene.mcap"
        derived = Derived(
            kind="localised", source_episode=name, source_sha256=source_sha256 or hash_file(source)
        )
        with EpisodeWriter(path) as writer:
            writer.describe(EpisodeInfo(id=name, kind="trial"), derived=derived)
            _Log(writer).localised(x_m)
        return path

    def replay(
        self,
        name: str,
        *,
        accepted: bool | None = True,
        trajectory: str = "planned",
        mode: str = "dynamic",
        offset_m: float = 0.0,
        start_ns: int = 0,
        plan_id: str | None = None,
        source_sha256: str | None = None,
        tag: str = "a",
        num_poses: int = NUM_POSES,
        astray: int | None = None,
        scene_hash: str | None = None,
        settings: dict[str, Any] | None = None,
        engine: str = "test",
        stand_in: bool = True,
    ) -> Path:
        """Write one derived replay of a trial."""
        source = self.run.episodes_dir / f"{name}.mcap"
        plan_id = plan_id or f"plan_{name}"
        derived = Derived(
            kind="replay",
            source_episode=name,
            source_sha256=source_sha256 or hash_file(source),
            plan_id=plan_id,
            trajectory=trajectory,
            mode=mode,
            scene_hash=scene_hash,
            engine=engine,
            seed=1,
            settings=settings or {},
        )
        stem = f"{name}.replay.{trajectory}.{mode}.{plan_id}.test.{tag}"
        path = self.run.derived_dir / f"{stem}.mcap"
        info = EpisodeInfo(id=stem.replace(".", "-"), kind="trial", stand_in=stand_in)
        with EpisodeWriter(path) as writer:
            writer.describe(info, derived=derived)
            log = _Log(writer)
            said = verdict_of(accepted, plan_id=plan_id, trajectory=trajectory)
            log.raw("/standin/verdict", schema.VERDICT, said.to_json(), start_ns)
            log.poses("/standin/tcp/pose", start_ns, offset_m, num_poses, astray)
        return path


@dataclass(frozen=True)
class _Log:
    writer: EpisodeWriter

    def raw(self, topic: str, type_name: str, data: bytes, stamp_ns: int) -> None:
        self.writer.write(topic, data, type_name=type_name, log_time_ns=stamp_ns)

    def json(self, topic: str, type_name: str, record: dict[str, object], stamp_ns: int) -> None:
        self.writer.write(topic, record, type_name=type_name, log_time_ns=stamp_ns)

    def event(self, kind: str, plan_id: str, stamp_ns: int) -> None:
        record = {"schema_version": 1, "stamp_ns": stamp_ns, "type": kind, "plan_id": plan_id}
        self.json("/standin/event", schema.EVENT, record, stamp_ns)

    def localised(self, x_m: float) -> None:
        stamp_ns = START_NS - 5 * STEP_NS
        record = {
            "schema_version": 1,
            "stamp_ns": stamp_ns,
            "object": "cube",
            "found": True,
            "T_base_object": {"p_m": [x_m, 0.0, 0.02], "q_wxyz": [1.0, 0.0, 0.0, 0.0]},
            "method": "test",
        }
        self.json("/standin/localisation", schema.LOCALISATION, record, stamp_ns)

    def poses(
        self, topic: str, start_ns: int, offset_m: float, count: int, astray: int | None = None
    ) -> None:
        for index in range(count):
            T = np.eye(4)
            T[:3, 3] = 0.4 + 0.01 * index, 1.0 if index == astray else offset_m, 0.2
            stamp_ns = start_ns + index * STEP_NS
            pose = PoseSample(stamp_ns=stamp_ns, frame_id="base_link", T_frame_body=T)
            self.raw(topic, schema.POSE_STAMPED, pose.to_cdr(), stamp_ns)


@pytest.fixture
def maker(tmp_path: Path) -> RunMaker:
    """Start an empty run."""
    return RunMaker(run=RunFolder.create(tmp_path / "monday"))


@pytest.fixture(scope="session")
def six_trials_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three starts without and with replanning; the twin is wrong about one of six."""
    maker = RunMaker(run=RunFolder.create(tmp_path_factory.mktemp("six") / "monday"))
    table: tuple[tuple[str, str, str, bool], ...] = (
        ("a1", "without_replanning", "success", True),
        ("a2", "without_replanning", "failure", False),
        ("a3", "without_replanning", "failure", True),
        ("b1", "with_replanning", "success", True),
        ("b2", "with_replanning", "success", True),
        ("b3", "with_replanning", "failure", False),
    )
    for name, condition, recorded, said in table:
        gate = said if condition == "with_replanning" else "none"
        maker.trial(name, recorded=recorded, condition=condition, start_id=f"s{name[1]}", gate=gate)
        maker.replay(name, accepted=said, offset_m=0.01)
        maker.replay(name, accepted=recorded == "success", trajectory="executed", offset_m=0.002)
    return maker.run.path


@pytest.fixture
def six_trials(six_trials_once: Path, tmp_path: Path) -> RunMaker:
    """A fresh copy of the six trials, for the test to spoil."""
    return RunMaker(run=RunFolder(shutil.copytree(six_trials_once, tmp_path / "monday")))


@pytest.fixture
def write_table(tmp_path: Path) -> Callable[[str], Path]:
    """Write a CSV file from text."""

    def write(text: str) -> Path:
        path = tmp_path / "table.csv"
        path.write_text(text)
        return path

    return write


def golden_script(name: str) -> ModuleType:
    """Load a script of ``tests/golden``, which is no package."""
    path = Path(__file__).parents[1] / "golden" / f"{name}.py"
    if str(path.parent) not in sys.path:
        sys.path.insert(0, str(path.parent))  # scripts find their own parts beside them
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def evaluation_run_once(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """An invented run with data for every part of an evaluation. Read it only."""
    folder = tmp_path_factory.mktemp("golden") / "everything"
    few = {"cube_into_box": 4, "sloth_into_basket": 3, "five_ducks_into_basket": 3}
    with lean_checks.unchecked():
        run = golden_script("make_evaluation_run").make_evaluation_run(folder, trials=few)
    assert isinstance(run, RunFolder)
    return run


@pytest.fixture(scope="session")
def everything(evaluation_run_once: RunFolder) -> Comparison:
    with lean_checks.unchecked():
        return compare_run(evaluation_run_once)


@pytest.fixture(scope="session")
def load_golden_script() -> Callable[[str], ModuleType]:
    """For tests in the folders below, which cannot import this file."""
    return golden_script
