"""``robot-gst calibrate``: what it finds, what it writes, and what it says when it cannot."""

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from joint_samples import at_positions

import robot_gst
from bridge.episode import schema
from bridge.episode.cdr import messages
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from bridge.media.color import encode_png
from bridge.robots.default import ARM_JOINTS, ROBOT
from bridge.sources.standin.cell_file import load_cell
from bridge.sources.standin.render import Renderer
from bridge.sources.standin.surfaces import lab_surfaces
from twin.calibrate import cameras
from twin.calibrate.cameras import placement, recorded_pairs
from twin.calibrate.carried import find_carried_camera
from twin.calibrate.hand_eye import UndeterminedCameraError
from twin.robot.model import load_robot
from twin.scene.align.align import RobotNotAlignedError
from twin.scene.store.calibration import (
    UnreadableCalibrationError,
    calibrated_tree,
    read_calibration,
    write_calibration,
)

sys.path.insert(0, str(Path(__file__).parents[1] / "scene" / "align"))
import cell_views

URDF = ROBOT.urdf_text()
SECOND = 1_000_000_000
CAMERA = Camera(width=320, height=240, fx=300.0, fy=300.0, cx=160.0, cy=120.0)
T_TOOL_CAMERA = se3.transform_from(np.array([0.7, 0.1, 0.1, 0.7]), np.array([-0.09, 0.01, 0.02]))
T_BASE_TARGET = se3.transform_from(np.array([1.0, 0.0, 0.2, 0.0]), np.array([0.5, 0.1, 0.0]))


class Recording:
    """Writes an episode in which the robot stops at postures, for a second each."""

    def __init__(self, path: Path, postures: np.ndarray, kind: str = "probe") -> None:
        """Open the file and write description and joints."""
        self.path, self.postures = path, postures
        self.writer = EpisodeWriter(path)
        self.writer.describe(EpisodeInfo(id=path.stem, kind=kind, cell="c", stand_in=True))
        self.put("/robot_description", messages.string_to_cdr(URDF), schema.STRING, 1)
        for index, joints in enumerate(postures):
            for part in (-0.45, -0.2, 0.0, 0.2, 0.45):
                self.joints(joints, self.stamp(index) + round(part * SECOND))

    def stamp(self, index: int) -> int:
        """The middle of a stop."""
        return 2 * (index + 1) * SECOND

    def put(self, topic: str, data: bytes, type_name: str, stamp_ns: int) -> None:
        self.writer.write(topic, data, type_name=type_name, log_time_ns=stamp_ns)

    def joints(self, joints: np.ndarray, stamp_ns: int) -> None:
        for topic, names, values in (
            ("/c/joint_states", ARM_JOINTS, joints),
            ("/c/gripper/state", ("gripper_width",), np.array([0.06])),
        ):
            sample = at_positions(stamp_ns, tuple(names), values)
            self.put(topic, sample.to_cdr(), schema.JOINT_STATE, stamp_ns)

    def target(self, camera_id: str, T_camera_target: np.ndarray, stamp_ns: int) -> None:
        sample = messages.PoseSample(
            stamp_ns=stamp_ns, frame_id="cam", T_frame_body=T_camera_target
        )
        topic = f"/c/cam/{camera_id}/target/pose"
        self.put(topic, sample.to_cdr(), schema.POSE_STAMPED, stamp_ns)

    def depth(self, camera_id: str, depth_m: np.ndarray, stamp_ns: int) -> None:
        image = messages.DepthImage(
            stamp_ns=stamp_ns,
            frame_id=f"{camera_id}_optical",
            depth_mm=np.rint(depth_m * 1e3).astype(np.uint16),
        )
        self.put(f"/c/cam/{camera_id}/depth/image", image.to_cdr(), schema.IMAGE, stamp_ns)

    def color(self, camera_id: str, image: np.ndarray, stamp_ns: int) -> None:
        png = encode_png(np.rint(image * 255).astype(np.uint8))
        item = messages.CompressedColor(
            stamp_ns=stamp_ns, frame_id=f"{camera_id}_optical", format="png", data=png
        )
        topic = f"/c/cam/{camera_id}/color/image"
        self.put(topic, item.to_cdr(), schema.COMPRESSED_IMAGE, stamp_ns)

    def intrinsics(self, camera_id: str) -> None:
        info = messages.CameraInfo(stamp_ns=1, frame_id=f"{camera_id}_optical", camera=CAMERA)
        for stream in ("color", "depth"):
            self.put(f"/c/cam/{camera_id}/{stream}/info", info.to_cdr(), schema.CAMERA_INFO, 1)

    def transform(self, camera_id: str, T_base_camera: np.ndarray, stamp_ns: int) -> None:
        item = messages.FrameTransform(
            stamp_ns=stamp_ns,
            parent="base_link",
            child=f"{camera_id}_optical",
            T_parent_child=T_base_camera,
        )
        self.put("/tf", messages.transforms_to_cdr([item]), schema.TF_MESSAGE, stamp_ns)


