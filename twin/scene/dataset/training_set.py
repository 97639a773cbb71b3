"""Read the training frames once: points, views, what moved, and whether the scan makes sense."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool

from bridge.episode.reader import Episode
from bridge.terminal import Output
from twin.scene.dataset.colour_check import check_colour
from twin.scene.dataset.geometry_search import camera_pose_at, check_geometry
from twin.scene.dataset.masks import (
    ReferenceView,
    choose_reference_views,
    find_dark_rim,
    find_ego_mask,
    find_moving,
    without_ego,
)
from twin.scene.dataset.scan_check import CameraCheck, ScanReport, check_scan
from twin.scene.frames.downscaled import DownscaledDepth, downscaled_depth
from twin.scene.frames.rgbd import DepthLimits, FrameSurface, PointSet, TrainingView, training_view
from twin.scene.frames.selection import FrameChoice, NoFramesError, load
from twin.scene.objects.placement import NO_OBJECTS, Placements
from twin.scene.robot.extraction import MAX_POSTURES, RobotFrames, find_robot
from twin.scene.settings import RebuildConfig

MAX_POINTS = 3_000_000
"""Depth points to fuse; more change nothing but the time."""
DOWNSCALED_PX = 120
ESTIMATED = DepthLimits(max_depth_m=math.inf, flying_fraction=0.15)
"""Neighbouring pixels of estimated depth differ by more, and are of one surface."""


@dataclass(frozen=True, kw_only=True)
class TrainingSet:
    """What the training frames gave; nothing in it has seen a held-out frame."""

    choices: list[FrameChoice]
    points: list[PointSet]
    """Static surface points of each training frame, objects included."""
    views: list[TrainingView]
    bare_points: list[PointSet]
    """Without the objects of the episodes' tasks."""
    bare_views: list[TrainingView]
    choice_of_view: list[int]
    """Index of each view's choice."""
    ego_masks: dict[int, Bool[np.ndarray, "height width"]]
    """By index of the choice: what moves with a camera whose robot is not known by joints."""
    reference_views: list[ReferenceView]
    report: ScanReport
    robot: RobotFrames

    def views_of(self, episode: Episode) -> list[TrainingView]:
        """Those of one episode."""
        own = [choice.episode.path == episode.path for choice in self.choices]
        shown = zip(self.views, self.choice_of_view, strict=True)
        return [view for view, index in shown if own[index]]


def limits_of(config: RebuildConfig) -> DepthLimits:
    """Which depth is trusted."""
    return DepthLimits(
        max_depth_m=config.frames.max_depth_m, flying_fraction=config.initialise.flying_fraction
    )


@dataclass(kw_only=True)
class _Read:
    """What reading the training frames gave, frame by frame."""

    points: list[PointSet] = field(default_factory=list)
    views: list[TrainingView] = field(default_factory=list)
    choice_of_view: list[int] = field(default_factory=list)
    cameras: list[CameraCheck] = field(default_factory=list)


