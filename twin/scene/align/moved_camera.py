"""Cameras that were moved since the scan, found by what stands still before them.

The scene's background is drawn from where a camera's poses say it is. What the camera recorded is
laid onto that picture by depth and brightness together, as consecutive frames are in ``odometry``.
What differs by more than a bump explains, such as robot and objects, has no say.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.episode.streams import RgbdFrame
from bridge.geometry import se3
from twin.errors import TwinError
from twin.scene.frames.odometry import MIN_AGREEMENT, MIN_OVERLAP, Aligner, Look
from twin.scene.frames.rgbd import DepthLimits, FrameSurface
from twin.scene.gaussians import GaussianCloud
from twin.scene.raster.rasteriser import Rasteriser

MOVED_M, MOVED_RAD = 0.005, math.radians(0.5)
"""From here on a camera was moved; less is the scatter of poses and of this comparison."""
STANDS = 0.5
"""The first frame says enough where it differs by less than this share of that."""
BEYOND_M = (0.06, 0.02)
"""Depths that differ by more, in the first and in the second round, show another thing."""
LIMITS = DepthLimits(max_depth_m=5.0)


class MovedCameraError(TwinError):
    """A camera moved, and its poses do not say where to."""


@dataclass(frozen=True, kw_only=True)
class MovedCamera:
    """Where a camera is, seen from where its poses say it is."""

    T_posed_true: Float[np.ndarray, "4 4"] | None
    """Of its colour frame; None: it was moved, and its images do not say where to."""

    def to_record(self) -> dict[str, Any]:
        """What a localisation says of it."""
        T = self.T_posed_true
        return {"T_posed_true": None if T is None else se3.pose_record(T)}

    @staticmethod
    def from_record(record: Mapping[str, Any]) -> "MovedCamera":
        """Read what ``to_record`` gave."""
        T = record["T_posed_true"]
        return MovedCamera(T_posed_true=None if T is None else se3.pose_from_record(T))

    def describe(self, camera_id: str) -> str:
        """What happened to it."""
        T = self.T_posed_true
        if T is None:
            return (
                f"camera {camera_id} does not see the scene where it should, and what it sees does "
                "not say where it is: it was moved since the scan, or the furniture was. Put it "
                "back, or scan again"
            )
        shift_mm, turn = 1e3 * float(np.linalg.norm(T[:3, 3])), se3.rotation_angle_rad(T[:3, :3])
        return (
            f"camera {camera_id} was moved by {shift_mm:.0f} mm and {np.degrees(turn):.1f} degrees "
            "since the scan, or not calibrated: registered again by what stands still before it"
        )


def moved_camera(frames: Sequence[RgbdFrame], background: GaussianCloud) -> MovedCamera | None:
    """Compare a camera's still frames with the scene; None where it is as its poses say."""
    rasteriser, aligner = Rasteriser(), Aligner(LIMITS.max_depth_m)
    vectors, is_lost = [], False
    for frame in frames:
        T, found = np.eye(4), False
        for beyond_m in BEYOND_M:
            pair = _looks(frame, T, background, rasteriser, aligner, beyond_m)
            if pair.overlap < MIN_OVERLAP:
                break  # it looks where the scan did not
            step = aligner.lay(pair.recorded, pair.drawn, np.eye(4))
            if step is None:
                is_lost |= not found and pair.agreement < MIN_AGREEMENT
                break
            T, found = T @ step.T_target_source, True
        if found:
            vectors.append(np.concatenate([se3.vector_from_rotation(T[:3, :3]), T[:3, 3]]))
            if _size(vectors[0]) < STANDS:
                return None
    if not vectors:
        return MovedCamera(T_posed_true=None) if is_lost else None
    middle = np.median(vectors, axis=0)
    return MovedCamera(T_posed_true=se3.small_motion(middle)) if _size(middle) >= 1.0 else None


def _size(motion: Float[np.ndarray, "6"]) -> float:
    """Of a turn and a shift; from 1 on the camera was moved."""
    turn_rad, shift_m = (float(np.linalg.norm(part)) for part in (motion[:3], motion[3:]))
    return max(turn_rad / MOVED_RAD, shift_m / MOVED_M)


@dataclass(frozen=True, kw_only=True)
class _Pair:
    recorded: Look
    """Without what is no background."""
    drawn: Look
    overlap: float
    """Share of what was measured where the scene has a surface, too."""
    agreement: float
    """Share of that which is no more than so far apart."""


def _looks(
    frame: RgbdFrame,
    T_posed_true: Float[np.ndarray, "4 4"],
    background: GaussianCloud,
    rasteriser: Rasteriser,
    aligner: Aligner,
    beyond_m: float,
) -> _Pair:
    """What was recorded, and the scene from where the camera is thought to be."""
    camera, T = frame.color_camera, frame.T_base_color @ T_posed_true
    view = rasteriser.view(background, camera, T)
    recorded_m = FrameSurface(frame, LIMITS).depth_in_color_camera()
    both = (recorded_m > 0) & (view.depth_m > 0)
    other = both & (np.abs(recorded_m - view.depth_m) > beyond_m)
    overlap = float(both.sum() / max((recorded_m > 0).sum(), 1))
    recorded_m[other] = 0.0
    posed = replace(frame, depth_camera=camera, T_base_color=T, T_base_depth=T)
    return _Pair(
        recorded=aligner.look(replace(posed, depth_m=recorded_m)),
        drawn=aligner.look(replace(posed, depth_m=view.depth_m, image_u8=view.image_u8())),
        overlap=overlap,
        agreement=1.0 - float(other.sum() / max(both.sum(), 1)),
    )
