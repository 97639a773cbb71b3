"""Objects in Rerun: Gaussians and outlines where they were found, carried and replayed.

Recorded ones (``/localised/<id>``) have their own colours and are there from the first instant on,
as on the page of a trial; replayed ones are tinted in their trajectory's colour and stand at their
start until the replay begins, soft ones bent as it bent them. Where the twin came nearest to what
it may not touch is a line between the two points.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import rerun as rr
from jaxtyping import Float, Int

from bridge.episode.run_folder import RunFolder
from bridge.errors import GstError
from bridge.geometry import se3
from bridge.geometry.trajectory import PoseTrajectory
from bridge.task.task_file import Task
from bridge.task.verdict import Verdict
from dashboards.errors import DashboardError
from dashboards.loading import LOADING
from dashboards.recording import PageClock, Recording
from dashboards.rerun_file import RerunFile

if TYPE_CHECKING:  # loads the twin
    from dashboards.soft_nodes import SoftNodes
    from dashboards.trial_scene import TrialScene
    from twin.scene.gaussians import GaussianCloud

BACKGROUND = "background.ply"
SCENE = "scene"
MAX_SPLATS = 300_000
"""More than this is slow in the web viewer (measured); the largest and most opaque are kept."""
MAX_OBJECT_SPLATS = 20_000
"""Of one object, once for each replay that moves it."""
MAX_SOFT_SPLATS = 5_000
"""Of a soft object: each is written again for every instant at which it is bent in another way."""
MAX_BENT = 400_000
"""Positions and turns of one soft object in one replay, 28 bytes each."""
BENT_HZ, BENT_M = 20.0, 0.3e-3
"""How often a soft object is bent at most, and how far one of its Gaussians moves in between."""
SH_DC = 0.28209479177387814
"""The constant spherical harmonic, 1 / (2 sqrt(pi))."""
TINT = 0.55
"""Share of its trajectory's colour in a replayed object."""
STILL = 1e-6
"""Poses whose numbers differ by less are one."""
AXES_M = 0.05
NEAREST = (204, 121, 167)
"""Reddish purple of Okabe and Ito (2008): no path has it."""
NEAREST_POINT_M, NEAREST_LINE_M = 0.004, 0.0015
_COLUMNS = (
    *("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)
Color = tuple[int, int, int]


def read_splats(path: Path) -> Float[np.ndarray, "num_splats 14"]:
    """Read a 3D Gaussian splatting PLY; higher harmonics are left out.

    Returns:
        Position [m], colour harmonic, opacity logit, log scales [m], rotation wxyz.

    Raises:
        DashboardError: When the file is another kind of PLY, or cut short.
    """
    data = path.read_bytes()
    head, marker, body = data.partition(b"end_header\n")
    lines = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    names = [words[-1] for words in lines if words[:2] == ["property", "float"]]
    counts = [int(words[2]) for words in lines if words[:2] == ["element", "vertex"]]
    properties = sum(words[:1] == ["property"] for words in lines)
    plain = marker and ["format", "binary_little_endian", "1.0"] in lines
    if not plain or len(counts) != 1 or properties != len(names) or not set(_COLUMNS) <= set(names):
        message = f"{path} is not a Gaussian splat PLY. Make it again: robot-gst rebuild RUN."
        raise DashboardError(message)
    if len(body) != counts[0] * len(names) * 4:
        message = f"{path} is cut short. Make it again: robot-gst rebuild RUN --force."
        raise DashboardError(message)
    table = np.frombuffer(body, dtype="<f4").reshape(counts[0], len(names))
    return table[:, [names.index(name) for name in _COLUMNS]]


def log_splats(file: RerunFile, scene_dir: Path) -> bool:
    """Log the rebuilt scene under ``scene/background``; return whether there is one.

    Args:
        file: The Rerun file being written; it notes why there is no scene.
        scene_dir: Folder of the rebuilt scene.
    """
    path = scene_dir / BACKGROUND
    if not path.is_file():
        file.note("no scene: rebuild it first (robot-gst rebuild RUN)")
        return False
    try:
        table = read_splats(path)
    except DashboardError as error:
        file.note(f"the rebuilt scene is not shown: {error}")
        return False
    kept = _kept(table, MAX_SPLATS)
    if len(kept) < len(table):
        file.note(f"{len(table) - len(kept)} of {len(table)} splats are left out, the faintest")
    file.always(f"{SCENE}/background", _splats(table[kept]))
    return True


def _kept(table: Float[np.ndarray, "num_splats 14"], most: int) -> np.ndarray:
    """The largest and most opaque, in their order: opacity times area."""
    if len(table) <= most:
        return np.arange(len(table))
    weight = _opacity(table) * np.prod(np.exp(table[:, 7:10]), axis=1) ** (2 / 3)
    return np.sort(np.argsort(weight)[-most:])


def _opacity(table: Float[np.ndarray, "num_splats 14"]) -> Float[np.ndarray, " num_splats"]:
    return np.asarray(1 / (1 + np.exp(-table[:, 6].astype(np.float64))))


def _splats(
    table: Float[np.ndarray, "num_splats 14"], tint: Color | None = None, *, placed: bool = True
) -> rr.GaussianSplats3D:
    """What Rerun draws of Gaussians; positions and turns only where they are ``placed``."""
    rgb = table[:, 3:6] * SH_DC + 0.5
    if tint is not None:
        rgb = (1 - TINT) * rgb + TINT * np.array(tint) / 255
    rgba = np.concatenate([rgb, _opacity(table)[:, None]], axis=1)
    return rr.GaussianSplats3D.from_fields(
        centers=table[:, 0:3] if placed else None,
        scales=np.exp(table[:, 7:10]),
        quaternions=np.roll(table[:, 10:14], -1, axis=1) if placed else None,
        colors=(np.clip(rgba, 0, 1) * 255 + 0.5).astype(np.uint8),
        spherical_harmonics_degree=0,
    )


def log_object(
    file: RerunFile,
    entity: str,
    track: PoseTrajectory,
    task: Task | None,
    *,
    color: Color | None = None,
) -> None:
    """Log an object's poses from its first one on and, where the task knows its shape, its boxes.

    Its id in the task is the last part of ``entity``.

    Args:
        file: The Rerun file being written.
        entity: Path of the object in it.
        track: ``T_base_object`` over the cell's source time.
        task: Knows the object's shape and colour; None draws axes of 5 cm.
        color: Of the boxes; None: as the task has it.
    """
    model = None if task is None else task.objects.get(entity.rpartition("/")[2])
    file.poses(entity, track)
    first = track.stamps_ns[:1]
    if model is None:
        file.rows(entity, first, rr.TransformAxes3D.columns(axis_length=[AXES_M]))
        return
    panels = model.panels()
    columns = rr.Boxes3D.columns(
        centers=np.array([centre for centre, _ in panels]),
        half_sizes=np.array([size / 2 for _, size in panels]),
        colors=[model.color_srgb if color is None else color] * len(panels),
    ).partition([len(panels)])
    file.rows(entity, first, columns)
    wireframe = rr.components.FillMode.MajorWireframe
    file.always(entity, rr.Boxes3D.from_fields(fill_mode=wireframe))


@dataclass(frozen=True, kw_only=True)
class ShownObjects:
    """What the rebuilt scene and the localisation know of a recording's objects."""

    clouds: "Mapping[str, GaussianCloud]" = field(default_factory=dict)
    """Gaussians of each object in its own frame."""
    recorded: Mapping[str, PoseTrajectory] = field(default_factory=dict)
    """Where they were, from the first instant on; empty for a replay that is shown alone."""
    T_base_root: Float[np.ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))
    """The frame of the rebuilt scene, which is that of all poses that cameras saw."""
    as_seen: Callable[[Float[np.ndarray, "4 4"]], Float[np.ndarray, "4 4"]] = lambda T: T
    """Takes a replayed pose to where cameras would see it."""


def gather_objects(file: RerunFile, run: RunFolder | None, recording: Recording) -> ShownObjects:
    """Find out where objects were at every instant, and what they look like.

    Args:
        file: Notes what is missing.
        run: Whose scene and localisations are used; None: there are none.
        recording: A trial, or a replay.
    """
    if run is None:
        return ShownObjects()
    try:
        with LOADING:
            from dashboards.trial_scene import gather_scene  # noqa: PLC0415  # loads the twin
            from twin.replay.rebuilt_scene import correction_of  # noqa: PLC0415
            from twin.scene.store.calibration import read_calibration  # noqa: PLC0415
    except ModuleNotFoundError as error:
        file.note(
            f"where objects were is not shown: {error.name} is not installed "
            "(pip install 'robot-gst[replay]')"
        )
        return ShownObjects()
    try:
        correction = correction_of(read_calibration(run))
        scene = gather_scene(run, recording, {}, None)
    except GstError as error:
        file.note(f"where objects were is not shown: {error}")
        return ShownObjects()
    tracks: dict[str, PoseTrajectory] = {}
    if recording.derived is None:
        tracks = _recorded_tracks(scene, PageClock.of(recording))
        for note in scene.notes:
            file.note(note)
    parts = scene.parts
    return ShownObjects(
        clouds=_clouds(scene),
        recorded=tracks,
        T_base_root=np.eye(4) if parts is None else se3.invert(parts.T_root_base),
        as_seen=correction.as_seen,
    )


def _recorded_tracks(scene: "TrialScene", clock: PageClock) -> dict[str, PoseTrajectory]:
    """Poses wherever they change; what nobody looked for stands where it was scanned."""
    stamps_ns = np.array([clock.stamp_ns(t) for t in scene.times_s.tolist()], dtype=np.int64)
    tracks = {}
    for name, Ts in scene.sides[0].Ts_base_object.items():
        moved = np.abs(np.diff(Ts, axis=0)).max(axis=(1, 2)) > STILL
        # The last row before a motion is kept too, so that no viewer fills in a slow one.
        rows = np.concatenate([[True], moved]) | np.concatenate([moved, [False]])
        q, p = se3.split(Ts[rows])
        tracks[name] = PoseTrajectory(stamps_ns[rows], p, q)
    for name, item in {} if scene.parts is None else scene.parts.objects.items():
        if name not in tracks and name not in scene.absent:
            q, p = se3.split(item.T_base_object[None])
            tracks[name] = PoseTrajectory(stamps_ns[:1], p, q)
    return tracks


def _clouds(scene: "TrialScene") -> "dict[str, GaussianCloud]":
    """The objects' Gaussians, the largest and most opaque."""
    items = {} if scene.parts is None else scene.parts.objects
    clouds = {name: item.cloud for name, item in items.items() if len(item.cloud)}
    return {name: _reduced(cloud, MAX_OBJECT_SPLATS) for name, cloud in clouds.items()}


def _reduced(cloud: "GaussianCloud", most: int) -> "GaussianCloud":
    return cloud.take(_kept(_table(cloud), most))


def _table(cloud: "GaussianCloud") -> Float[np.ndarray, "num_splats 14"]:
    """Gaussians in the columns of ``read_splats``."""
    harmonic = (cloud.colors - 0.5) / SH_DC
    logits = cloud.opacities_logit[:, None]
    parts = (cloud.means_m, harmonic, logits, cloud.scales_log, cloud.quats_wxyz)
    return np.concatenate(parts, axis=1)


def log_recorded(file: RerunFile, shown: ShownObjects, task: Task | None) -> None:
    """Log recorded objects under ``localised/<id>``, in their own colours.

    Args:
        file: The Rerun file being written.
        shown: Where they were.
        task: Knows the shapes of objects; None draws axes instead.
    """
    for name, track in shown.recorded.items():
        entity = f"localised/{name}"
        log_object(file, entity, _moved(track, shown.T_base_root), task)
        if name in shown.clouds:
            file.always(f"{entity}/gaussians", _splats(_table(shown.clouds[name])))


def soft_nodes(
    file: RerunFile, replay: Recording, task: Task | None, shown: ShownObjects
) -> "dict[str, SoftNodes]":
    """Read how a replay bends the soft objects that are shown, on its own clock.

    Args:
        file: Notes which one is not bent.
        replay: The replay; a recording bends none.
        task: Knows which objects are soft.
        shown: What objects look like.
    """
    names = [] if task is None else [name for name in task.soft_objects if name in shown.clouds]
    if replay.derived is None or not names:
        return {}
    with LOADING:
        from dashboards.soft_nodes import not_bent, read_soft_nodes  # noqa: PLC0415

    found = {}
    for name in names:
        try:
            nodes = read_soft_nodes(replay, name)
        except GstError as error:
            file.note(str(error))
            nodes = None
        if nodes is None:
            file.note(not_bent(name, replay.derived.trajectory))
        else:
            found[name] = nodes
    return found


def log_replayed(
    file: RerunFile,
    prefix: str,
    tracks: Mapping[str, PoseTrajectory],
    soft: "Mapping[str, SoftNodes]",
    shown: ShownObjects,
    task: Task | None,
    *,
    color: Color,
) -> None:
    """Log a replay's objects under ``<prefix>/objects/<id>``, tinted and outlined in its colour.

    Args:
        file: The Rerun file being written.
        prefix: Of the replay's entities.
        tracks: ``T_base_object`` as the robot finds it, over the recorded source time.
        soft: How soft ones are bent, over the same.
        shown: Gaussians, and where cameras would see what the robot finds.
        task: Knows the shapes of objects; None draws axes instead.
        color: Of its trajectory.
    """
    for name, track in tracks.items():
        entity = f"{prefix}/objects/{name}"
        Ts = np.stack([shown.as_seen(T) for T in track.transforms()])
        q, p = se3.split(shown.T_base_root @ Ts)
        log_object(file, entity, PoseTrajectory(track.stamps_ns, p, q), task, color=color)
        if name not in shown.clouds:
            continue
        cloud = shown.clouds[name]
        if name in soft:
            cloud = _reduced(cloud, MAX_SOFT_SPLATS)
            _log_bent(file, f"{entity}/gaussians", cloud, soft[name], int(track.stamps_ns[0]))
        splats = _splats(_table(cloud), color, placed=name not in soft)
        file.always(f"{entity}/gaussians", splats)


def _log_bent(
    file: RerunFile, entity: str, cloud: "GaussianCloud", nodes: "SoftNodes", first_ns: int
) -> None:
    """Log where the Gaussians of a soft object are in its frame, whenever that changes.

    Args:
        file: The Rerun file being written.
        entity: Of the Gaussians.
        cloud: Unbent.
        nodes: What they follow, as the rasteriser has them follow.
        first_ns: From then on they are shown.
    """
    with LOADING:
        from twin.scene.skinning import bind, pose_cloud  # noqa: PLC0415

    binding = bind(cloud.means_m, nodes.rest_m)
    kept: list[tuple[int, GaussianCloud]] = []
    for stamp_ns in _bent_at(nodes.stamps_ns, len(cloud)).tolist():
        bent = pose_cloud(cloud, binding, nodes.at(stamp_ns))
        if not kept or np.abs(bent.means_m - kept[-1][1].means_m).max() > BENT_M:
            kept.append((stamp_ns, bent))
    stamps_ns = np.array([min(first_ns, kept[0][0]), *(stamp_ns for stamp_ns, _ in kept[1:])])
    columns = rr.GaussianSplats3D.columns(
        centers=np.concatenate([bent.means_m for _, bent in kept]),
        quaternions=np.roll(np.concatenate([bent.quats_wxyz for _, bent in kept]), -1, axis=1),
    )
    file.rows(entity, stamps_ns, columns.partition([len(cloud)] * len(kept)))


def _bent_at(stamps_ns: Int[np.ndarray, " num_states"], num_splats: int) -> np.ndarray:
    """Instants at which an object may be bent anew, evenly spaced."""
    first_ns, last_ns = int(stamps_ns[0]), int(stamps_ns[-1])
    often = int((last_ns - first_ns) * 1e-9 * BENT_HZ) + 2
    count = max(2, min(often, MAX_BENT // num_splats))
    return np.linspace(first_ns, last_ns, count).astype(np.int64)


def begun_at(track: PoseTrajectory, first_ns: int) -> PoseTrajectory:
    """The same poses, the first one from an earlier instant on."""
    if first_ns >= track.stamps_ns[0]:
        return track
    stamps_ns = np.concatenate([[first_ns], track.stamps_ns])
    p_m, q_wxyz = (np.concatenate([rows[:1], rows]) for rows in (track.p_m, track.q_wxyz))
    return PoseTrajectory(stamps_ns, p_m, q_wxyz)


def _moved(track: PoseTrajectory, T: Float[np.ndarray, "4 4"]) -> PoseTrajectory:
    q, p = se3.split(T @ track.transforms())
    return PoseTrajectory(track.stamps_ns, p, q)


def log_nearest(file: RerunFile, prefix: str, verdict: Verdict, start_ns: int) -> None:
    """Log the two points where the smallest clearance was, from that instant on.

    Args:
        file: The Rerun file being written; it notes what an older replay does not say.
        prefix: Of the replay's entities.
        verdict: Of the replay.
        start_ns: The recorded source time at which the replay's trajectory starts.
    """
    found = verdict.nearest
    if found is None and verdict.clearance.value is None:
        file.note(f"the smallest clearance of {prefix} is not shown: it was not measured")
        return
    if found is None:
        file.note(
            f"where the smallest clearance of {prefix} was is not shown: its replay does not say; "
            "make it again (robot-gst replay RUN)"
        )
        return
    points = np.array(found["p_m"])
    one, other = found["bodies"]
    text = f"{verdict.trajectory}: {found['distance_m'] * 1e3:.1f} mm from {one} to {other}"
    stamps_ns = np.array([start_ns + found["t_ns"]])
    line = rr.LineStrips3D.columns(
        strips=[points], radii=[NEAREST_LINE_M], colors=[NEAREST], labels=[text]
    )
    file.rows(f"{prefix}/nearest", stamps_ns, line)
    ends = rr.Points3D.columns(
        positions=points, radii=[NEAREST_POINT_M] * 2, colors=[NEAREST] * 2
    ).partition([2])
    file.rows(f"{prefix}/nearest/points", stamps_ns, ends)