def read_training_set(
    choices: Sequence[FrameChoice],
    config: RebuildConfig,
    output: Output,
    placements: Placements = NO_OBJECTS,
) -> TrainingSet:
    """Read every training frame, check the scan, and set aside what moved.

    Objects that stand elsewhere in another episode did not move while they were looked at.
    """
    robot = find_robot(choices)
    read = _read(choices, config, robot, output)
    if not read.views:
        message = "no frame of this run has colour, depth and a pose together. Record it again."
        raise NoFramesError(message)
    is_measured = not any(choice.estimated_m for choice in choices)
    report = ScanReport(poses={}, found=())
    if is_measured:
        report = check_scan(read.cameras, config.frames)
        report = check_geometry(read.cameras, report, config.frames)
        for index, camera in enumerate(read.cameras):
            if not camera.choice.stationary:
                owned = zip(read.views, read.choice_of_view, strict=True)
                mine = sorted((v for v, owner in owned if owner == index), key=lambda v: v.stamp_ns)
                remarks = check_colour(mine, camera_pose_at(camera.choice))
                found = (f"{camera.name}: {remark}" for remark in remarks)
                report = replace(report, found=(*report.found, *found))
    stride = _stride(MAX_POSTURES, read.views[0].full.depth_m.size)
    for choice in choices:
        robot.look_closer(choice, limits_of(config), stride)
    ego_masks = _set_ego_pixels_aside(choices, read, robot)
    shares = {read.cameras[index].name: float(mask.mean()) for index, mask in ego_masks.items()}
    points, views, choice_of_view = read.points, read.views, read.choice_of_view
    paths = [choice.episode.path for choice in choices]
    scans = [paths.index(paths[index]) for index in choice_of_view]
    # Estimated depth is off by more than what moves: it speaks against no surface.
    reference_views = choose_reference_views(views, scans) if is_measured else []
    bare = [
        placements.take_out(choices[index].episode, points[place], views[place])
        for place, index in enumerate(choice_of_view)
    ]
    bare_points, bare_views = [each for each, _ in bare], [each for _, each in bare]
    moving = find_moving(bare_points, reference_views)
    num_points = sum(len(item.p_m) for item in bare_points)
    pairs = ((bare_points, bare_views), (points, views))
    for seen, shown in pairs:  # one by one, so that memory holds the frames once
        for place in range(len(shown)):
            seen[place] = seen[place].take(~moving.contains(seen[place].p_m))
            shown[place] = moving.mask_in(shown[place])
    gone = (num_points - sum(len(item.p_m) for item in bare_points)) / max(num_points, 1)
    report = replace(
        report,
        moving_fraction=round(gone, 4),
        moving_place=moving.largest_place(),
        ego_mask_shares=shares,
    )
    for remark in report.remarks():
        output.say(remark)
    return TrainingSet(
        choices=list(choices),
        points=points,
        views=views,
        bare_points=bare_points,
        bare_views=bare_views,
        choice_of_view=choice_of_view,
        ego_masks=ego_masks,
        reference_views=reference_views,
        report=report,
        robot=robot,
    )


def _read(
    choices: Sequence[FrameChoice], config: RebuildConfig, robot: RobotFrames, output: Output
) -> _Read:
    """Read every training frame once, the robot set aside where its joints are known."""
    total = sum(len(choice.train_ns) for choice in choices)
    read = _Read()
    with output.progress("read frames", total) as advance:
        for index, choice in enumerate(choices):
            limits = ESTIMATED if choice.estimated_m else limits_of(config)
            images: list[DownscaledDepth] = []
            trusted = []
            for frame in load(choice, choice.train_ns):
                surface = FrameSurface(frame, limits)
                seen = surface.points(_stride(total, frame.depth_m.size))
                view = training_view(surface)
                seen, view = robot.take_out(choice.episode, frame, seen, view)
                read.points.append(seen)
                read.views.append(view)
                read.choice_of_view.append(index)
                images.append(downscaled_depth(frame, DOWNSCALED_PX))
                trusted.append(float(surface.trusted.mean()))
                advance(len(read.views), f"camera {frame.camera_id}")
            read.cameras.append(CameraCheck(choice=choice, images=images, trusted=trusted))
    return read


def _set_ego_pixels_aside(
    choices: Sequence[FrameChoice], read: _Read, robot: RobotFrames
) -> dict[int, Bool[np.ndarray, "height width"]]:
    """Take out of points and views what moves with a camera: no joints tell its robot, or a rim."""
    found: dict[int, np.ndarray] = {}
    for index, choice in enumerate(choices):
        mine = [place for place, owner in enumerate(read.choice_of_view) if owner == index]
        views = [read.views[place] for place in mine]
        asked = [find_dark_rim] if views else []
        if not (choice.stationary or choice.estimated_m or robot.knows(choice.episode)):
            asked.append(find_ego_mask)
        masks = [mask for mask in (ask(views) for ask in asked) if mask is not None]
        if not masks:
            continue
        mask = found[index] = np.logical_or.reduce(masks)
        for place in mine:
            seen, shown = read.points[place], read.views[place]
            read.points[place], read.views[place] = without_ego(seen, shown, mask)
    return found


def _stride(num_frames: int, num_pixels: int) -> int:
    """Use every n-th pixel of every n-th row so that all frames together stay within bounds."""
    return max(1, round(float(np.sqrt(num_frames * num_pixels / MAX_POINTS))))