def some_postures(count: int) -> np.ndarray:
    rng = np.random.default_rng(0)
    return np.array(cell_views.POSTURES[0]) + rng.uniform(-0.5, 0.5, (count, 6))


def record_targets(run: RunFolder, count: int = 12, more: Sequence[np.ndarray] = ()) -> Path:
    """A camera in the hand sees a target from several stops, and once on the move."""
    robot, rng = load_robot(URDF), np.random.default_rng(1)
    recording = Recording(run.episodes_dir / "probe_1.mcap", some_postures(count))
    for index, joints in enumerate(recording.postures):
        T_base_camera = robot.T_base_link("tool0", joints) @ T_TOOL_CAMERA
        for late in (0, 50_000_000, 100_000_000):
            noise = np.eye(4)
            noise[:3, 3] = rng.normal(size=3) * 5e-4
            seen = se3.invert(T_base_camera) @ T_BASE_TARGET @ noise
            recording.target("wrist", seen, recording.stamp(index) + late)
    for p_m in more:
        T = np.eye(4)
        T[:3, 3] = p_m
        recording.target("wrist", T, recording.stamp(0) + 10_000_000)
    recording.target("wrist", np.eye(4), recording.stamp(0) + SECOND)
    recording.writer.close()
    return recording.path


def calibrate(run: RunFolder, *arguments: str) -> int:
    return robot_gst.run(["calibrate", str(run.path), *arguments])


def test_a_target_seen_from_the_hand_gives_the_camera(
    run: RunFolder, capsys: pytest.CaptureFixture[str]
) -> None:
    record_targets(run)
    assert calibrate(run, "--cameras") == 0
    assert "residual" in capsys.readouterr().out
    found = read_calibration(run)
    assert found is not None
    place = found.cameras["wrist"]
    assert place.link == "tool0"
    assert np.linalg.norm(place.T_link_camera[:3, 3] - T_TOOL_CAMERA[:3, 3]) < 1e-3
    item = found.record["cameras"]["wrist"]
    assert item["mount"] == "hand"
    assert item["num_pairs"] == 12
    assert item["sources"] == ["probe_1"]
    assert item["residual_m"]["value"] < 1e-3


def test_detections_of_a_stop_are_averaged_without_what_is_no_number(run: RunFolder) -> None:
    """One would spoil the mean; and those on the move are left out."""
    path = record_targets(run, count=5, more=[np.array([np.nan, 0.0, 1.0])])
    pairs = recorded_pairs([Episode.open(path)], "wrist", "tool0")
    assert len(pairs.Ts_camera_target) == 5
    assert np.isfinite(pairs.Ts_camera_target).all()


def test_a_calibrated_camera_in_the_hand_follows_the_joints(run: RunFolder) -> None:
    recording = Recording(run.episodes_dir / "probe_1.mcap", some_postures(3))
    recording.intrinsics("wrist")
    recording.writer.close()
    pose = {"p_m": T_TOOL_CAMERA[:3, 3].tolist(), "q_wxyz": se3.split(T_TOOL_CAMERA)[0].tolist()}
    write_calibration(
        run, {"wrist": {"link": "tool0", "stream": "color", "T_link_camera": pose}}, {}
    )
    calibration = read_calibration(run)
    assert calibration is not None
    stamps = np.array([recording.stamp(index) for index in range(3)])
    episode = Episode.open(run.episodes()[0])
    tree = calibrated_tree(episode, "wrist", calibration.cameras["wrist"], stamps)
    for stamp, joints in zip(stamps, recording.postures, strict=True):
        expected = load_robot(URDF).T_base_link("tool0", joints) @ T_TOOL_CAMERA
        np.testing.assert_allclose(
            tree.T_root_frame("wrist_optical", int(stamp)), expected, atol=1e-9
        )


