"""Plans in the Rerun file: grasps that were looked at, the way, and what was refused before."""

from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from rerun_cell import urdf, write_cell_run
from test_rerun_view import read_back

import robot_gst
from bridge.episode import schema
from bridge.episode.cdr.messages import string_to_cdr
from bridge.episode.metadata import Derived, EpisodeInfo
from bridge.episode.run_folder import PLAN_REPLAY, REFUSED_PLAN, RunFolder
from bridge.episode.writer import EpisodeWriter
from bridge.task.plan import CandidateGrasp, Plan, Ranking, Stage, SteeredBy
from dashboards.rerun_view import export_rrd, run_of
from dashboards.rerun_viewer import episode_of

AT_NS = 40_000_000_000
T_CUBE = {"p_m": [0.45, -0.1, 0.02], "q_wxyz": [1.0, 0.0, 0.0, 0.0]}
END = {"p_m": [0.5, 0.2, 0.03], "q_wxyz": [1.0, 0.0, 0.0, 0.0]}
DOWN = (0.0, 1.0, 0.0, 0.0)
Content = dict[str, dict[str, list[object]]]


def grasp(x_m: float, *, chosen: bool) -> CandidateGrasp:
    return CandidateGrasp(
        object="cube", p_m=(x_m, 0.0, 0.0), q_wxyz=DOWN, width_m=0.04, margin=5.0, chosen=chosen
    )


def planned(synthetic: ModuleType, number: int) -> Plan:
    """The second is steered by what was said of the first, and takes the other grasp."""
    plan = synthetic.make_plan(synthetic.TRIALS[0], number, "trial_0001_p1" if number > 1 else None)
    stage = Stage(
        id="release", text="let go", predicted_objects={"cube": END}, t_end_ns=3_000_000_000
    )
    return replace(
        plan,
        entities={"cube": T_CUBE},
        stages=(stage,),
        candidate=Ranking(rank=number - 1, cost=0.25, seed=3),
        steered_by=SteeredBy(clause="terminal.dropped") if number > 1 else None,
        grasps=tuple(grasp(0.01 * i, chosen=i == number - 1) for i in range(3)),
    )


def write_planned(run: RunFolder, synthetic: ModuleType, number: int, mesh: Path) -> Path:
    """A plan as ``robot-gst plan`` leaves it, with a replay of one sample."""
    plan = planned(synthetic, number)
    run.plans_dir.mkdir(exist_ok=True)
    path = run.plans_dir / f"{plan.id}{'.json' if number > 1 else REFUSED_PLAN}"
    path.write_bytes(plan.to_json())
    derived = Derived(
        kind="replay", source_episode="trial_0001", source_sha256="", plan_id=plan.id,
        trajectory="planned", mode="dynamic", engine="bullet",
    )  # fmt: skip
    said = synthetic.make_verdict(plan.id, number > 1, "planned", "bullet")
    with EpisodeWriter(run.plans_dir / f"{plan.id}{PLAN_REPLAY}") as writer:
        writer.describe(
            EpisodeInfo(id="trial_0001", kind="trial", task="cube_into_box", stand_in=True),
            derived=derived,
        )
        description = string_to_cdr(urdf(mesh))
        writer.write("/robot_description", description, type_name=schema.STRING, log_time_ns=AT_NS)
        for topic, type_name, data in (
            ("/standin/plan", schema.PLAN, plan.to_json()),
            ("/standin/verdict", schema.VERDICT, said.to_json()),
        ):
            writer.write(topic, data, type_name=type_name, log_time_ns=AT_NS)
        log = synthetic._Log(writer)
        log.pose("/standin/object/cube/pose", np.array([0.45, -0.1, 0.02]), AT_NS)
        log.pose("/standin/tcp/pose", np.array([0.4, 0.0, 0.3]), AT_NS)
    return path


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, synthetic: ModuleType) -> RunFolder:
    folder = tmp_path_factory.mktemp("planned")
    run = write_cell_run(folder, synthetic)
    for number in (1, 2):
        write_planned(run, synthetic, number, folder / "part.stl")
    return run


@pytest.fixture(scope="module")
def content(run: RunFolder, tmp_path_factory: pytest.TempPathFactory) -> Content:
    path = episode_of(run.plans_dir / "trial_0001_p2.json")
    out = tmp_path_factory.mktemp("out") / "plan.rrd"
    export_rrd(path, out, run_of(path))
    return read_back(out)


def color(content: Content, entity: str) -> object:
    return next(row for row in content[entity]["LineStrips3D:colors"] if row)[0]


