"""The Rerun file: Rerun itself reads it back, and its numbers are the episode's."""

import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import rerun.chunk as rc

import robot_gst
from bridge.episode import schema
from bridge.episode.metadata import Derived, EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.records import (
    CameraInfo,
    CompressedColor,
    DepthImage,
    FrameTransform,
    JointSample,
    PoseSample,
    string_to_cdr,
    transforms_to_cdr,
)
from bridge.episode.run import RunFolder
from bridge.episode.streams import joint_track
from bridge.episode.writer import EpisodeWriter
from bridge.errors import UsageError
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from bridge.media.color import encode_jpeg
from bridge.task.robot import ARM_JOINTS
from dashboards import rerun_viewer
from dashboards.errors import DashboardError
from dashboards.rerun_robot import drawable
from dashboards.rerun_scene import read_splats
from dashboards.rerun_view import Exported, export_rrd, run_of

CUBE_STL = """solid s
facet normal 0 0 1
outer loop
vertex 0 0 0
vertex 0.1 0 0
vertex 0 0.1 0
endloop
endfacet
endsolid s
"""
T_BASE_CAMERA = se3.look_at(np.array([1.0, 0.2, 0.8]), np.zeros(3), np.array([0.0, 0.0, 1.0]))
CAMERA = Camera(width=16, height=12, fx=20.0, fy=21.0, cx=8.25, cy=6.5)
SECOND_NS = 1_000_000_000


def urdf(mesh: Path) -> str:
    """A world above ``base_link``, one arm joint, a mesh and a box."""
    return f"""<robot name="two"><link name="world"/>
<joint name="fix" type="fixed"><parent link="world"/><child link="base_link"/>
<origin xyz="0 0 5"/></joint>
<link name="base_link"><visual><geometry><mesh filename="{mesh}"/></geometry></visual>
<collision><geometry><mesh filename="package://nowhere/x.stl"/></geometry></collision></link>
<joint name="{ARM_JOINTS[0]}" type="revolute"><parent link="base_link"/><child link="arm"/>
<axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
<link name="arm"><visual><geometry><box size="0.1 0.1 0.1"/></geometry></visual></link></robot>"""


@pytest.fixture(scope="module")
def cell_run(tmp_path_factory: pytest.TempPathFactory, synthetic: ModuleType) -> RunFolder:
    """One trial with camera, robot, truth, replays, a localisation and a scene of three splats."""
    folder = tmp_path_factory.mktemp("rerun")
    run = RunFolder.create(folder / "cell")
    mesh = folder / "part.stl"
    mesh.write_text(CUBE_STL)
    trial = synthetic.TRIALS[0]
    source = RunFolder.create(folder / "source")
    recorded = synthetic.write_trial(source, trial, images=False)
    path = run.episodes_dir / recorded.name
    with EpisodeWriter(path) as writer:
        opened = Episode.open(recorded)
        writer.describe(opened.info, outcome=opened.outcome)
        for message in opened.messages():
            writer.write(
                message.topic,
                message.data,
                type_name=message.type_name,
                log_time_ns=message.log_time_ns,
                publish_time_ns=message.publish_time_ns,
            )
        for topic, type_name, data, ns in extra(synthetic.START_NS, urdf(mesh)):
            writer.write(topic, data, type_name=type_name, log_time_ns=ns, publish_time_ns=ns)
    synthetic.write_replay(run, trial, "planned", False)
    synthetic.write_replay(run, trial, "executed", False)
    write_localised(run, trial.id, synthetic.START_NS)
    write_splats(run.scene_dir / "background.ply", 3)
    return run


def extra(start: int, description: str) -> list[tuple[str, str, bytes, int]]:
    """Two frames of a moving camera, the robot description, and truth nobody may show."""
    info = CameraInfo(stamp_ns=start, frame_id="hand_color_optical", camera=CAMERA)
    found = [
        ("/robot_description", schema.STRING, string_to_cdr(description), start),
        ("/standin/cam/hand/color/info", schema.CAMERA_INFO, info.to_cdr(), start),
        ("/standin/cam/hand/depth/info", schema.CAMERA_INFO, info.to_cdr(), start),
    ]
    for index in range(2):
        ns = start + index * SECOND_NS
        T = T_BASE_CAMERA.copy()
        T[0, 3] += 0.1 * index
        moved = FrameTransform(
            stamp_ns=ns, parent="base_link", child="hand_color_optical", T_parent_child=T
        )
        image = np.full((12, 16, 3), 60 * index, dtype=np.uint8)
        color = CompressedColor(
            stamp_ns=ns, frame_id="hand_color_optical", format="jpeg", data=encode_jpeg(image)
        )
        depth = DepthImage(
            stamp_ns=ns,
            frame_id="hand_color_optical",
            depth_mm=np.full((12, 16), 700 + index, dtype=np.uint16),
        )
        truth = PoseSample(stamp_ns=ns, frame_id="base_link", T_frame_body=np.eye(4))
        found += [
            ("/tf", schema.TF_MESSAGE, transforms_to_cdr([moved]), ns),
            ("/standin/cam/hand/color/image", schema.COMPRESSED_IMAGE, color.to_cdr(), ns),
            ("/standin/cam/hand/depth/image", schema.IMAGE, depth.to_cdr(), ns),
            (f"{schema.TRUTH_PREFIX}object/secret/pose", schema.POSE_STAMPED, truth.to_cdr(), ns),
        ]
    return found


