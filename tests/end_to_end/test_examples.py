"""The examples run, and what they print is right."""

import runpy
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import robot_gst
from bridge.episode import schema
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.writer import EpisodeWriter
from bridge.geometry import se3
from bridge.robots.default import ROBOT
from bridge.sources.standin.kinematics import arm_kinematics
from bridge.sources.standin.planner import NO_ERROR, plan_pick_and_place
from bridge.task.task_file import load_task

EXAMPLES = Path(__file__).parents[2] / "examples"
Example = Callable[..., None]


def example(name: str) -> Example:
    run: Example = SimpleNamespace(**runpy.run_path(str(EXAMPLES / f"{name}.py"))).main
    return run


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("example") / "episodes" / "scan.mcap"
    example("write_episode")(path)
    return path


def test_an_episode_is_written_and_read_into_arrays(
    scan: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    example("read_episode")(scan)
    printed = capsys.readouterr().out
    assert "positions (12, 2) rad" in printed
    assert "colour (12, 60, 80, 3), depth (12, 60, 80) m" in printed


@pytest.mark.slow
def test_a_run_is_rebuilt_and_rendered(
    scan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    example("rebuild_and_render")(scan.parents[1], tmp_path / "view.png", 100)
    decibels = float(capsys.readouterr().out.split("views: ")[1].split(" dB")[0])
    assert decibels > 17  # 200 images, the default, reach 25
    assert (tmp_path / "view.png").read_bytes().startswith(b"\x89PNG")


def write_trial(path: Path) -> None:
    """Write a trial with nothing but a robot description and a plan."""
    poses = {
        "cube": se3.transform_from(np.array([0.92, 0, 0, 0.39]), np.array([0.5, -0.15, 0.02])),
        "box": se3.transform_from(np.array([1.0, 0, 0, 0]), np.array([0.5, 0.19, 0.0])),
    }
    plan = plan_pick_and_place(
        load_task("cube_into_box"),
        poses,
        NO_ERROR,
        kinematics=arm_kinematics(),
        joints_start_rad=np.array([0.0, -1.6, 1.6, -1.6, -1.57, 0.0]),
        max_joint_speed_rad_s=1.5,
        plan_id="plan_0",
        condition="without_replanning",
        start_id="s1",
    )
    with EpisodeWriter(path) as writer:
        writer.describe(EpisodeInfo(id=path.stem, kind="trial", task=plan.task))
        writer.attach(
            "robot.urdf", ROBOT.urdf_text().encode(), media_type="application/xml", log_time_ns=1
        )
        writer.write("/lab/plan", plan.to_json(), type_name=schema.PLAN, log_time_ns=1)


@pytest.mark.slow
def test_a_plan_is_replayed_and_its_verdict_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "trial.mcap"
    write_trial(path)
    assert Episode.open(path).info.task == "cube_into_box"
    example("replay_plan")(path)
    assert "plan_0: accepted True" in capsys.readouterr().out


def test_agreement_is_computed_from_a_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table = tmp_path / "trials.csv"
    table.write_text(
        "trial_id,task,condition,recorded,sim_planned\n"
        "1,cube,without,failure,failure\n2,cube,without,success,failure\n"
        "3,cube,with,success,success\n4,cube,with,,success\n"
    )
    out = ["--out", str(tmp_path / "results"), "--quiet"]
    assert robot_gst.run(["evaluate", str(table), *out]) == 0
    capsys.readouterr()
    example("agreement")(tmp_path)
    printed = capsys.readouterr().out
    assert "agree: 2/3 = 0.667" in printed
    assert "bias (sim - recorded): -25.0 pp" in printed