@pytest.mark.slow
@pytest.mark.parametrize("believed", [True, False])
def test_the_robot_seen_by_a_fixed_camera_gives_the_camera(run: RunFolder, believed: bool) -> None:
    recording = Recording(run.episodes_dir / "scan.mcap", np.array(cell_views.POSTURES[:2]))
    recording.intrinsics("side")
    errors = cell_views.CellErrors(depth_scale=1.01)
    for index, joints in enumerate(cell_views.POSTURES[:2]):
        depth_m = cell_views.take(joints, errors, seed=index)
        recording.depth("side", depth_m, recording.stamp(index))
    truth = cell_views.side_camera_pose()
    if believed:
        wrong = truth.copy()
        wrong[:3, 3] += (0.01, -0.02, 0.01)
        recording.transform("side", wrong, 1)
    recording.writer.close()
    assert calibrate(run, "--cameras") == 0
    found = read_calibration(run)
    assert found is not None
    change = se3.invert(truth) @ found.cameras["side"].T_link_camera
    assert np.linalg.norm(change[:3, 3]) < 0.003
    assert se3.rotation_angle_rad(change[:3, :3]) < 0.003
    assert found.cameras["side"].depth_scale == pytest.approx(1 / 1.01, abs=0.003)
    item = found.record["cameras"]["side"]
    assert (item["yaw_margin"] is None) == believed
    assert ("correction_m" in item) == believed


