"""``robot-gst calibrate --physics``: from recorded probes to the scene, and clear refusals."""

import json
import sys
from pathlib import Path
from typing import Any

import lean_checks
import numpy as np
import pytest

import robot_gst
from bridge.episode import schema
from bridge.episode.cdr.messages import JointSample
from bridge.episode.metadata import Derived, EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.streams import JointTrack
from bridge.episode.writer import EpisodeWriter
from bridge.geometry import se3
from bridge.robots.default import ARM_JOINTS, ROBOT
from bridge.task.plan import Plan, Waypoint
from bridge.task.task_file import Task
from twin.calibrate.physics import cases as cases_module
from twin.calibrate.physics import run as physics_run
from twin.calibrate.physics.cases import (
    Case,
    NoUsableEpisodesError,
    UnusableCaseError,
    read_cases,
    widths_of,
)
from twin.calibrate.physics.parameters import SURFACE_FRICTION, rigid_parameters
from twin.calibrate.physics.run import describe_physics
from twin.physics.config import PhysicsConfig
from twin.replay.rebuilt_scene import physics_of
from twin.robot.posture import BackwardTimeError
from twin.scene.store.calibration import read_calibration, write_calibration, write_physics

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parents[4] / "benchmarks"))
import synthetic

ALL = rigid_parameters(PhysicsConfig())


@pytest.fixture
def run(tmp_path: Path) -> RunFolder:
    return RunFolder.create(tmp_path / "run")


def calibrate(run: RunFolder, *arguments: str) -> int:
    return robot_gst.run(["calibrate", str(run.path), *arguments])


def write_episode(run: RunFolder, name: str, kind: str) -> None:
    with EpisodeWriter(run.episodes_dir / f"{name}.mcap") as writer:
        writer.describe(EpisodeInfo(id=name, kind=kind, task="cube_into_box"))


