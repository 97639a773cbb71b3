"""Checks of a scan before time goes into a fit: pose conventions, moved cameras, unusable depth.

Points of one depth image are carried into another by the recorded poses. Where both cameras see the
same surface the depths must be equal; with a pose read in the wrong convention they are not. Images
of a stationary camera say nothing of its pose, because they agree whatever it is: what a moving
camera measured is carried into them instead.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, product

import numpy as np
from jaxtyping import Float

from bridge.geometry import se3
from twin.errors import TwinError
from twin.scene.align.moved_camera import MovedCameraError
from twin.scene.frames.downscaled import DownscaledDepth, Meeting, meet
from twin.scene.frames.pairing import name_of
from twin.scene.frames.rgbd import NEAR_M
from twin.scene.frames.selection import FrameChoice, spread
from twin.scene.settings import FrameConfig

FLIP_YZ = np.diag([1.0, -1.0, -1.0, 1.0])
BODY_AXES = np.array(
    [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
"""``T_body_optical`` of ROS: body x forward, y left, z up; optical z forward, x right, y down."""
ORDERS = {
    "": (0, 1, 2, 3),
    "quaternions written as w x y z were read as x y z w": (1, 2, 3, 0),
    "quaternions written as x y z w were read as w x y z": (3, 0, 1, 2),
}
"""Where the true w, x, y, z are found in the w, x, y, z that were read."""
AXES = {
    "": np.eye(4),
    "the camera looks along -z with y up (OpenGL axes)": FLIP_YZ,
    "the images are upside down": np.diag([-1.0, -1.0, 1.0, 1.0]),
    "the camera frame is a body frame (x forward, y left, z up)": BODY_AXES,
}


@dataclass(frozen=True, kw_only=True)
class Convention:
    """One way of reading poses."""

    order: str = ""
    inverse: bool = False
    axes: str = ""

    def describe(self) -> str:
        """Say what differs from our own reading."""
        parts = [self.order, self.axes]
        if self.inverse:
            parts.append("they are world-to-camera, not camera-to-world")
        return " and ".join(part for part in parts if part) or "as recorded"

    def read(self, T_as_read: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
        """Turn a pose as we read it into ``T_base_camera`` as this convention means it."""
        q, p = se3.split(T_as_read)
        T = se3.transform_from(q[list(ORDERS[self.order])], p)
        return np.asarray((se3.invert(T) if self.inverse else T) @ AXES[self.axes])


OTHER_POSES = tuple(
    Convention(order=order, inverse=inverse, axes=axes)
    for order, inverse, axes in product(ORDERS, (False, True), AXES)
)[1:]
"""Every other way of reading poses; the first of all is our own."""


GOOD = 0.5
"""With this share of the overlap agreeing, poses and depth belong together."""
BETTER = 0.12
"""Another reading must let so much more of the depth agree."""
MIN_OVERLAP = 0.05
"""With less, depth says nothing about the poses."""
SOLID_OVERLAP = 0.2
"""Frames near in time overlap at least by this much if their poses are read rightly."""


@dataclass(frozen=True, kw_only=True)
class PoseReport:
    """What the depth says about the poses of one camera."""

    num_pairs: int
    """Pairs of frames between which the camera visibly moved; 0: nothing could be checked."""
    agreement: float | None
    """Share of the overlapping depth that agrees under the recorded poses."""
    overlap: float
    """Share of a frame's measurements that another frame sees too; mean over pairs."""
    better: Convention | None = None
    better_agreement: float | None = None
    """A convention under which they clearly fit, where the recorded one does not."""

    @property
    def fits(self) -> bool:
        """Whether the recorded poses are consistent with the depth."""
        return self.agreement is None or self.agreement >= GOOD

    @property
    def is_sure(self) -> bool:
        """Whether depth was there to judge them by, and they fit."""
        return self.agreement is not None and self.fits

    def remark(self) -> str:
        """What is wrong; empty when nothing is."""
        if self.better is not None and self.better_agreement is not None:
            return (
                f"only {100 * (self.agreement or 0.0):.0f} % of the depth agrees between views, "
                f"but {100 * self.better_agreement:.0f} % would under another reading: "
                f"{self.better.describe()}"
            )
        if self.agreement is not None and not self.fits:
            return (
                f"only {100 * self.agreement:.0f} % of the depth agrees between views, and no "
                "known convention makes it better: wrong poses, clocks that differ, or a scene "
                "that moved"
            )
        if self.num_pairs and self.overlap < MIN_OVERLAP:
            return "its views hardly overlap: poses cannot be checked, and edges will not meet"
        return ""