def write_localised(run: RunFolder, episode: str, start: int) -> None:
    """Where the twin found the cube, and that it did not find the box."""
    pose = {"p_m": [0.4, 0.1, 0.02], "q_wxyz": [1.0, 0.0, 0.0, 0.0]}
    with EpisodeWriter(run.derived_dir / f"{episode}.localised.0a0b.mcap") as writer:
        writer.describe(
            EpisodeInfo(id=episode, kind="trial"),
            derived=Derived(kind="localised", source_episode=episode, source_sha256=""),
        )
        for name, T in (("cube", pose), ("box", None)):
            record = {
                "schema_version": 1,
                "stamp_ns": start,
                "object": name,
                "found": T is not None,
                "T_base_object": T,
                "covariance": None,
                "confidence": 0.5,
                "method": "test",
                "reason": None if T else "hidden",
            }
            writer.write_json(
                "/standin/localisation", record, type_name=schema.LOCALISATION, log_time_ns=start
            )


def write_splats(path: Path, count: int) -> None:
    """The n-th splat is at x = n with scale e^-n, half opaque, mid grey."""
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
    names += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    table = np.zeros((count, len(names)), dtype="<f4")
    table[:, 0] = np.arange(count)
    table[:, 10:13] = -np.arange(count)[:, None]
    table[:, 13] = 1.0
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    head += [f"property float {name}" for name in names] + ["end_header", ""]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes("\n".join(head).encode() + table.tobytes())


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


def test_the_newest_trial_is_found_beside_files_of_other_programs(tmp_path: Path) -> None:
    run = RunFolder.create(tmp_path / "run")
    with EpisodeWriter(run.episodes_dir / "a_trial.mcap") as writer:
        writer.describe(EpisodeInfo(id="a_trial", kind="trial"))
    with EpisodeWriter(run.episodes_dir / "foreign.mcap") as writer:
        writer.add_metadata("episode", {"who": "another program"})
    assert rerun_viewer.episode_of(run.path).stem == "a_trial"


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
        "/scene/background",
        "/localised/cube",
        "/recorded/cameras/hand/color",
        "/recorded/cameras/hand/depth",
        "/recorded/robot/visual_geometries/arm/visual_0",
        f"/recorded/robot_joints/{ARM_JOINTS[0]}",
        *(f"/recorded/joints/{name}" for name in ARM_JOINTS),
        *("/recorded/tcp", "/recorded/tcp_path", "/recorded/gripper_width_m", "/recorded/events"),
        *("/recorded/verdicts", "/recorded/stage"),
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


def test_a_replay_on_its_own_clock_starts_when_the_execution_did(
    synthetic: ModuleType, content: dict[str, dict[str, list[object]]]
) -> None:
    stamps = content["/replayed/planned/dynamic/clearance_m"]["source_time"]
    assert min(stamps) == synthetic.EXECUTION_NS
    assert np.diff(sorted(stamps)).min() == 50_000_000


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


def test_an_object_is_a_box_of_the_task_that_appears_with_its_first_pose(
    content: dict[str, dict[str, list[object]]],
) -> None:
    cube = content["/localised/cube"]
    assert [row for row in cube["Transform3D:translation"] if row] == [
        [pytest.approx([0.4, 0.1, 0.02])]
    ]
    assert len([row for row in cube["Boxes3D:half_sizes"] if row]) == 1
    assert None not in cube["source_time"]


def test_splats_are_given_as_rerun_wants_them(content: dict[str, dict[str, list[object]]]) -> None:
    splats = content["/scene/background"]
    np.testing.assert_allclose(
        splats["GaussianSplats3D:scales"][0], np.exp(-np.arange(3))[:, None].repeat(3, 1), rtol=1e-6
    )
    np.testing.assert_allclose(splats["GaussianSplats3D:quaternions"][0], [[0, 0, 0, 1]] * 3)
    assert splats["GaussianSplats3D:colors"][0] == [0x80808080] * 3


