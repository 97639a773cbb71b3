"""Lay one RGB-D image onto another, and say whether they then agree.

Open3D's hybrid photometric and geometric odometry (Park, Zhou, Koltun 2017).
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.episode.streams import RgbdFrame
from bridge.errors import MissingDependencyError
from bridge.geometry.camera import Camera
from twin.scene.frames.thumb import Thumb, colors_in_depth, meet, thumb_of


@dataclass(frozen=True, kw_only=True)
class TrackConfig:
    """How a camera is followed."""

    max_depth_m: float
    """Depth beyond is not used."""
    width_px: int = 320
    """Images are thinned to about this width."""
    depth_difference_m: float = 0.07
    """Pixels whose depths differ by more under the present guess are not the same point."""
    key_shift_m: float = 0.12
    key_turn_rad: float = 0.2
    """A camera that has come this far from its keyframe gets a new one."""
    min_overlap: float = 0.3
    min_agreement: float = 0.5
    min_likeness: float = 0.6
    """A pose is believed when two images meet and agree by these shares, and their brightness
    correlates: depth alone lets a plane slide along itself."""
    pyramid: tuple[int, ...] = (20, 20, 10, 5)
    """Iterations per level, the coarsest first."""
    loop_shift_m: float = 0.6
    loop_turn_rad: float = 0.6
    """Keyframes nearer to each other than both are tied."""
    max_loops: int = 30
    min_placed: float = 0.5
    """With a smaller share of frames placed, the camera counts as lost."""


@dataclass(frozen=True, kw_only=True)
class Step:
    """One image laid onto another."""

    T_target_source: Float[np.ndarray, "4 4"]
    information: Float[np.ndarray, "6 6"]
    score: float
    """Agreement of depth times likeness of brightness."""


@dataclass(frozen=True, kw_only=True)
class Look:
    """What is kept of one frame."""

    thumb: Thumb
    image: Any


class Aligner:
    """Lays one RGB-D image onto another."""

    def __init__(self, config: TrackConfig) -> None:
        """Load Open3D."""
        try:
            import open3d  # noqa: PLC0415  # heavy, and only scans without poses need it
        except ImportError as error:
            raise MissingDependencyError(
                package="open3d", extra="twin", purpose="following a camera without poses"
            ) from error
        self.config = config
        self.open3d: Any = open3d
        self._term = open3d.pipelines.odometry.RGBDOdometryJacobianFromHybridTerm()
        self._option = open3d.pipelines.odometry.OdometryOption(
            iteration_number_per_pyramid_level=open3d.utility.IntVector(config.pyramid),
            depth_diff_max=config.depth_difference_m,
            depth_min=0.05,
            depth_max=config.max_depth_m,
        )

    def look(self, frame: RgbdFrame) -> Look:
        """Thin a frame; colour is looked up for each depth pixel."""
        thumb = thumb_of(frame, self.config.width_px)
        step = round(frame.depth_camera.fx / thumb.camera.fx)
        colors = np.ascontiguousarray(colors_in_depth(frame, step))
        thumb = replace(thumb, grey=colors.mean(axis=2, dtype=np.float32))
        image = self.open3d.geometry.RGBDImage.create_from_color_and_depth(
            self.open3d.geometry.Image(colors),
            self.open3d.geometry.Image(np.ascontiguousarray(thumb.depth_m)),
            depth_scale=1.0,
            depth_trunc=self.config.max_depth_m,
            convert_rgb_to_intensity=True,
        )
        return Look(thumb=thumb, image=image)

    def lay(self, source: Look, target: Look, T_guess: Float[np.ndarray, "4 4"]) -> Step | None:
        """Lay one frame onto another, from a guess; None when they then disagree."""
        success, T, information = self.open3d.pipelines.odometry.compute_rgbd_odometry(
            source.image,
            target.image,
            self._pinhole(source.thumb.camera),
            T_guess,
            self._term,
            self._option,
        )
        T = np.array(T)
        if not success or not np.isfinite(T).all():
            return None
        met = meet(source.thumb, target.thumb, T)
        config = self.config
        if met.overlap < config.min_overlap or met.agreement < config.min_agreement:
            return None
        if met.likeness < config.min_likeness:
            return None
        score = met.agreement * met.likeness
        return Step(T_target_source=T, information=np.array(information), score=score)

    def _pinhole(self, camera: Camera) -> Any:
        fx, fy, cx, cy = camera.to_ros()
        return self.open3d.camera.PinholeCameraIntrinsic(
            camera.width, camera.height, fx, fy, cx, cy
        )