@pytest.mark.parametrize(
    ("episodes", "said"),
    [
        ({}, "is a probe or a trial"),
        ({"scan_1": "scan"}, "is a probe or a trial"),
        ({"trial_1": "trial"}, "no plan was executed"),
    ],
)
def test_what_is_missing_is_said_in_one_sentence(
    run: RunFolder, episodes: dict[str, str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, kind in episodes.items():
        write_episode(run, name, kind)
    assert calibrate(run, "--physics") == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.strip().count("\n") == 0
    assert read_calibration(run) is None


def observed(x: np.ndarray) -> list[Case]:
    return synthetic.observe(("push", "slide", "squeeze") * 4, ALL, x, seed=1).cases


@pytest.fixture
def with_formulas(monkeypatch: pytest.MonkeyPatch) -> None:
    """Formulas instead of recorded probes and physics."""
    x = np.array([item.units(0.42) if item.name == SURFACE_FRICTION else 0.0 for item in ALL])

    class Quick(synthetic.Formulas):
        def __init__(self, cases: Any, parameters: Any, config: Any, **more: Any) -> None:
            super().__init__(cases, parameters)

        def __enter__(self) -> "Quick":
            return self

        def __exit__(self, *error: object) -> None:
            pass

    monkeypatch.setattr(physics_run, "read_cases", lambda run, output: (observed(x), {}))
    monkeypatch.setattr(physics_run, "Evaluator", Quick)


@pytest.mark.slow
@pytest.mark.usefixtures("with_formulas", "unchecked")
def test_what_was_found_is_kept_in_the_scene_as_replays_read_it_and_told_in_a_table(
    run: RunFolder, capsys: pytest.CaptureFixture[str]
) -> None:
    assert calibrate(run, "--physics", "--evaluations", "30", "--json") == 0
    said = json.loads(capsys.readouterr().out)
    found = read_calibration(run)
    assert found is not None
    assert said["calibration_id"] == found.calibration_id
    physics = found.record["physics"]
    assert physics["version"] == 1
    assert physics["promoted"]
    assert set(physics["sources"]) == {case.episode for case in observed(np.zeros(len(ALL)))}
    assert physics["held_out"]["episodes"]
    fields = physics_of(found.record)
    item = physics["parameters"][SURFACE_FRICTION]
    assert fields["surface_friction"] * PhysicsConfig().object_friction == pytest.approx(
        item["value"]
    )
    assert item["low"] <= 0.42 <= item["high"]
    assert "grip_force_N" not in fields
    assert not physics["parameters"]["mass_scale"]["identified"]
    text = describe_physics(physics, found.calibration_id)
    for parameter in ALL:
        assert parameter.name in text
    assert "not identified" in text
    assert "cut short" not in text
    text = describe_physics({**physics, "cut_short": "after 7 of 30 points"}, "id")
    assert "cut short: after 7 of 30 points; on another machine the numbers" in text
    assert "held out, calibrated: settled poses off by" in text
    assert "of what localisation states changes from pose to pose; the twin's own: push" in text


def physics_part(**changes: Any) -> dict[str, Any]:
    return {"promoted": True, "identified": {"grip_force_N": {"value": 15.0}}, **changes}


def test_older_versions_stay_and_what_was_not_promoted_changes_nothing(run: RunFolder) -> None:
    pose = {"p_m": [0.0, 0.0, 0.0], "q_wxyz": [1.0, 0.0, 0.0, 0.0]}
    write_calibration(run, {"a": {"link": "tool0", "stream": "color", "T_link_camera": pose}}, {})
    first = write_physics(run, physics_part(id="one"))
    failed = write_physics(run, physics_part(id="two", promoted=False, identified={}))
    assert failed["physics"] == first["physics"]
    assert failed["calibration_id"] == first["calibration_id"]
    third = write_physics(run, physics_part(id="three"))
    assert third["calibration_id"] != first["calibration_id"]
    assert third["physics"]["version"] == 3
    assert [item["id"] for item in third["physics_history"]] == ["two", "one"]
    assert set(third["cameras"]) == {"a"}
    assert physics_of(third) == {"grip_force_N": 15.0}


@pytest.fixture(scope="module")
def probed(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A squeeze of the cell, without cameras."""
    from cell_run import START_NS, FileSession

    from bridge.sources.standin import operator
    from bridge.sources.standin.session import run_session
    from bridge.sources.standin.settings import SessionConfig
    from bridge.terminal import Output

    run = RunFolder.create(tmp_path_factory.mktemp("probed"))
    config = SessionConfig(seed=9001, trials=0, probes=1, rate_hz=0.0, scan=False)
    with pytest.MonkeyPatch.context() as patch, lean_checks.unchecked():
        patch.setattr(operator, "PROBES", ("squeeze",))
        run_session(FileSession(run.episodes_dir), config, Output(quiet=True), start_ns=START_NS)
    return run


def with_localisations(
    run: RunFolder, episode: Episode, task: Task, *, lose: str = "", **more: Any
) -> Path:
    """What localisation would write, from nominal starts; it has its own tests."""
    path = run.derived_dir / f"{episode.path.stem}.localised.noscene.mcap"
    path.unlink(missing_ok=True)
    plan_id = f"{episode.info.id}.{episode.info.tags[0].removeprefix('probe:')}"
    with EpisodeWriter(path) as writer:
        writer.describe(
            episode.info,
            derived=Derived(kind="localised", source_episode=episode.info.id, source_sha256=""),
        )
        for phase, named in (("start", None), ("end", plan_id)):
            for key, T in task.draw_start(np.random.default_rng(1)).items():
                found = not (phase == "end" and key == lose)
                q, p = se3.split(T)
                record = {
                    "schema_version": 1,
                    "stamp_ns": 1,
                    "object": key,
                    "found": found,
                    "T_base_object": {"p_m": p.tolist(), "q_wxyz": q.tolist()} if found else None,
                    "covariance": (1e-6 * np.eye(6)).ravel().tolist() if found else None,
                    "symmetry": "none",
                    "confidence": 1.0,
                    "method": "test",
                    "reason": None,
                    "phase": phase,
                    "plan_id": named,
                }
                writer.write_json(
                    "/standin/localisation",
                    record,
                    type_name=schema.LOCALISATION,
                    log_time_ns=1,
                )
    return path


@pytest.mark.slow
def test_recorded_probes_become_cases(probed: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cases_module, "write_localised", with_localisations)
    # Starts are drawn anew here, so the tool is only sometimes near them: look further away.
    monkeypatch.setattr(cases_module, "NEAR_M", 0.5)
    from bridge.terminal import Output

    cases, skipped = read_cases(probed, Output(quiet=True))
    assert not skipped
    (case,) = cases
    assert case.kind == "squeeze"
    assert len(case.held_widths_m) == 1
    assert 0.04 < case.held_widths_m[0] < 0.056
    assert case.objects == ("cube",)
    assert np.isfinite(case.settled).all()
    assert 0 < case.stretches_s[-1, 1] < 20
    assert np.diff(case.joint_times_s).max() < 0.02
    monkeypatch.setattr(
        cases_module, "write_localised", lambda *a, **k: with_localisations(*a, lose="cube", **k)
    )
    with pytest.raises(NoUsableEpisodesError, match="never localised after the plan: cube"):
        read_cases(probed, Output(quiet=True))


def test_a_clock_that_goes_back_while_a_probe_is_executed_teaches_nothing(
    run: RunFolder,
) -> None:
    """Sorted by their stamps the joints would be those of an execution nobody saw."""
    path, second = run.episodes_dir / "probe_1.mcap", 1_000_000_000
    plan = Plan(
        id="p", planner="", policy="", condition="without_replanning", robot="arm",
        frame="base_link", instruction="", task="cube_into_box", stages=(),
        tau=(Waypoint(t_ns=0, p_m=(0.4, 0.0, 0.3), q_wxyz=(1.0, 0.0, 0.0, 0.0), g=0),),
    )  # fmt: skip
    with EpisodeWriter(path) as writer:
        writer.describe(EpisodeInfo(id="probe_1", kind="probe", task="cube_into_box"))
        writer.write("/c/plan", plan.to_json(), type_name=schema.PLAN, log_time_ns=1)
        for kind, stamp in (("execution_started", second), ("execution_ended", 3 * second)):
            event = {"schema_version": 1, "stamp_ns": stamp, "type": kind, "plan_id": "p"}
            writer.write_json("/c/event", event, type_name=schema.EVENT, log_time_ns=stamp)
        stamps = [*range(second, 2 * second, 10_000_000), *range(second, 3 * second, 10_000_000)]
        for index, stamp in enumerate(stamps):
            none = np.zeros(0)
            sample = JointSample(
                stamp_ns=stamp, names=ARM_JOINTS, position=np.zeros(6), velocity=none, effort=none
            )
            writer.write(
                "/c/joint_states",
                sample.to_cdr(),
                type_name=schema.JOINT_STATE,
                log_time_ns=second + index * 10_000_000,
                publish_time_ns=stamp,
            )
    with pytest.raises(BackwardTimeError, match=r"goes back by 0\.99 s at 0\.99 s of plan 'p'"):
        cases_module.read_case(run, Episode.open(path))


def test_joints_that_are_no_numbers_teach_nothing() -> None:
    stamps = np.arange(0, 1_000_000_000, 8_000_000)
    position = np.zeros((len(stamps), 6))
    position[3] = np.nan
    arm = JointTrack(names=ARM_JOINTS, stamps_ns=stamps, position=position)
    cases_module._check_joints(arm, int(stamps[10]), int(stamps[-1]), ROBOT)
    with pytest.raises(UnusableCaseError, match="not a number while the plan was executed"):
        cases_module._check_joints(arm, 0, int(stamps[-1]), ROBOT)


def test_widths_that_are_no_numbers_teach_nothing(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_episode(run, "probe_1", "probe")
    track = JointTrack(
        names=("gripper_width",), stamps_ns=np.arange(3), position=np.array([[0.0], [np.nan], [0]])
    )
    monkeypatch.setattr(cases_module.streams, "joint_track", lambda *_: track)
    with pytest.raises(UnusableCaseError, match="gripper widths hold what is not a number"):
        widths_of(Episode.open(run.episodes()[0]), 0)