def test_what_is_not_shown_is_said_in_words(
    exported: Exported, content: dict[str, dict[str, list[object]]]
) -> None:
    assert any("'box' was not found" in note for note in exported.notes)
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
        sample = JointSample(
            stamp_ns=5, names=("a",), position=np.zeros(1), velocity=np.zeros(0), effort=np.zeros(0)
        )
        writer.write(
            "/x/joint_states", sample.to_cdr(), type_name=schema.JOINT_STATE, log_time_ns=5
        )
    done = export_rrd(path, tmp_path / "alone.rrd", run_of(path))
    assert done.sides == ("recorded",)
    assert [note for note in done.notes if "robot is not drawn" in note]
    assert [note for note in done.notes if "no_such_task" in note]
    assert "/recorded/joints/a" in read_back(done.path)


def test_a_replay_can_be_looked_at_alone(cell_run: RunFolder, tmp_path: Path) -> None:
    path = cell_run.derived("*.replay.executed.*")[0]
    done = export_rrd(path, tmp_path / "replay.rrd", run_of(path))
    assert done.sides == ("replayed/executed/dynamic",)
    assert not [note for note in done.notes if "label" in note]


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


def test_another_ending_than_rrd_is_refused(cell_run: RunFolder, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"should end in \.rrd"):
        export_rrd(cell_run.episodes()[0], tmp_path / "x.mcap")


@pytest.mark.parametrize(
    "damage", [b"ply\nformat ascii 1.0\nend_header\n", b"no ply", b"", "cut", "uchar"]
)
def test_a_file_that_is_no_splat_ply_is_refused(tmp_path: Path, damage: bytes | str) -> None:
    path = tmp_path / "background.ply"
    write_splats(path, 2)
    if damage == "cut":
        path.write_bytes(path.read_bytes()[:-4])
    elif damage == "uchar":
        path.write_bytes(path.read_bytes().replace(b"float nx", b"uchar nx"))
    else:
        path.write_bytes(bytes(damage))  # type: ignore[arg-type]
    with pytest.raises(DashboardError, match="robot-gst rebuild"):
        read_splats(path)


def test_the_drawn_robot_stands_on_base_link_whatever_is_above_it(tmp_path: Path) -> None:
    mesh = tmp_path / "part.stl"
    mesh.write_text(CUBE_STL)
    text = drawable(urdf(mesh))
    assert '"world"' not in text
    assert "collision" not in text
    assert text.count("<joint") == 1
    with pytest.raises(DashboardError, match="not XML"):
        drawable("<robot")
    with pytest.raises(DashboardError, match="root element <xacro>"):
        drawable("<xacro/>")


def test_view_without_a_display_writes_the_file_and_says_how_to_open_it(
    cell_run: RunFolder, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr(rerun_viewer, "open_window", lambda path: pytest.fail("opened a window"))
    assert robot_gst.run(["view", str(cell_run.path)]) == 0
    shown = capsys.readouterr()
    written = cell_run.derived_dir / "trial_0001.rrd"
    assert written.is_file()
    assert "No display here" in shown.err
    assert f"rerun --bind 127.0.0.1 --port auto {written}" in shown.err


def test_view_with_a_display_opens_the_file_it_wrote(
    cell_run: RunFolder, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    opened: list[Path] = []
    monkeypatch.setenv("DISPLAY", ":7")
    monkeypatch.setattr(rerun_viewer, "open_window", lambda path: opened.append(path) or 1)
    out = tmp_path / "x.rrd"
    assert robot_gst.run(["view", str(cell_run.episodes()[0]), "--out", str(out)]) == 0
    assert opened == [out]


def test_the_viewer_listens_on_the_loopback_address_only() -> None:
    arguments = rerun_viewer.viewer_arguments(Path("x.rrd"))
    assert arguments[arguments.index("--bind") + 1] == "127.0.0.1"


def test_a_run_without_episodes_and_a_missing_file_are_wrong_use(tmp_path: Path) -> None:
    assert robot_gst.run(["view", str(RunFolder.create(tmp_path / "empty").path)]) == 2
    assert robot_gst.run(["view", str(tmp_path / "nowhere")]) == 2


def test_the_newest_trial_of_a_run_is_shown_not_a_scan(cell_run: RunFolder) -> None:
    assert rerun_viewer.episode_of(cell_run.path).stem == "trial_0001"
