"""What the recorded cameras would have seen of a replay: the rebuilt scene's Gaussians, moved.

The background stands still, links follow the replayed joints, rigid objects their replayed poses
and soft ones their nodes. An execution is seen from where the cameras were meanwhile. A plan is
seen by the fixed cameras, and by those in the hand from where its own hand would have carried them:
the recorded hand lags behind, and would get into their view.
Cameras that were calibrated are where the calibration has them, the others where ``/tf`` does.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from bridge.episode import streams
from bridge.episode.cdr.messages import CompressedColor, color_from_message
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.transforms import TransformTree
from bridge.geometry import se3
from bridge.media.color import encode_jpeg
from twin.replay.dynamics import soft_models
from twin.replay.result import ReplayResult
from twin.replay.scene import ReplayScene
from twin.robot.model import RobotModel, load_robot
from twin.robot.posture import Posture
from twin.scene.frames.camera_poses import base_tree, calibrated_tree_at
from twin.scene.gaussians import GaussianCloud
from twin.scene.movable_scene import MovableScene
from twin.scene.raster.backend import open_rasteriser
from twin.scene.skinning import Binding, bind, pose_cloud
from twin.scene.standpoint import carried_camera
from twin.scene.store.calibration import read_calibration, without_joints
from twin.scene.store.folder import read_scene
from twin.scene.trial import trial_parts

RATE_HZ = 5.0
"""Of the images of a plan that was never executed."""
MAX_IMAGES = 300
"""Per camera; more are thinned out evenly."""


@dataclass(frozen=True, kw_only=True)
class Drawable:
    """Everything that can be drawn, ready to be moved."""

    parts: MovableScene
    bindings: Mapping[str, Binding]
    """Of soft ones: which nodes carry which Gaussians."""
    urdf: str

    def at(
        self,
        Ts_base_object: Mapping[str, Float[np.ndarray, "4 4"]],
        nodes_m: Mapping[str, Float32[np.ndarray, "num_nodes 3"]],
        posture: Posture | None,
    ) -> GaussianCloud:
        """The scene in one state."""
        bent = {name: self.bent(name, nodes_m) for name in self.bindings if name in nodes_m}
        return self.parts.at(Ts_base_object, posture, self.urdf, bent)

    def bent(
        self, name: str, nodes_m: Mapping[str, Float32[np.ndarray, "num_nodes 3"]]
    ) -> GaussianCloud:
        """A soft object's Gaussians, where its nodes carry them."""
        return pose_cloud(self.parts.objects[name].cloud, self.bindings[name], nodes_m[name])


def render_replay(
    run: RunFolder,
    episode: Episode,
    result: ReplayResult,
    scene: ReplayScene,
    *,
    start_ns: int,  # source time that is the replay's time 0
    executed: bool,  # the plan was executed then: there are instants to compare with
    planned: bool,
) -> Iterator[tuple[str, CompressedColor]]:
    """Yield camera ids with JPEG images, stamped with source times."""
    stage = set_up(run, episode, scene)
    rasteriser, robot = open_rasteriser(), load_robot(scene.urdf)
    tree, calibration = base_tree(episode), read_calibration(run)
    places = {} if calibration is None else calibration.cameras
    for camera_id in streams.camera_ids(episode):
        info = streams.camera_info(episode, camera_id)
        stamps = _stamps(episode, camera_id, result, start_ns, executed=executed)
        seen, lost = tree, frozenset[int]()
        place, stamps_ns = places.get(camera_id), np.array(stamps, dtype=np.int64)
        if place is not None:  # objects were localised through it as it is mounted
            seen = calibrated_tree_at(episode, camera_id, place, stamps_ns)
            lost = without_joints(episode, place, stamps_ns)
        T_tcp_camera = (
            mounting(episode, seen, info.frame_id, result.joints_rad[0], robot) if planned else None
        )
        for stamp_ns in stamps:
            if T_tcp_camera is None and stamp_ns in lost:
                continue
            index = int(np.abs(result.stamps_ns - (stamp_ns - start_ns)).argmin())
            if T_tcp_camera is None:
                T = seen.T_root_frame(info.frame_id, stamp_ns)
            else:
                T = result.Ts_base_tcp[index] @ T_tcp_camera
            at = {n: Ts[index] for n, Ts in result.Ts_base_object.items()}
            nodes = {name: rows[index] for name, rows in result.nodes_m.items()}
            posture = Posture(joints_rad=result.joints_rad[index], width_m=result.width_m[index])
            cloud = stage.at(scene.Ts_base_object | at, nodes, posture)
            drawn = stage.parts.draw(rasteriser, cloud, info.camera, T)
            jpeg, name = encode_jpeg(drawn.marked_u8()), info.frame_id
            yield (
                camera_id,
                CompressedColor(stamp_ns=stamp_ns, frame_id=name, format="jpeg", data=jpeg),
            )


def set_up(run: RunFolder, episode: Episode, scene: ReplayScene) -> Drawable:
    """Read what a start shows."""
    parts, _ = trial_parts(run, read_scene(run), episode, scene.task, scene.Ts_base_object)
    soft = {name: body for name, body in soft_models(scene).items() if name in parts.objects}
    bindings = {
        name: bind(parts.objects[name].cloud.means_m, body.nodes_m)
        for name, body in soft.items()
        if len(parts.objects[name].cloud)
    }
    return Drawable(parts=parts, bindings=bindings, urdf=scene.urdf)


def _stamps(
    episode: Episode, camera_id: str, result: ReplayResult, start_ns: int, *, executed: bool
) -> list[int]:
    """When images were recorded during the replayed time, or a grid where none could be."""
    end_ns = start_ns + int(result.stamps_ns[-1])
    topic = streams.find_camera_topic(episode, camera_id, "color/image")
    if executed and topic is not None:
        found = (
            color_from_message(message.type_name, message.data).stamp_ns
            for message in episode.messages([topic])
        )
        stamps = [stamp_ns for stamp_ns in found if start_ns <= stamp_ns <= end_ns]
    else:
        stamps = np.arange(start_ns, end_ns, round(1e9 / RATE_HZ)).tolist()
    step = -(-len(stamps) // MAX_IMAGES) or 1
    return stamps[::step]


def mounting(
    episode: Episode,
    tree: TransformTree,
    frame_id: str,
    joints_rad: Float[np.ndarray, " num_joints"],
    robot: RobotModel,
) -> Float[np.ndarray, "4 4"] | None:
    """Where a camera sits in the hand, seen in any posture; None for one that stands still."""
    if tree.root_of(frame_id) != robot.record.base_frame:
        return None
    T = carried_camera(episode, frame_id, joints_rad, tree)
    return None if T is None else se3.invert(robot.T_base_tcp(joints_rad)) @ T