def test_the_search_begins_where_tf_believes_the_camera_also_below_a_world(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As the driver of a UR publishes it; without the belief the whole table is searched."""
    believed = se3.transform_from(np.array([0.9, 0.1, 0.0, 0.4]), np.array([0.7, -0.8, 0.6]))
    recording = Recording(run.episodes_dir / "scan.mcap", np.array(cell_views.POSTURES[:1]))
    recording.intrinsics("side")
    recording.depth("side", np.ones((240, 320)), recording.stamp(0))
    world = messages.FrameTransform(
        stamp_ns=1, parent="world", child="base_link", T_parent_child=T_BASE_TARGET
    )
    recording.put("/tf_static", messages.transforms_to_cdr([world]), schema.TF_MESSAGE, 1)
    recording.transform("side", believed, 1)
    recording.writer.close()
    begun: list[np.ndarray | None] = []

    def look(*_: object, start: np.ndarray | None = None, **__: object) -> None:
        begun.append(start)
        raise RobotNotAlignedError(found="nothing", hint="Look elsewhere.")

    monkeypatch.setattr(cameras, "align_robot", look)
    episodes = [Episode.open(path) for path in run.episodes()]
    with pytest.raises(RobotNotAlignedError):
        cameras.find_fixed_camera(episodes, "side", "base_link")
    first, whole_table = begun
    assert whole_table is None
    assert first is not None
    np.testing.assert_allclose(first, believed, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("is_off", [True, False])
def test_a_camera_in_the_hand_is_found_by_its_images_of_a_scan(
    run: RunFolder, is_off: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    """What is right already stays as it is."""
    robot, mount = load_robot(URDF), load_cell("standin").cameras["wrist"].T_parent_camera
    error = is_off * np.array([4, -6, 3, 2, -1, -2]) * 1e-3
    longer = 1 + is_off * 0.01
    rng = np.random.default_rng(3)
    read = np.array(cell_views.POSTURES[0]) + rng.uniform(-0.25, 0.25, (16, 6))
    recording = Recording(run.episodes_dir / "scan.mcap", read, "scan")
    recording.intrinsics("wrist")
    room, truths = Renderer(lab_surfaces(0)), []
    for index, joints in enumerate(read):
        truths.append(robot.T_base_link("tool0", joints) @ mount @ se3.small_motion(error))
        seen, stamp = room.render(CAMERA, truths[-1], {}), recording.stamp(index)
        recording.transform("wrist", robot.T_base_link("tool0", joints) @ mount, stamp)
        recording.color("wrist", seen.image.clip(0, 1), stamp)
        recording.depth("wrist", longer * np.nan_to_num(seen.depth_m, posinf=0), stamp)
    recording.writer.close()
    assert calibrate(run, "--cameras") == (0 if is_off else 2)
    if not is_off:
        assert "agree with its recorded place as well" in capsys.readouterr().err
        return
    calibration = read_calibration(run)
    assert calibration is not None
    place = calibration.cameras["wrist"]
    assert place.depth_scale == pytest.approx(1 / 1.01, abs=0.003)
    stamps = np.array([recording.stamp(index) for index in range(len(read))])
    tree = calibrated_tree(Episode.open(run.episodes()[0]), "wrist", place, stamps)
    found, true = tree.Ts_root_frame("wrist_optical", stamps), np.array(truths)
    left = se3.invert(se3.invert(found[:-1]) @ found[1:]) @ se3.invert(true[:-1]) @ true[1:]
    assert np.median(np.linalg.norm(left[:, :3, 3], axis=1)) < 5e-4
    assert np.median(se3.rotation_angle_rad(left[:, :3, :3])) < 1e-3


def test_two_images_of_a_scan_do_not_say_where_a_camera_sits(run: RunFolder) -> None:
    recording = Recording(run.episodes_dir / "scan.mcap", np.array(cell_views.POSTURES[:2]), "scan")
    recording.intrinsics("wrist")
    for index in range(2):
        stamp = recording.stamp(index)
        recording.transform("wrist", np.eye(4), stamp)
        recording.color("wrist", np.full((240, 320, 3), 0.5), stamp)
        recording.depth("wrist", np.ones((240, 320)), stamp)
    recording.writer.close()
    with pytest.raises(UndeterminedCameraError, match="too few of its images of scans meet"):
        find_carried_camera([Episode.open(run.episodes()[0])], "wrist", "tool0")


def test_a_run_without_data_says_what_is_missing(
    run: RunFolder, capsys: pytest.CaptureFixture[str]
) -> None:
    with EpisodeWriter(run.episodes_dir / "t.mcap") as writer:
        writer.describe(EpisodeInfo(id="t", kind="trial"))
    assert calibrate(run, "--cameras") == 2
    assert "target poses or depth images" in capsys.readouterr().err
    assert read_calibration(run) is None


def test_a_camera_that_moves_asks_for_target_poses(
    run: RunFolder, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = Recording(run.episodes_dir / "scan.mcap", some_postures(3))
    recording.intrinsics("wrist")
    for index in range(3):
        T = np.eye(4)
        T[0, 3] = 0.1 * index
        recording.transform("wrist", T, recording.stamp(index))
        recording.depth("wrist", np.ones((240, 320)), recording.stamp(index))
    recording.writer.close()
    assert placement([Episode.open(run.episodes()[0])]) == {"wrist": True}
    assert calibrate(run, "--cameras") == 2
    assert "cam/wrist/target/pose" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "found"),
    [
        ((), "say what to calibrate"),
        (("--physics", "--cameras"), "say what to calibrate"),
        (("--physics", "--workers", "0"), "--workers 0"),
        (("--cameras", "--pairs", "x.json"), "Unknown option: --pairs"),
        (("--cameras", "--camera", "front"), "camera front has neither"),
        (("--physics", "--evaluations", "9"), "Unknown option: --evaluations"),
    ],
)
def test_wrong_use_is_exit_code_two(
    run: RunFolder, arguments: tuple[str, ...], found: str, capsys: pytest.CaptureFixture[str]
) -> None:
    Recording(run.episodes_dir / "scan.mcap", some_postures(1)).writer.close()
    assert calibrate(run, *arguments) == 2
    assert found in capsys.readouterr().err


def place_record(link: str) -> dict[str, object]:
    pose = {"p_m": [0.0, 0.0, 0.0], "q_wxyz": [1.0, 0.0, 0.0, 0.0]}
    return {"link": link, "stream": "depth", "T_link_camera": pose}


def test_a_later_calibration_keeps_what_it_did_not_look_at(run: RunFolder) -> None:
    first = write_calibration(run, {"a": place_record("tool0")}, {"b": "not seen"})
    second = write_calibration(run, {"b": place_record("base_link")}, {"a": "not seen today"})
    assert set(second["cameras"]) == {"a", "b"}
    assert second["not_identified"] == {}
    assert first["calibration_id"] != second["calibration_id"]
    assert write_calibration(run, {}, {})["calibration_id"] == second["calibration_id"]


@pytest.mark.parametrize(
    "text", ["{", "[]", '{"schema_version": 9}', '{"schema_version": 1, "cameras": {"a": {}}}']
)
def test_a_damaged_calibration_is_refused(run: RunFolder, text: str) -> None:
    run.scene_dir.mkdir(parents=True)
    (run.scene_dir / "calibration.json").write_text(text)
    with pytest.raises(UnreadableCalibrationError, match=r"calibration\.json"):
        read_calibration(run)
