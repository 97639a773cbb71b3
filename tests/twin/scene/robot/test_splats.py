"""Laws of Gaussians bound to links, and of keeping the robot out of the background."""

from pathlib import Path

import numpy as np
import pytest
from joint_samples import at_positions
from scipy.spatial import cKDTree

from bridge.episode import schema
from bridge.episode.cdr.messages import string_to_cdr
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.streams import RgbdFrame
from bridge.episode.writer import EpisodeWriter
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from bridge.robots.default import ARM_JOINTS, ROBOT
from twin.robot.model import RobotDescriptionError, load_robot
from twin.robot.posture import Posture
from twin.robot.surface import PosedSurface, link_poses, sample_surface
from twin.scene.frames.rgbd import DepthLimits, FrameSurface, training_view
from twin.scene.gaussians import GaussianCloud, as_float32, moved_cloud
from twin.scene.robot.extraction import RobotFrames, robot_mask
from twin.scene.robot.splats import posed, read_links, write_links

URDF = ROBOT.urdf_text()
HOME = np.array([-0.26, -1.71, 1.37, -1.23, -1.57, 1.31])
AWAY = np.array([1.3, -1.30, 1.10, -1.60, -1.20, 0.40])
WIDTH_M = 0.04
CAMERA = Camera(width=320, height=240, fx=300.0, fy=300.0, cx=160.0, cy=120.0)
T_BASE_CAMERA = se3.look_at(
    np.array([1.3, -0.7, 1.0]), np.array([0.2, 0.1, 0.25]), np.array([0.0, 0.0, 1.0])
)


def cloud_at(means_m: np.ndarray, seed: int = 0, num_harmonics: int = 3) -> GaussianCloud:
    rng = np.random.default_rng(seed)
    count = len(means_m)
    return GaussianCloud(
        means_m=as_float32(means_m),
        quats_wxyz=as_float32(rng.normal(size=(count, 4))),
        scales_log=as_float32(rng.normal(-5, 0.2, (count, 3))),
        opacities_logit=as_float32(rng.normal(size=count)),
        colors=as_float32(rng.uniform(size=(count, 3))),
        harmonics=as_float32(rng.normal(size=(count, num_harmonics, 3))),
    )


@pytest.fixture(scope="module")
def skin() -> GaussianCloud:
    posture = Posture(joints_rad=HOME, width_m=WIDTH_M)
    return cloud_at(sample_surface(load_robot(URDF), posture, 3000, seed=1))


def bind(cloud: GaussianCloud) -> dict[str, GaussianCloud]:
    """Give each Gaussian to its nearest link at home, in the link's frame."""
    robot, posture = load_robot(URDF), Posture(joints_rad=HOME, width_m=WIDTH_M)
    surface = PosedSurface(robot, posture)
    nearest = surface.nearest(cloud.means_m.astype(np.float64)).link_ids
    links = np.array(surface.links)[nearest]
    return {
        link: moved_cloud(cloud.take(links == link), se3.invert(pose))
        for link, pose in link_poses(robot, posture).items()
        if (links == link).any()
    }


def in_order(cloud: GaussianCloud) -> np.ndarray:
    return np.lexsort(cloud.opacities_logit[None])


def rotations(cloud: GaussianCloud) -> np.ndarray:
    return se3.rotation_from_quaternion(cloud.quats_wxyz.astype(np.float64))


def test_posing_at_the_joints_of_binding_changes_nothing(skin: GaussianCloud) -> None:
    links = bind(skin)
    again = posed(links, Posture(joints_rad=HOME, width_m=WIDTH_M), URDF)
    a, b = skin.take(in_order(skin)), again.take(in_order(again))
    assert len(a) == len(b)
    np.testing.assert_allclose(a.means_m, b.means_m, atol=2e-6)
    np.testing.assert_allclose(rotations(a), rotations(b), atol=2e-6)
    np.testing.assert_allclose(a.harmonics, b.harmonics, atol=1e-5)
    np.testing.assert_array_equal(a.colors, b.colors)


