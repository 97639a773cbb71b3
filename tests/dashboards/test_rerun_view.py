"""The Rerun file: Rerun itself reads it back, and its numbers are the episode's."""

import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import rerun as rr
import rerun.chunk as rc
from joint_samples import at_positions
from rerun.urdf import UrdfTree
from rerun_cell import CUBE_STL, T_BASE_CAMERA, urdf, write_cell_run

from bridge.episode import schema
from bridge.episode.cdr.messages import CompressedColor
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.streams import events, joint_track
from bridge.episode.writer import EpisodeWriter
from bridge.media.palette import rgb
from bridge.robots.default import ARM_JOINTS
from bridge.robots.robot import read_robot
from dashboards.errors import DashboardError
from dashboards.recording import read_recording
from dashboards.rerun_entities import drawable, log_robot
from dashboards.rerun_file import RerunFile
from dashboards.rerun_view import Exported, export_rrd, run_of
from dashboards.wording import event_words


@pytest.fixture(scope="module")
def cell_run(tmp_path_factory: pytest.TempPathFactory, synthetic: ModuleType) -> RunFolder:
    return write_cell_run(tmp_path_factory.mktemp("rerun"), synthetic)


@pytest.fixture(scope="module")
def exported(cell_run: RunFolder, tmp_path_factory: pytest.TempPathFactory) -> Exported:
    episode = cell_run.episodes()[0]
    out = tmp_path_factory.mktemp("out") / "trial.rrd"
    return export_rrd(episode, out, run_of(episode))


def read_back(path: Path) -> dict[str, dict[str, list[object]]]:
    """Entity -> component -> values (one entry per row), with ``source_time`` [ns] among them."""
    found: dict[str, dict[str, list[object]]] = {}
    for chunk in rc.RrdReader(path).store().stream().to_chunks():
        entity = found.setdefault(str(chunk.entity_path), {})
        batch = chunk.to_record_batch()
        for name, column in zip(batch.schema.names, batch.columns, strict=True):
            values = column.cast("int64") if name == "source_time" else column
            entity.setdefault(name, []).extend(values.to_pylist())
    return found


@pytest.fixture(scope="module")
def content(exported: Exported) -> dict[str, dict[str, list[object]]]:
    return read_back(exported.path)