def judged(
    plain: PoseReport, recorded: Meeting, better: Convention, agreement: float
) -> PoseReport:
    """The report on poses as recorded, with another reading where that is clearly better."""
    if agreement < GOOD or agreement < (plain.agreement or 0.0) + BETTER:
        return plain
    return replace(plain, agreement=recorded.agreement, better=better, better_agreement=agreement)


def mean_of(met: Sequence[Meeting]) -> Meeting:
    """Agreement and overlap of all that was compared, at least one; it counts by its overlap."""
    total = sum(item.overlap for item in met)
    agreed = sum(item.agreement * item.overlap for item in met)
    return Meeting(agreement=agreed / total if total > 0 else 0.0, overlap=total / len(met))


def plain_report(num_pairs: int, recorded: Meeting) -> PoseReport:
    """Report on poses as they were recorded; no agreement where views hardly overlap."""
    return PoseReport(
        num_pairs=num_pairs,
        agreement=recorded.agreement if recorded.overlap >= MIN_OVERLAP else None,
        overlap=recorded.overlap,
    )


def best_of(
    conventions: Iterable[Convention], score: Callable[[Convention], Meeting]
) -> tuple[Convention, float]:
    """The convention under which most depth agrees, and how much; 0 without solid overlap."""
    scored = []
    for convention in conventions:
        met = score(convention)
        scored.append((convention, met.agreement if met.overlap >= SOLID_OVERLAP else 0.0))
    return max(scored, key=lambda item: item[1])


MAX_PAIRS = 10
GAPS = (1, 2, 4, 8, 16)
"""Pairs are this many training frames apart."""
STATIONARY_AGREEMENT = 0.7
"""Where this much agrees without any motion, the camera hardly moved and poses say nothing."""


class PoseConventionError(TwinError):
    """Poses fit the depth only when they are read in another way."""


def check_poses(images: Sequence[DownscaledDepth]) -> PoseReport:
    """Carry depth between frames of one camera under every convention."""
    pairs = list(_informative(images))
    if not pairs:
        return PoseReport(num_pairs=0, agreement=None, overlap=0.0)
    recorded = _score(pairs, Convention())
    plain = plain_report(len(pairs), recorded)
    better, score = best_of(OTHER_POSES, lambda convention: _score(pairs, convention))
    return judged(plain, recorded, better, score)


def _score(pairs: list[tuple[DownscaledDepth, DownscaledDepth]], convention: Convention) -> Meeting:
    met = []
    for first, second in pairs:
        T_base_first, T_base_second = (
            convention.read(image.T_base_depth) for image in (first, second)
        )
        met.append(meet(first, second, se3.invert(T_base_second) @ T_base_first))
    return mean_of(met)