def test_a_link_moves_exactly_as_forward_kinematics_says(skin: GaussianCloud) -> None:
    robot = load_robot(URDF)
    links = bind(skin)
    for link in ("forearm_link", "wrist_3_link", "gripper_left_finger"):
        before = posed({link: links[link]}, Posture(joints_rad=HOME, width_m=WIDTH_M), URDF)
        after = posed({link: links[link]}, Posture(joints_rad=AWAY, width_m=0.08), URDF)
        T = robot.T_base_link(link, AWAY, 0.08) @ se3.invert(robot.T_base_link(link, HOME, WIDTH_M))
        expected = se3.apply(T, before.means_m.astype(np.float64))
        np.testing.assert_allclose(after.means_m, expected, atol=3e-6)
        np.testing.assert_allclose(rotations(after), T[:3, :3] @ rotations(before), atol=3e-6)
        np.testing.assert_array_equal(after.scales_log, before.scales_log)


def test_an_unknown_link_lists_those_that_exist(skin: GaussianCloud) -> None:
    with pytest.raises(RobotDescriptionError, match="forearm_link"):
        posed({"tentacle": skin}, Posture(joints_rad=HOME), URDF)


def test_links_survive_the_disk_and_stale_ones_go(skin: GaussianCloud, tmp_path: Path) -> None:
    run = RunFolder.create(tmp_path / "run")
    links = bind(skin)
    write_links(run, {"old_link": skin})
    record = {"robot": {"links": write_links(run, links)}}
    assert not (run.scene_dir / "robot" / "old_link.ply").exists()
    loaded = read_links(run, record)
    assert set(loaded) == set(links)
    for link, cloud in loaded.items():
        np.testing.assert_array_equal(cloud.means_m, links[link].means_m)
        assert record["robot"]["links"][link]["num_splats"] == len(cloud)


def room_depth(T_base_camera: np.ndarray) -> np.ndarray:
    """Depth of the table z = 0 along every ray, at most 3 m."""
    rays = CAMERA.rays() @ T_base_camera[:3, :3].T
    with np.errstate(divide="ignore"):
        depth = -T_base_camera[2, 3] / rays[..., 2]
    return np.where((depth > 0) & (depth < 3.0), depth, 3.0)


def frame_at(joints: np.ndarray, stamp_ns: int) -> RgbdFrame:
    """The robot, red, over a green table."""
    surface = PosedSurface(load_robot(URDF), Posture(joints_rad=joints, width_m=WIDTH_M))
    table, arm = room_depth(T_BASE_CAMERA), surface.depth_along(CAMERA.rays(), T_BASE_CAMERA)
    image = np.where((arm < table)[..., None], [200, 20, 20], [20, 200, 20]).astype(np.uint8)
    return RgbdFrame(
        camera_id="side",
        stamp_ns=stamp_ns,
        image_u8=image,
        depth_m=np.minimum(table, arm).astype(np.float32),
        color_camera=CAMERA,
        depth_camera=CAMERA,
        T_base_color=T_BASE_CAMERA,
        T_base_depth=T_BASE_CAMERA,
    )


SECOND = 1_000_000_000


