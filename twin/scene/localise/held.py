"""How objects lie in the hand while they are carried: seen by all cameras in the tool's frame.

Fingers that come down on a thing push and tilt it in ways that no joint tells of. Between them it
stands still: frames taken on the way are views of one scene in the tool's frame.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.ndimage import median_filter
from scipy.signal import find_peaks, peak_widths

from bridge.episode import streams
from bridge.episode.executions import EXECUTION, executed_events
from bridge.episode.reader import Episode
from bridge.episode.streams import RgbdFrame
from bridge.errors import GstError
from bridge.geometry import se3
from bridge.task.task_file import SCANNED, ObjectModel, Task
from twin.robot.model import RobotModel, load_robot
from twin.robot.posture import PostureTrack, posture_track
from twin.scene.frames.camera_poses import CameraPoses, base_tree
from twin.scene.frames.pairing import paired_stamps_ns
from twin.scene.frames.selection import rgbd_camera_ids, spread, with_true_depth
from twin.scene.localise.mesh_fit import (
    MIN_EXPLAINED,
    MeshSurface,
    fit_mesh,
    known_surface,
    lengths,
)
from twin.scene.localise.points import MIN_POINTS, fuse_stationary, object_points
from twin.scene.localise.stationary_frames import Poses

BETWEEN_M = 0.03
"""From the surface of what is between the fingers to the tool, at most."""
PLATEAU_M = 0.003
"""Fingers that are this near to the least opening of a grasp grasp what is between them."""
OPENS_M = 0.0005
"""Fingers that go this far from where they held a thing have let it go."""
EMPTY_M = 0.002
"""Fingers that close to less have nothing between them, or nothing any more: as good as open."""
SNAP, SNAPS = 5, 0.1
"""Samples of which the median counts, and share of a grasp in which fingers may be nearer than they
held a thing: they snap shut when it slips out."""
STOOD = 1 / 3
"""Fingers that stood there for a smaller share of the time closed, or opened, on nothing."""
CLOSES = 0.25
"""Of the farthest way of the fingers: less is not a grip."""
SETTLES = 0.25
"""Share of a grip at either end in which the object may move in the hand, or is near to others."""
FRAMES = 4
"""Of each camera."""
MAX_SEEN_THROUGH = 0.1
"""With more of its surface seen through it lies in the hand in another way."""
ANY_TILT_RAD = 10.0
UPWARDS = np.diag([1.0, -1.0, -1.0, 1.0])
"""The tool's frame with z out of the hand, where cameras look from."""


@dataclass(frozen=True, kw_only=True)
class Grip:
    """A stretch of time in which the fingers were closed around something."""

    closing_ns: int
    """From here on they came nearer to each other than half way."""
    start_ns: int
    end_ns: int
    T_base_tcp_start: Float[np.ndarray, "4 4"]
    T_base_tcp_end: Float[np.ndarray, "4 4"]


def reach_m(model: ObjectModel) -> float:
    """From the tool: nearer than this an object is between the fingers."""
    return BETWEEN_M + max(model.size_m) / 2


def executions_ns(episode: Episode) -> dict[str, tuple[int, int]]:
    """When each plan was executed, from start to end."""
    events = executed_events(episode)
    ended = [event for event in events if event["type"] == EXECUTION[1] and event.get("plan_id")]
    spans = {str(e["plan_id"]): streams.execution_ns(events, str(e["plan_id"])) for e in ended}
    return {key: (a, b) for key, (a, b) in spans.items() if a is not None and b is not None}


