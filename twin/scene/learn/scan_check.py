"""What can be wrong with a scan, each in one sentence, before time goes into a fit."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from twin.errors import TwinError
from twin.scene.frames.choice import FrameChoice
from twin.scene.frames.points import NEAR_M
from twin.scene.frames.thumb import Thumb
from twin.scene.learn.between_cameras import check_between
from twin.scene.learn.pose_check import (
    STILL_AGREEMENT,
    MovedCameraError,
    PoseConventionError,
    check_poses,
    still_agreement,
)
from twin.scene.learn.pose_report import GOOD, PoseReport
from twin.scene.settings import FrameConfig

FEW_FRAMES = 5
"""With fewer training frames of all cameras together, much was seen once or never."""
SPARSE = 0.02
"""With a smaller share of trusted pixels a camera contributes next to nothing."""
MUCH_MOVED = 0.3
"""More of the surface than this is rarely only a robot's arm."""


class NoDepthError(TwinError):
    """No depth image holds anything usable."""


@dataclass(frozen=True, kw_only=True)
class CameraCheck:
    """What one camera's training frames showed."""

    choice: FrameChoice
    thumbs: Sequence[Thumb]
    trusted: Sequence[float]
    """Share of trusted depth pixels of each frame."""

    @property
    def name(self) -> str:
        """The camera, as a sentence begins with it."""
        return f"camera {self.choice.camera_id} of episode {self.choice.episode.info.id}"


@dataclass(frozen=True, kw_only=True)
class ScanReport:
    """What is to be said about a scan; ``scene.json`` keeps it."""

    poses: Mapping[str, PoseReport]
    """By camera; one that stands still is compared with those that move, where there are any."""
    found: tuple[str, ...]
    """Sentences about what is wrong."""
    moving_fraction: float = 0.0
    """Share of the measured surface that other frames look through."""
    carried: Mapping[str, float] = field(default_factory=dict)
    """By camera without joints: share of its image that moves with it."""

    def remarks(self) -> list[str]:
        """All sentences, that about motion included."""
        found = list(self.found)
        for name, share in self.carried.items():
            found.append(
                f"{100 * share:.0f} % of the image of {name} moves with the camera, as a gripper "
                "before it does, and was left out"
            )
        if self.moving_fraction < MUCH_MOVED:
            return found
        return [
            *found,
            f"{100 * self.moving_fraction:.0f} % of the measured surface moved during the scan and "
            "was left out; scan while nothing but the camera moves, or check the poses",
        ]

    def to_record(self) -> dict[str, Any]:
        """What ``scene.json`` says."""
        return {
            "remarks": self.remarks(),
            "moving_fraction": self.moving_fraction,
            "carried_fraction": {name: round(share, 4) for name, share in self.carried.items()},
            "pose_agreement": {
                name: None if report.agreement is None else round(report.agreement, 4)
                for name, report in self.poses.items()
            },
        }


def check_scan(cameras: Sequence[CameraCheck], config: FrameConfig) -> ScanReport:
    """Look for what makes a scan useless, or worth less than it seems.

    Raises:
        NoDepthError: When no camera has depth images that can be used.
        PoseConventionError: When a camera's poses fit only if read in another convention.
        MovedCameraError: When a camera moved that is said to stand still.
    """
    seen = [camera for camera in cameras if camera.thumbs]
    blind = [camera for camera in seen if max(camera.trusted) < SPARSE]
    usable = [camera for camera in seen if max(camera.trusted) >= SPARSE]
    if blind and not usable:
        raise NoDepthError(_no_depth(blind[0], config))
    moved = _still_cameras(usable, refuse=config.check_poses)
    poses = _pose_reports(usable)
    for name, report in poses.items():
        if report.better is not None and config.check_poses:
            message = (
                f"the poses of {name} are wrong: {report.remark()}. Record or import it again, or "
                "rebuild with --no-check-poses."
            )
            raise PoseConventionError(message)
    found = [_no_depth(camera, config) for camera in blind] + moved
    found += [f"{name}: {report.remark()}" for name, report in poses.items() if report.remark()]
    still = [camera.name for camera in usable if camera.choice.still]
    if any(name in poses and not poses[name].fits for name in still):
        found.append("robot-gst calibrate RUN --cameras finds where cameras are that stand still")
    total = sum(len(camera.thumbs) for camera in seen)
    if total < FEW_FRAMES:
        found.append(
            f"only {total} training frame{'s' if total > 1 else ''}: the scene holds what "
            f"{'they' if total > 1 else 'it'} saw and is likely to be wrong from elsewhere; scan "
            "longer"
        )
    return ScanReport(poses=poses, found=tuple(found))


def _pose_reports(usable: Sequence[CameraCheck]) -> dict[str, PoseReport]:
    """Judge moving cameras by themselves, and the others by moving ones that can be believed."""
    poses = {
        camera.name: check_poses(camera.thumbs) for camera in usable if not camera.choice.still
    }
    sure = [camera for camera in usable if camera.name in poses and poses[camera.name].is_sure]
    others = [thumb for camera in sure for thumb in camera.thumbs]
    for camera in usable:
        if camera.choice.still:
            report = check_between(camera.thumbs, others)
            if report.agreement is not None:  # else it looks at another place
                poses[camera.name] = report
    return poses


def _still_cameras(usable: Sequence[CameraCheck], *, refuse: bool) -> list[str]:
    """Say which cameras moved although their poses do not.

    Raises:
        MovedCameraError: When one did beyond doubt, and that is to be refused.
    """
    found = []
    for camera in usable:
        agreement = still_agreement(camera.thumbs) if camera.choice.still else None
        if agreement is None or agreement >= STILL_AGREEMENT:
            continue
        about = (
            f"{camera.name} stands still by its poses, but only {100 * agreement:.0f} % of its "
            "depth is the same from image to image: "
        )
        if agreement >= GOOD:
            about += "much moved before it, or it moved itself and nobody recorded how"
        else:
            about += (
                "it was moved, or nobody recorded how it moves. Rebuild with --poses odometry, "
                "record its poses, or insist with --no-check-poses"
            )
            if refuse:
                raise MovedCameraError(f"{about}.")
        found.append(about)
    return found


def _no_depth(camera: CameraCheck, config: FrameConfig) -> str:
    """Say why a camera's depth is not usable."""
    values = np.concatenate([thumb.depth_m[thumb.depth_m > 0] for thumb in camera.thumbs])
    if len(values) == 0:
        return f"{camera.name} measured no depth at all: every pixel is 0 or not a number"
    median = float(np.median(values))
    if median > config.max_depth_m:
        return (
            f"{camera.name} measured depth around {median:.3g} m, beyond --max-depth-m "
            f"{config.max_depth_m:g}: check the unit of depth, or raise the limit"
        )
    if median < NEAR_M:
        return (
            f"{camera.name} measured depth around {1e3 * median:.3g} mm, nearer than any surface "
            f"can be ({1e3 * NEAR_M:.0f} mm): check the unit of depth"
        )
    share = 100 * max(camera.trusted)
    return (
        f"at most {share:.2g} % of the depth pixels of {camera.name} are usable: measurements "
        "without measured neighbours, or that jump, are not trusted"
    )