def _informative(
    images: Sequence[DownscaledDepth],
) -> Iterator[tuple[DownscaledDepth, DownscaledDepth]]:
    """Pairs of frames whose images show that the camera moved; both directions of time alike."""
    found = 0
    for gap in GAPS:
        starts = range(0, len(images) - gap, max(1, (len(images) - gap) // MAX_PAIRS))
        for start in starts:
            first, second = images[start], images[start + gap]
            met = meet(first, second, np.eye(4))
            if not first.depth_m.any() or not second.depth_m.any():
                continue
            if met.agreement < STATIONARY_AGREEMENT:
                yield first, second
                found += 1
        if found >= MAX_PAIRS:
            return


MAX_OTHERS = 12
"""Images of other cameras that are carried over."""


def check_between(own: Sequence[DownscaledDepth], others: Sequence[DownscaledDepth]) -> PoseReport:
    """Carry the depth of moving cameras into one that stands still, however its pose is read.

    Returns:
        No agreement when there is nothing to compare with, or when no reading of its pose lets the
        camera see what the others saw: it may look at another place.
    """
    first = next((image for image in own if image.depth_m.any()), None)
    chosen = [others[index] for index in spread(np.arange(len(others)), MAX_OTHERS)]
    if first is None or not chosen:
        return PoseReport(num_pairs=0, agreement=None, overlap=0.0)
    T_base_first = first.T_base_depth
    recorded = _seen_alike(first, chosen, T_base_first)
    plain = plain_report(len(chosen), recorded)
    if plain.is_sure:
        return plain
    better, score = best_of(
        OTHER_POSES, lambda reading: _seen_alike(first, chosen, reading.read(T_base_first))
    )
    return judged(plain, recorded, better, score)


def _seen_alike(
    own: DownscaledDepth, others: Sequence[DownscaledDepth], T_base_own: Float[np.ndarray, "4 4"]
) -> Meeting:
    T_own_base = se3.invert(T_base_own)
    return mean_of([meet(other, own, T_own_base @ other.T_base_depth) for other in others])


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
    images: Sequence[DownscaledDepth]
    trusted: Sequence[float]
    """Share of trusted depth pixels of each frame."""

    @property
    def name(self) -> str:
        """The camera, as messages begin with it."""
        return name_of(self.choice.episode, self.choice.camera_id)


@dataclass(frozen=True, kw_only=True)
class ScanReport:
    """What is to be said about a scan; ``scene.json`` keeps the remarks."""

    poses: Mapping[str, PoseReport]
    """By camera; one that stands still is compared with those that move, where there are any."""
    found: tuple[str, ...]
    """What is wrong, one remark each."""
    moving_fraction: float = 0.0
    """Share of the measured surface that moved."""
    moving_place: str = ""
    """Where most of that was; empty where only single voxels did."""
    ego_mask_shares: Mapping[str, float] = field(default_factory=dict)
    """By camera without joints: share of its image that moves with it."""

    def remarks(self) -> list[str]:
        """All remarks, that about motion included."""
        found = list(self.found)
        for name, share in self.ego_mask_shares.items():
            found.append(
                f"{100 * share:.0f} % of the image of {name} moves with the camera, as a gripper "
                "or a dark rim does, and was left out"
            )
        if self.moving_fraction >= MUCH_MOVED:
            found.append(
                f"{100 * self.moving_fraction:.0f} % of the measured surface moved during the scan "
                "and was left out; scan while nothing but the camera moves, or check the poses"
            )
        elif self.moving_place:
            found.append(
                f"{100 * self.moving_fraction:.2g} % of the measured surface moved during the "
                "scan, or was measured where other frames find nothing, and was left out: most of "
                f"it {self.moving_place}"
            )
        return found


def check_scan(cameras: Sequence[CameraCheck], config: FrameConfig) -> ScanReport:
    """Look for what makes a scan useless, or worth less than it seems.

    Raises:
        NoDepthError: When no camera has depth images that can be used.
        PoseConventionError: When a camera's poses fit only if read in another convention.
        MovedCameraError: When a camera moved that is said to stand still.
    """
    seen = [camera for camera in cameras if camera.images]
    blind = [camera for camera in seen if max(camera.trusted) < SPARSE]
    usable = [camera for camera in seen if max(camera.trusted) >= SPARSE]
    if blind and not usable:
        raise NoDepthError(_no_depth(blind[0], config))
    moved = _moved_cameras(usable, refuse=config.check_poses)
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
    moving = [poses[item.name] for item in usable if not item.choice.stationary]
    if any(report.better is None and not report.fits for report in moving):
        found.append(
            "poses that are off by centimetres: --poses odometry follows the images instead"
        )
    stationary = [camera.name for camera in usable if camera.choice.stationary]
    if any(name in poses and not poses[name].fits for name in stationary):
        found.append("robot-gst calibrate RUN --cameras finds where cameras are that stand still")
    total = sum(len(camera.images) for camera in seen)
    if total < FEW_FRAMES:
        found.append(
            f"only {total} training frame{'s' if total > 1 else ''}: the scene holds what "
            f"{'they' if total > 1 else 'it'} saw and is likely to be wrong from elsewhere; scan "
            "longer"
        )
    return ScanReport(poses=poses, found=tuple(found))


def _pose_reports(usable: Sequence[CameraCheck]) -> dict[str, PoseReport]:
    """Judge moving cameras by themselves, and the others by moving ones whose poses fit."""
    poses = {
        camera.name: check_poses(camera.images) for camera in usable if not camera.choice.stationary
    }
    sure = [camera for camera in usable if camera.name in poses and poses[camera.name].is_sure]
    others = [image for camera in sure for image in camera.images]
    for camera in usable:
        if camera.choice.stationary:
            report = check_between(camera.images, others)
            if report.agreement is not None:  # else it looks at another place
                poses[camera.name] = report
    return poses


def _moved_cameras(usable: Sequence[CameraCheck], *, refuse: bool) -> list[str]:
    """Say which cameras moved although their poses do not.

    By the median over all pairs of images: a robot that passes by once does not count.
    """
    found = []
    for camera in usable:
        pairs = combinations(camera.images, 2) if camera.choice.stationary else ()
        all_met = [meet(a, b, se3.invert(b.T_base_depth) @ a.T_base_depth) for a, b in pairs]
        same = [met.agreement for met in all_met if met.overlap >= MIN_OVERLAP]
        agreement = float(np.median(same)) if same else 1.0
        if agreement >= STATIONARY_AGREEMENT:
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
    values = np.concatenate([image.depth_m[image.depth_m > 0] for image in camera.images])
    if len(values) == 0:
        return (
            f"{camera.name} measured no depth at all, every pixel is 0 or not a number: check the "
            "unit of depth and that the camera sends it"
        )
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