def grips_between(track: PostureTrack, robot: RobotModel, start_ns: int, end_ns: int) -> list[Grip]:
    """When the fingers stood closed around something, by their recorded opening."""
    widths = track.widths
    if widths is None:
        return []
    inside = (widths.stamps_ns >= start_ns) & (widths.stamps_ns <= end_ns)
    stamps, width_m = widths.stamps_ns[inside], widths.position[inside, 0]
    if len(stamps) == 0 or np.ptp(width_m) < PLATEAU_M:
        return []
    width_m = median_filter(np.where(width_m < EMPTY_M, width_m.max(), width_m), SNAP)
    closed_m = -np.pad(width_m, 1, constant_values=width_m.max())
    deepest, _ = find_peaks(closed_m, prominence=CLOSES * np.ptp(width_m))
    _, _, began, ended = peak_widths(closed_m, deepest)  # half way, whatever other grips hold
    grips = []
    for first, last in zip(np.ceil(began).astype(int) - 1, ended.astype(int), strict=True):
        grasp_m = np.quantile(width_m[first:last], SNAPS)
        held = first + np.flatnonzero(np.abs(width_m[first:last] - grasp_m) <= PLATEAU_M)
        if len(held) < STOOD * (last - first):
            continue
        late = held[-1 - len(held) // 4 :]
        opens_m = np.median(width_m[late]) + OPENS_M
        t0, t1 = int(stamps[held[0]]), int(stamps[late[width_m[late] <= opens_m][-1]])
        grips.append(
            Grip(
                closing_ns=int(stamps[first]),
                start_ns=t0,
                end_ns=t1,
                T_base_tcp_start=robot.T_base_tcp(track.at(t0).joints_rad),
                T_base_tcp_end=robot.T_base_tcp(track.at(t1).joints_rad),
            )
        )
    return grips


def held_objects(
    episode: Episode,
    span_ns: tuple[int, int],
    task: Task,
    surfaces: Mapping[str, MeshSurface],
    poses: Poses,
    last_seen_m: Mapping[str, Float[np.ndarray, "3"]],
) -> Iterator[tuple[str, Grip, Float[np.ndarray, "4 4"]]]:
    """What cameras saw in the hand in an execution: object, grip, and pose ``T_tcp_object``.

    Args:
        last_seen_m: Before it. Of soft objects, which may look alike, only one that lay where the
            fingers closed is looked for.
    """
    try:
        track = posture_track(episode)
        robot = load_robot(track.urdf)
    except GstError:
        return
    shapes = {
        name: surfaces[name] if model.shape == SCANNED else known_surface(model)
        for name, model in task.objects.items()
        if not model.fixed and (model.shape != SCANNED or name in surfaces)
    }
    for grip in grips_between(track, robot, *span_ns):
        frames = list(_in_tool_frame(episode, grip, track, robot, poses))
        for name, surface in shapes.items():
            model = task.objects[name]
            away_m = last_seen_m.get(name, np.inf) - grip.T_base_tcp_start[:3, 3]
            may_be = model.soft is None or np.linalg.norm(away_m) < reach_m(model)
            if may_be and (T := fitted_in_hand(frames, task, model, surface)) is not None:
                yield name, grip, T


def _in_tool_frame(
    episode: Episode, grip: Grip, track: PostureTrack, robot: RobotModel, poses: Poses
) -> Iterator[RgbdFrame]:
    """Frames of all cameras during a grip, posed in the tool's frame turned ``UPWARDS``."""
    tree = base_tree(episode)
    for camera_id in rgbd_camera_ids(episode):
        with suppress(GstError):  # others may see it
            known = poses.get(camera_id) or CameraPoses(tree=tree, source="tf")
            stamps = paired_stamps_ns(episode, camera_id)
            margin_ns = SETTLES * (grip.end_ns - grip.start_ns)
            held = (stamps > grip.start_ns + margin_ns) & (stamps < grip.end_ns - margin_ns)
            stamps = np.setdiff1d(stamps[held], [*known.unposed_ns])
            wanted = set(spread(stamps, FRAMES).tolist())
            frame_id = streams.camera_info(episode, camera_id).frame_id
            if known.tree.root_of(frame_id) != robot.record.base_frame:
                continue
            for frame in streams.rgbd_frames(episode, camera_id, known.tree, wanted):
                T_base_tcp = robot.T_base_tcp(track.at(frame.stamp_ns).joints_rad)
                T = UPWARDS @ se3.invert(T_base_tcp)
                yield replace(
                    with_true_depth(frame, known),
                    T_base_color=T @ frame.T_base_color,
                    T_base_depth=T @ frame.T_base_depth,
                )


def fitted_in_hand(
    frames: Sequence[RgbdFrame], task: Task, model: ObjectModel, surface: MeshSurface
) -> Float[np.ndarray, "4 4"] | None:
    """Pose ``T_tcp_object`` of an object between the fingers; None where none is seen there."""
    views = fuse_stationary(frames, FRAMES, FRAMES, replace(task, start={}))
    around_m = BETWEEN_M + float(np.linalg.norm(model.size_m)) / 2
    near = object_points(views, model, -np.inf, lambda p: lengths(p) >= around_m)
    if not near or len(near[0]) < MIN_POINTS:
        return None
    fit = fit_mesh(near[0], views, surface, tilt_sigma_rad=ANY_TILT_RAD, lying=True)
    is_it = fit.explained >= MIN_EXPLAINED and fit.seen_through <= MAX_SEEN_THROUGH
    return UPWARDS @ fit.T_base_object if is_it else None
