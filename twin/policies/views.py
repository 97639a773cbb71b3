"""What the cell's cameras see of the twin while a policy acts."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from bridge.episode import streams
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.geometry.camera import Camera
from twin.policies.cell import TwinCell
from twin.policies.errors import PolicyError
from twin.policies.mapping import fitting
from twin.policies.starts import Start
from twin.replay.images import Drawable, mounting, set_up
from twin.robot.model import load_robot
from twin.robot.posture import Posture
from twin.scene.frames.camera_poses import base_tree, calibrated_tree_at
from twin.scene.gaussians import GaussianCloud, concatenate
from twin.scene.raster.backend import open_rasteriser
from twin.scene.raster.rasteriser import View
from twin.scene.standpoint import sized_camera
from twin.scene.store.calibration import read_calibration

Pictures = Mapping[str, UInt8[np.ndarray, "height width 3"]]


@dataclass(frozen=True, kw_only=True)
class Viewpoint:
    """One camera: where it stands, or where it sits in the hand."""

    camera: Camera
    T_base_camera: Float[np.ndarray, "4 4"]
    """At the start; for good, where it stands still."""
    T_tcp_camera: Float[np.ndarray, "4 4"] | None = None

    def T(self, T_base_tcp: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
        """``T_base_camera`` with the hand at a pose."""
        if self.T_tcp_camera is not None:
            return np.asarray(T_base_tcp @ self.T_tcp_camera)
        return self.T_base_camera


class TwinCameras:
    """Draws a cell through the cameras that recorded one of its episodes."""

    def __init__(
        self,
        run: RunFolder,
        start: Start,
        cameras: Sequence[str] = (),
        sizes: Mapping[str, tuple[int, int]] | None = None,
    ) -> None:
        """Read the scene.

        Args:
            cameras: Ids; none: all that the episode has.
            sizes: Width and height in which the picture of a camera is to fit; others are drawn
                as they were recorded.
        """
        episode = Episode.open(start.episode_path)
        known = streams.camera_ids(episode)
        unknown = [name for name in cameras if name not in known]
        if unknown:
            raise PolicyError(
                f"no camera {', '.join(unknown)} in {episode.info.id}; it has: "
                f"{', '.join(known) or 'none'}"
            )
        self._drawable: Drawable = set_up(run, episode, start.scene)
        self._rasteriser = open_rasteriser()
        self._kept: tuple[bytes, GaussianCloud] | None = None
        self.viewpoints = {
            name: _viewpoint(run, episode, start, name, (sizes or {}).get(name))
            for name in cameras or known
        }

    def draw(self, cell: TwinCell) -> Pictures:
        """One picture for each camera."""
        joints_rad, width_m = cell.posture()
        posture = Posture(joints_rad=joints_rad, width_m=width_m)
        cloud = self._cloud(cell, posture)
        T_base_tcp = cell.robot.T_base_tcp(joints_rad)
        return {
            name: self._picture(cloud, place.camera, place.T(T_base_tcp))
            for name, place in self.viewpoints.items()
        }

    def _cloud(self, cell: TwinCell, posture: Posture) -> GaussianCloud:
        """Everything where it is now; what stood still is kept from the last picture."""
        places, nodes = cell.places(), cell.nodes_m()
        key = b"".join(T.round(6).tobytes() for T in places.values())
        key += b"".join(rows.tobytes() for rows in nodes.values())
        if self._kept is None or self._kept[0] != key:
            self._kept = key, self._drawable.at(places, nodes, None)
        rest, parts = self._kept[1], self._drawable.parts
        if not parts.links:
            return rest
        return concatenate([rest, parts.robot_at(posture, self._drawable.urdf)])

    def _picture(
        self, cloud: GaussianCloud, camera: Camera, T: Float[np.ndarray, "4 4"]
    ) -> UInt8[np.ndarray, "height width 3"]:
        """Colours alone: depth costs as much again, and no policy is sent it."""
        planes = self._rasteriser.draw_planes(cloud, camera, T)
        image = np.ascontiguousarray(np.moveaxis(planes[:3], 0, -1))
        view = View(image=image, depth_m=np.zeros_like(planes[4]), alpha=planes[4])
        backdrop = self._drawable.parts.backdrop
        if backdrop is not None:
            view = backdrop.behind(view, camera, T)
        return view.image_u8()


def _viewpoint(
    run: RunFolder, episode: Episode, start: Start, camera_id: str, size: tuple[int, int] | None
) -> Viewpoint:
    info = streams.camera_info(episode, camera_id)
    camera = info.camera if size is None else _fitted_in(info.camera, size)
    calibration, tree = read_calibration(run), base_tree(episode)
    place = None if calibration is None else calibration.cameras.get(camera_id)
    if place is not None:
        stamps_ns = np.array([start.stamp_ns], dtype=np.int64)
        tree = calibrated_tree_at(episode, camera_id, place, stamps_ns)
    robot = load_robot(start.scene.urdf)
    base = robot.record.base_frame
    if info.frame_id not in tree.frames() or tree.root_of(info.frame_id) != base:
        raise PolicyError(
            f"nobody recorded where camera {camera_id} was in {base}; calibrate it "
            "(robot-gst calibrate RUN --cameras) or leave it out"
        )
    return Viewpoint(
        camera=camera,
        T_base_camera=tree.T_root_frame(info.frame_id, start.stamp_ns),
        T_tcp_camera=mounting(episode, tree, info.frame_id, start.joints_rad, robot),
    )


def _fitted_in(camera: Camera, size: tuple[int, int]) -> Camera:
    """The same view, as large as fits."""
    width, height = fitting(camera.width, camera.height, size)
    return sized_camera(camera, f"{width}x{height}")