def test_the_chosen_grasp_stands_out_among_those_looked_at(content: Content) -> None:
    entities = [f"/plans/trial_0001_p2/grasps/cube/{rank}" for rank in range(3)]
    colors = [color(content, each) for each in entities]
    assert colors[0] == colors[2] != colors[1]
    labels = [content[each]["LineStrips3D:labels"][0][0] for each in entities]
    assert ["chosen" in label for label in labels] == [False, True, False]
    radii = [content[each]["LineStrips3D:radii"][0][0] for each in entities]
    assert radii[1] > radii[0]


def test_a_grasp_is_drawn_where_the_object_is(content: Content) -> None:
    strips = content["/plans/trial_0001_p2/grasps/cube/1"]["LineStrips3D:strips"][0]
    tips = np.array(strips[0])[[0, -1]]
    np.testing.assert_allclose(tips.mean(axis=0), [0.46, -0.1, 0.02], atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(tips[1] - tips[0]), 0.04, atol=1e-6)
    assert np.array(strips[1])[-1, 2] > 0.1, "the hand comes from above"


def test_the_way_is_the_plans_and_its_colour_says_the_verdict(
    synthetic: ModuleType, content: Content
) -> None:
    way = content["/plans/trial_0001_p2/tool_path"]["LineStrips3D:strips"][0][0]
    np.testing.assert_allclose(way, planned(synthetic, 2).positions_m(), atol=1e-6)
    accepted = color(content, "/plans/trial_0001_p2/tool_path")
    assert color(content, "/plans/trial_0001_p1/tool_path") != accepted
    assert [row[0] for row in content["/plans/trial_0001_p2/hand"]["Points3D:labels"]] == ["closes"]


def test_the_arm_follows_the_plan_at_its_own_times(synthetic: ModuleType, content: Content) -> None:
    plan = planned(synthetic, 2)
    joints = content[f"/planned_arm/robot_joints/{plan.joint_names[0]}"]
    stamps = [stamp for stamp in joints["source_time"] if stamp is not None]
    np.testing.assert_array_equal(stamps, AT_NS + plan.times_ns())
    assert [name for name in content if name.startswith("/planned_arm/robot/visual_geometries/")]


def test_the_object_is_shown_where_the_plan_leaves_it(content: Content) -> None:
    cube = content["/plans/trial_0001_p2/predicted/cube"]
    assert [row[0] for row in cube["Transform3D:translation"] if row] == [pytest.approx(END["p_m"])]
    assert cube["source_time"][0] == AT_NS + 3_000_000_000
    assert "/replayed/planned/dynamic/objects/cube" in content, "the twin's rollout"


def test_the_text_says_what_steered_it(content: Content) -> None:
    text = content["/about"]["TextDocument:text"][0][0]
    assert "steered by terminal.dropped" in text
    assert "refused by terminal.dropped" in text
    assert text.index("trial_0001_p1`: ") < text.index("trial_0001_p2`: ")


def test_what_was_refused_before_is_shown_from_a_relative_path_too(
    run: RunFolder, tmp_path: Path, content: Content, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(run.path.parent)
    path = episode_of(run.plans_dir.relative_to(run.path.parent) / "trial_0001_p2.json")
    assert not path.is_absolute()
    export_rrd(path, tmp_path / "plan.rrd", run_of(path))
    found = read_back(tmp_path / "plan.rrd")
    assert "/plans/trial_0001_p1/tool_path" in found
    assert found.keys() == content.keys()


def test_a_refused_plan_that_is_gone_is_a_note(
    run: RunFolder, tmp_path: Path, synthetic: ModuleType
) -> None:
    alone = RunFolder.create(tmp_path / "alone")
    (tmp_path / "part.stl").write_bytes((run.path.parent / "part.stl").read_bytes())
    write_planned(alone, synthetic, 2, tmp_path / "part.stl")
    path = episode_of(alone.plans_dir / "trial_0001_p2.json")
    done = export_rrd(path, tmp_path / "x.rrd", run_of(path))
    assert [note for note in done.notes if "trial_0001_p1, refused before, is not shown" in note]


def test_an_episode_shows_every_plan_of_its_trial(run: RunFolder, tmp_path: Path) -> None:
    path = run.episodes()[0]
    export_rrd(path, tmp_path / "trial.rrd", run_of(path))
    found = read_back(tmp_path / "trial.rrd")
    assert [name for name in found if name.startswith("/plans/") and name.endswith("tool_path")]


def test_a_plan_without_its_replay_is_wrong_use(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "lonely.json"
    path.write_text("{}")
    assert robot_gst.run(["view", str(path)]) == 2
    assert "lonely.replay.mcap" in capsys.readouterr().err