@pytest.fixture(scope="module")
def episode(tmp_path_factory: pytest.TempPathFactory) -> Episode:
    """Joint states only: at HOME around second 1, at AWAY around second 3, on the way between."""
    path = tmp_path_factory.mktemp("episode") / "scan.mcap"
    with EpisodeWriter(path) as writer:
        writer.describe(EpisodeInfo(id="scan", kind="scan", stand_in=True))
        writer.write(
            "/robot_description", string_to_cdr(URDF), type_name=schema.STRING, log_time_ns=1
        )
        for tenth in range(45):
            share = np.clip((tenth / 10 - 1.5) / 1.0, 0, 1)
            for topic, names, values in (
                ("/c/joint_states", ARM_JOINTS, HOME + share * (AWAY - HOME)),
                ("/c/gripper/state", ("gripper_width",), np.array([WIDTH_M])),
            ):
                sample = at_positions(tenth * SECOND // 10, tuple(names), values)
                writer.write(
                    topic,
                    sample.to_cdr(),
                    type_name=schema.JOINT_STATE,
                    log_time_ns=tenth * SECOND // 10,
                )
    return Episode.open(path)


def test_the_robot_never_enters_the_background_and_its_hole_is_filled(episode: Episode) -> None:
    frames = RobotFrames([episode])
    assert frames.remark == ""
    limits = DepthLimits(max_depth_m=2.5, flying_fraction=0.1)
    kept, masks = [], []
    for joints, stamp in ((HOME, SECOND), (AWAY, 3 * SECOND)):
        surface = FrameSurface(frame_at(joints, stamp), limits)
        points, view = frames.take_out(
            episode, surface.frame, surface.points(), training_view(surface)
        )
        red = points.colors[:, 0] > 0.5
        assert not (red & (points.p_m[:, 2] > 0.02)).any()
        shows_arm = view.full.planes_u8[0] > 100
        assert not view.full.static_mask[shows_arm].any()
        assert not view.full.depth_m[shows_arm].any()
        assert view.full.static_mask.mean() > 0.6
        kept.append(points.p_m)
        masks.append(view.full.static_mask)
    hidden = ~masks[0] & masks[1]
    assert hidden.sum() > 500  # what one posture hid and the other shows
    table = np.concatenate([p[np.abs(p[:, 2]) < 0.003] for p in kept])
    where = se3.apply(T_BASE_CAMERA, CAMERA.unproject(room_depth(T_BASE_CAMERA)))[hidden]
    on_table = where[np.abs(where[:, 2]) < 1e-6]
    gap, _ = cKDTree(table[:, :2]).query(on_table[:, :2])
    assert np.median(gap) < 0.01


def test_links_are_collected_over_postures_in_their_own_frames(episode: Episode) -> None:
    frames = RobotFrames([episode])
    limits = DepthLimits(max_depth_m=2.5, flying_fraction=0.1)
    for joints, stamp in ((HOME, SECOND), (AWAY, 3 * SECOND)):
        surface = FrameSurface(frame_at(joints, stamp), limits)
        frames.take_out(episode, surface.frame, surface.points(), training_view(surface))
    links = frames.links(8000).clouds
    assert {"upper_arm_link", "forearm_link"} <= set(links)
    robot = load_robot(URDF)
    third = HOME + 0.4 * (AWAY - HOME)
    cloud = posed(links, Posture(joints_rad=third, width_m=WIDTH_M), URDF)
    surface = PosedSurface(robot, Posture(joints_rad=third, width_m=WIDTH_M))
    assert np.quantile(surface.nearest(cloud.means_m.astype(np.float64)).distance_m, 0.9) < 0.006
    assert np.median(cloud.colors[:, 0]) > 0.6


def test_the_table_around_the_base_stays_in_the_background(episode: Episode) -> None:
    frames = RobotFrames([episode])
    surface = FrameSurface(
        frame_at(HOME, SECOND), DepthLimits(max_depth_m=2.5, flying_fraction=0.1)
    )
    points, _ = frames.take_out(episode, surface.frame, surface.points(), training_view(surface))
    whole = surface.points()

    def around(p_m: np.ndarray) -> int:
        radius = np.hypot(p_m[:, 0], p_m[:, 1])
        return int(((np.abs(p_m[:, 2]) < 0.002) & (radius < 0.2)).sum())

    assert around(points.p_m) > 0.8 * around(whole.p_m)


def test_what_stands_in_front_of_the_robot_is_not_masked() -> None:
    surface = PosedSurface(load_robot(URDF), Posture(joints_rad=HOME, width_m=WIDTH_M))
    arm = surface.depth_along(CAMERA.rays(), T_BASE_CAMERA)
    depth = np.where(np.isfinite(arm), arm - 0.2, 2.0)
    assert not robot_mask(surface, CAMERA, T_BASE_CAMERA, depth).any()
    assert robot_mask(surface, CAMERA, T_BASE_CAMERA, np.zeros_like(depth)).any()


def test_an_episode_without_joints_is_passed_over_with_a_remark(tmp_path: Path) -> None:
    path = tmp_path / "bare.mcap"
    with EpisodeWriter(path) as writer:
        writer.describe(EpisodeInfo(id="bare", kind="scan"))
    bare = Episode.open(path)
    frames = RobotFrames([bare])
    assert "bare" in frames.remark
    item = FrameSurface(frame_at(HOME, SECOND), DepthLimits(max_depth_m=2.5, flying_fraction=0.1))
    points, view = item.points(), training_view(item)
    same_points, same_view = frames.take_out(bare, item.frame, points, view)
    assert same_points is points
    assert same_view is view
    assert frames.links(60_000).clouds == {}