def test_rerun_verifies_the_file(exported: Exported) -> None:
    command = [sys.executable, "-m", "rerun", "rrd", "verify", str(exported.path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    assert "without error" in done.stdout + done.stderr
    assert not exported.path.with_name("trial.rrd.part").exists()


def test_every_part_of_the_episode_is_in_the_file(
    content: dict[str, dict[str, list[object]]],
) -> None:
    replay = "/replayed/planned/dynamic"
    wanted = {
        "/about",
        "/recorded/cameras/hand/color",
        "/recorded/cameras/hand/depth",
        "/recorded/robot/visual_geometries/arm/visual_0",
        f"/recorded/robot_joints/{ARM_JOINTS[0]}",
        *(f"/recorded/joints/{name}" for name in ARM_JOINTS),
        *("/recorded/tcp", "/recorded/tcp_path", "/recorded/gripper_width_m", "/recorded/events"),
        *("/recorded/verdicts", "/plans/trial_0001_p1"),
        *(f"{replay}/tcp_path", f"{replay}/clearance_m", f"{replay}/objects/cube"),
        "/replayed/executed/dynamic/tcp_path",
    }
    assert wanted <= set(content)


def test_stand_in_truth_is_not_in_the_file(exported: Exported) -> None:
    data = exported.path.read_bytes()
    assert b"secret" not in data
    assert b"truth" not in data


def test_joints_are_the_recorded_ones_at_their_source_time(
    cell_run: RunFolder, content: dict[str, dict[str, list[object]]]
) -> None:
    track = joint_track(Episode.open(cell_run.episodes()[0]))
    for index, name in enumerate(track.names):
        entity = content[f"/recorded/joints/{name}"]
        stamps = [stamp for stamp in entity["source_time"] if stamp is not None]
        np.testing.assert_array_equal(stamps, track.stamps_ns)
        values = [row[0] for row in entity["Scalars:scalars"] if row]
        np.testing.assert_array_equal(values, track.position[:, index])


def test_a_moving_camera_has_its_pose_at_every_image_and_its_intrinsics(
    content: dict[str, dict[str, list[object]]],
) -> None:
    entity = content["/recorded/cameras/hand/color"]
    places = [row[0] for row in entity["Transform3D:translation"] if row]
    expected = [T_BASE_CAMERA[:3, 3] + [0.1 * index, 0, 0] for index in range(2)]
    np.testing.assert_allclose(places, expected, atol=1e-6)
    matrix = next(row[0] for row in entity["Pinhole:image_from_camera"] if row)
    np.testing.assert_allclose(matrix, [20, 0, 0, 0, 21, 0, 8.25, 6.5, 1])
    assert content["/recorded/cameras/hand/depth"]["DepthImage:meter"] == [[1000.0]]


def test_images_are_byte_for_byte_the_recorded_ones(
    cell_run: RunFolder, content: dict[str, dict[str, list[object]]]
) -> None:
    topic = "/standin/cam/hand/color/image"
    messages = Episode.open(cell_run.episodes()[0]).messages([topic])
    recorded = [CompressedColor.from_cdr(message.data).data for message in messages]
    rows = content["/recorded/cameras/hand/color"]["EncodedImage:blob"]
    assert [bytes(row[0]) for row in rows if row] == recorded


def test_a_replayed_object_is_outlined_as_the_task_has_it(
    synthetic: ModuleType, content: dict[str, dict[str, list[object]]]
) -> None:
    cube = content["/replayed/planned/dynamic/objects/cube"]
    stamps = [stamp for stamp in cube["source_time"] if stamp is not None]
    assert min(stamps) == synthetic.EXECUTION_NS
    assert next(row[0] for row in cube["Transform3D:translation"] if row) == pytest.approx(
        [0.45, 0, 0.02]
    )
    assert len([row for row in cube["Boxes3D:half_sizes"] if row]) == 1
    red, green, blue = rgb("twin-planned")
    (color,) = next(row for row in cube["Boxes3D:colors"] if row)
    assert color == (red << 24 | green << 16 | blue << 8 | 255)


def test_events_and_verdicts_are_lines_of_text_at_their_instants(
    cell_run: RunFolder, content: dict[str, dict[str, list[object]]]
) -> None:
    recorded = events(Episode.open(cell_run.episodes()[0]))
    lines = content["/recorded/events"]
    assert sorted(lines["source_time"]) == sorted(event["stamp_ns"] for event in recorded)
    said = {": ".join(filter(None, event_words(event))) for event in recorded}
    assert {row[0] for row in lines["TextLog:text"]} == said
    assert content["/recorded/verdicts"]["TextLog:text"]


def test_what_is_not_shown_is_said_in_words(
    exported: Exported, content: dict[str, dict[str, list[object]]]
) -> None:
    assert sum("not in the robot description" in note for note in exported.notes) == 7
    text = content["/about"]["TextDocument:text"][0][0]
    assert "**Stand-in**" in text
    assert "real" not in text.replace("not from a real robot", "")
    assert all(note in text for note in exported.notes)


def test_an_episode_without_robot_cameras_or_run_is_still_exported(
    tmp_path: Path, cell_run: RunFolder
) -> None:
    path = tmp_path / "alone.mcap"
    with EpisodeWriter(path) as writer:
        writer.describe(EpisodeInfo(id="alone", kind="trial", task="no_such_task"))
        sample = at_positions(5, ("a",), np.zeros(1))
        writer.write(
            "/x/joint_states", sample.to_cdr(), type_name=schema.JOINT_STATE, log_time_ns=5
        )
    done = export_rrd(path, tmp_path / "alone.rrd", run_of(path))
    assert done.sides == ("recorded",)
    assert [note for note in done.notes if "robot is not drawn" in note]
    assert [note for note in done.notes if "no_such_task" in note]
    assert "/recorded/joints/a" in read_back(done.path)


def test_a_failed_export_leaves_no_file(
    cell_run: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        message = "on purpose"
        raise DashboardError(message)

    monkeypatch.setattr("dashboards.rerun_view.log_side", fail)
    with pytest.raises(DashboardError, match="on purpose"):
        export_rrd(cell_run.episodes()[0], tmp_path / "x.rrd", cell_run)
    assert list(tmp_path.iterdir()) == []


def test_the_drawn_robot_stands_on_base_link_whatever_is_above_it(tmp_path: Path) -> None:
    mesh = tmp_path / "part.stl"
    mesh.write_text(CUBE_STL)
    text = drawable(urdf(mesh))
    assert '"world"' not in text
    assert "collision" not in text
    assert text.count("<joint") == 1


@pytest.mark.parametrize("urdf_text", ["<robot", "<xacro/>", None])
def test_a_robot_that_cannot_be_drawn_is_a_note(
    urdf_text: str | None, cell_run: RunFolder, tmp_path: Path
) -> None:
    with RerunFile(tmp_path / "x.rrd", recording_id="x", name="x") as file:
        log_robot(file, urdf_text, "recorded", read_recording(cell_run.episodes()[0]))
    (note,) = file.notes
    assert "the robot is not drawn" in note


@pytest.mark.parametrize("name", ["panda", "kinova_j2s6s200"])
def test_any_robot_is_drawn_with_its_base_as_root(name: str, tmp_path: Path) -> None:
    pytest.importorskip("pinocchio")
    robot = read_robot(name)
    path = tmp_path / "robot.urdf"
    path.write_text(drawable(robot.description()))
    tree = UrdfTree.from_file_path(path)
    assert tree.root_link().name == robot.base_frame
    for joint in (*robot.joints, *robot.finger_joints):
        assert tree.get_joint_by_name(joint) is not None


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
def test_a_full_disk_is_one_clear_sentence_and_leaves_nothing(tmp_path: Path) -> None:
    out = tmp_path / "trial.rrd"
    out.with_name("trial.rrd.part").symlink_to("/dev/full")
    with (
        pytest.raises(DashboardError, match=r"cannot write .*trial\.rrd\.part: .*disk full"),
        RerunFile(out, recording_id="full", name="full") as file,
    ):
        file.always("about", rr.TextDocument("words" * 1000))
    assert list(tmp_path.iterdir()) == []


def test_every_view_of_the_layout_has_something_to_show(
    exported: Exported, content: dict[str, dict[str, list[object]]]
) -> None:
    reader = rc.RrdReader(exported.path)
    queries = [
        query
        for chunk in reader.stream(store=reader.blueprints()[0]).to_chunks()
        if str(chunk.entity_path).endswith("ViewContents")
        for query in chunk.to_record_batch().column("ViewContents:query").to_pylist()
    ]
    series = [query for query in queries if any("recorded" in line for line in query)]
    assert len(series) == 3
    for query in series:
        starts = [line.removeprefix("+ ").removesuffix("**") for line in query]
        assert any(entity.startswith(start) for entity in content for start in starts), query
