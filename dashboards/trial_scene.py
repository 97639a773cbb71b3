"""What a trial looks like in space at every instant of its page, recorded and in the twin.

Recorded objects are where they were localised, and go with the hand in between; replayed ones are
where the replay has them, taken back to where cameras see them. Nothing is localised here: what
``replay`` has not written is missing, and a note says so.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from jaxtyping import Bool, Float, Int

from bridge.episode import streams
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.errors import GstError
from bridge.geometry.camera import Camera
from bridge.geometry.trajectory import PoseTrajectory
from bridge.leaves import has_leaf, load_leaf
from bridge.task.plan import Plan
from bridge.task.task_file import Task
from dashboards.library import derived_paths
from dashboards.loading import LOADING
from dashboards.recording import PageClock, Problems, Recording
from twin.robot.model import RobotModel, load_robot
from twin.robot.posture import Posture, PostureTrack, posture_track
from twin.scene.frames.camera_poses import base_tree, unknown_mask
from twin.scene.movable_scene import MovableScene
from twin.scene.object_tracks import ObjectTracks, localised_tracks
from twin.scene.standpoint import poses_in_scene
from twin.scene.store.folder import Scene, read_scene
from twin.scene.trial import trial_parts

RATE_HZ = 20.0
"""Poses are sampled this often; the page interpolates."""
MAX_SAMPLES = 600
"""A long trial is sampled less often."""
RECORDED = "recorded"


@dataclass(frozen=True, kw_only=True)
class Bend:
    """How a soft object is bent: the rigid motion of each node of its lattice."""

    rest_nodes_m: Float[np.ndarray, "num_nodes 3"]
    """In the object's frame, unbent: as the replay began."""
    Ts_base_node: Float[np.ndarray, "num_samples num_nodes 4 4"]
    """Take what is near a node from the object's frame to where it is. Samples are evenly spaced
    over the page's time."""


@dataclass(frozen=True, kw_only=True)
class Side:
    """Recording or one replay: where its objects and its arm were at each sample."""

    name: str
    """recorded, planned or executed."""
    span_s: tuple[float, float]
    """Page times between which something is known."""
    Ts_base_object: Mapping[str, Float[np.ndarray, "num_samples 4 4"]]
    skeleton_m: Float[np.ndarray, "num_samples num_points 3"] | None
    """The arm as a line from base to tool; None where its joints are not known."""
    bends: Mapping[str, Bend] = field(default_factory=dict)
    """Of soft objects whose nodes the replay holds."""


@dataclass(frozen=True, kw_only=True)
class ToolPath:
    """Where the tool went, or was to go, over the page's time."""

    name: str
    style: str
    t_s: Float[np.ndarray, " num_points"]
    p_m: Float[np.ndarray, "num_points 3"]


@dataclass(frozen=True, kw_only=True)
class SceneCamera:
    """A recorded camera and where it was."""

    id: str
    camera: Camera
    Ts_base_camera: Float[np.ndarray, "num_samples 4 4"]
    known: Bool[np.ndarray, " num_samples"]


@dataclass(frozen=True, kw_only=True)
class TrialScene:
    """Everything that is drawn of one trial, in the frame of the rebuilt scene."""

    times_s: Float[np.ndarray, " num_samples"]
    parts: MovableScene | None
    """None where no scene was rebuilt."""
    sides: tuple[Side, ...]
    """Recorded first."""
    Ts_root_link: Mapping[str, Float[np.ndarray, "num_samples 4 4"]]
    """Links that the scene has Gaussians of, as recorded; empty: the robot is not drawn."""
    paths: tuple[ToolPath, ...]
    cameras: tuple[SceneCamera, ...]
    boxes_m: Mapping[str, tuple[list[float], list[float]]]
    """By object: centre and half extents of the box around it, in its own frame."""
    notes: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class _Gathering:
    """What the parts of a trial's scene are gathered from."""

    run: RunFolder
    recording: Recording
    episode: Episode
    clock: PageClock
    task: Task | None
    times_s: Float[np.ndarray, " num_samples"]
    problems: Problems
    parts: MovableScene | None = None
    """None until it is read, and without a rebuilt scene."""

    @property
    def stamps_ns(self) -> Int[np.ndarray, " num_samples"]:
        """The samples as source stamps."""
        return np.array([self.clock.stamp_ns(t) for t in self.times_s.tolist()], dtype=np.int64)


def gather_scene(
    run: RunFolder,
    recording: Recording,
    replays: Mapping[str, Recording],
    sent_plan: Plan | None,
) -> TrialScene:
    """Gather one trial in space.

    Args:
        sent_plan: Its way is drawn as it was executed; None draws none.
    """
    problems = Problems()
    clock = PageClock.of(recording)
    episode = Episode.open(recording.path)
    scene = problems.attempt(lambda: read_scene(run), None)
    count = int(np.clip(np.ceil(clock.end_s * RATE_HZ) + 1, 2, MAX_SAMPLES))
    gathering = _Gathering(
        run=run,
        recording=recording,
        episode=episode,
        clock=clock,
        task=problems.attempt(lambda: streams.task_file(episode).task(), None),
        times_s=np.linspace(0.0, clock.end_s, count),
        problems=problems,
    )
    postures = problems.attempt(lambda: posture_track(episode), None)
    robot = None if postures is None else problems.attempt(lambda: load_robot(postures.urdf), None)
    known = postures if robot is not None else None
    tracks = problems.attempt(lambda: _localised(gathering, known), ObjectTracks())
    problems.texts.extend(tracks.notes)
    if scene is not None:
        drawn = partial(trial_parts, run, scene, episode, gathering.task, tracks.first())
        nothing: tuple[MovableScene | None, list[str]] = (None, [])
        parts, notes = problems.attempt(drawn, nothing)
        problems.texts.extend(notes)
        gathering = replace(gathering, parts=parts)
    sides = [_recorded_side(gathering, tracks, postures, robot)]
    for trajectory, replay in replays.items():
        side = _replayed_side(gathering, trajectory, replay, robot)
        if side is not None:
            sides.append(side)
    return TrialScene(
        times_s=gathering.times_s,
        parts=gathering.parts,
        sides=tuple(sides),
        Ts_root_link=_links(gathering, postures, robot),
        paths=tuple(_paths(gathering, replays, sent_plan)),
        cameras=tuple(_cameras(gathering, scene)),
        boxes_m=_boxes(gathering, sides),
        notes=tuple(problems.texts),
    )


def _recorded_side(
    gathering: _Gathering,
    tracks: ObjectTracks,
    postures: PostureTrack | None,
    robot: RobotModel | None,
) -> Side:
    rows: dict[str, list[Float[np.ndarray, "4 4"]]] = {}
    skeletons = []
    for stamp_ns in gathering.stamps_ns.tolist():
        T_base_tcp = None
        if postures is not None and robot is not None:
            joints = postures.at(stamp_ns).joints_rad
            T_base_tcp = robot.T_base_tcp(joints)
            skeletons.append(robot.skeleton_m(joints))
        for name, T in tracks.at(stamp_ns, T_base_tcp).items():
            rows.setdefault(name, []).append(T)
    objects = {name: np.stack(Ts) for name, Ts in rows.items()}
    skeleton = np.stack(skeletons) if skeletons else None
    span_s = (0.0, gathering.clock.end_s)
    return Side(name=RECORDED, span_s=span_s, Ts_base_object=objects, skeleton_m=skeleton)


def _localised(gathering: _Gathering, postures: PostureTrack | None) -> ObjectTracks:
    run, recording = gathering.run, gathering.recording
    found = derived_paths(run, recording.path.stem, "localised")
    if not found or gathering.task is None:
        note = "objects stand where they were scanned: robot-gst replay RUN localises them"
        return ObjectTracks(notes=(note,))
    newest = max(found, key=lambda path: path.stat().st_mtime_ns)
    records = streams.localisations(Episode.open(newest))
    return localised_tracks(gathering.episode, records, gathering.task, postures)


def _replayed_side(
    gathering: _Gathering, trajectory: str, replay: Recording, robot: RobotModel | None
) -> Side | None:
    """One replay at the page's samples; None where its plan has no time on the page."""
    first_ns = replay.first_stamp_ns()
    last_ns = replay.last_stamp_ns()
    if first_ns is None or last_ns is None:
        return None
    ends = gathering.clock.replay_seconds(replay, np.array([first_ns, last_ns]))
    if ends is None:
        return None
    own_ns = gathering.stamps_ns + (first_ns - gathering.clock.stamp_ns(float(ends[0])))
    objects = {name: track.at(own_ns).transforms() for name, track in replay.objects.items()}
    skeleton = None
    joints = replay.joints
    if joints is not None and robot is not None and set(robot.joints) <= set(joints.names):
        order = [joints.names.index(name) for name in robot.joints]
        points = [robot.skeleton_m(row) for row in joints.at(own_ns)[:, order]]
        skeleton = np.stack(points)
    return Side(
        name=trajectory,
        span_s=(float(ends[0]), float(ends[1])),
        Ts_base_object=objects,
        skeleton_m=skeleton,
        bends=_bends(gathering, replay, trajectory, own_ns),
    )


def _bends(
    gathering: _Gathering,
    replay: Recording,
    trajectory: str,
    own_ns: Int[np.ndarray, " num_samples"],
) -> dict[str, Bend]:
    """How the replay bends soft objects, at instants of its own clock."""
    names = () if gathering.task is None else gathering.task.soft_objects
    if not names:
        return {}
    bends = {}
    for name in names:
        track, found = replay.objects.get(name), None
        if track is not None and has_leaf("soft"):
            with LOADING:
                bent = partial(load_leaf("soft", "bent"), replay, name, track, own_ns)
            found = gathering.problems.attempt(bent, None)
        if found is None:
            gathering.problems.texts.append(
                f"{name}: as replayed ({trajectory}) drawn without being bent"
            )
            continue
        rest_m, Ts = found
        bends[name] = Bend(rest_nodes_m=rest_m, Ts_base_node=Ts)
    return bends


def _links(
    gathering: _Gathering, postures: PostureTrack | None, robot: RobotModel | None
) -> dict[str, Float[np.ndarray, "num_samples 4 4"]]:
    parts = gathering.parts
    if parts is None or postures is None or robot is None:
        return {}
    rows: dict[str, list[Float[np.ndarray, "4 4"]]] = {link: [] for link in parts.links}
    for stamp_ns in gathering.stamps_ns.tolist():
        posture: Posture = postures.at(stamp_ns)
        for link, Ts in rows.items():
            Ts.append(robot.T_base_link(link, posture.joints_rad, posture.width_m))
    return {link: np.stack(Ts) for link, Ts in rows.items()}


def _paths(
    gathering: _Gathering, replays: Mapping[str, Recording], sent_plan: Plan | None
) -> list[ToolPath]:
    """The recorded way last, so that it is drawn over the others."""
    clock = gathering.clock
    paths = []

    def add(name: str, style: str, t_s: np.ndarray | None, p_m: np.ndarray) -> None:
        if t_s is not None and len(t_s) > 1:
            paths.append(ToolPath(name=name, style=style, t_s=t_s, p_m=p_m))

    for trajectory, replay in replays.items():
        if replay.tcp is not None:
            thin = _thinned(replay.tcp)
            t_s = clock.replay_seconds(replay, thin.stamps_ns)
            add(f"twin, {trajectory}", f"twin-{trajectory}", t_s, thin.p_m)
    start_s = None if sent_plan is None else clock.of_plan_time(sent_plan.id, 0)
    if sent_plan is not None and start_s is not None:
        add("planned", "planned", sent_plan.times_ns() * 1e-9 + start_s, sent_plan.positions_m())
    tcp = gathering.recording.tcp
    if tcp is not None:
        thin = _thinned(tcp)
        add("recorded", "recorded", clock.all_seconds(thin.stamps_ns), thin.p_m)
    return paths


def _thinned(track: PoseTrajectory) -> PoseTrajectory:
    """At most as many points as there are samples."""
    step = -(-len(track) // MAX_SAMPLES)
    return PoseTrajectory(track.stamps_ns[::step], track.p_m[::step], track.q_wxyz[::step])


def _cameras(gathering: _Gathering, scene: Scene | None) -> list[SceneCamera]:
    found = []
    for camera_id in streams.camera_ids(gathering.episode):
        try:
            found.append(_camera(gathering, scene, camera_id))
        except GstError as error:
            text = f"camera {camera_id} cannot be looked through: {error}"
            gathering.problems.texts.append(text)
    return found


def _camera(gathering: _Gathering, scene: Scene | None, camera_id: str) -> SceneCamera:
    run, episode, stamps_ns = gathering.run, gathering.episode, gathering.stamps_ns
    info = streams.camera_info(episode, camera_id)
    tree = (
        base_tree(episode)
        if scene is None
        else poses_in_scene(run, scene, episode, camera_id, stamps_ns)
    )
    return SceneCamera(
        id=camera_id,
        camera=info.camera,
        Ts_base_camera=tree.Ts_root_frame(info.frame_id, stamps_ns),
        known=~unknown_mask(tree, [info.frame_id], stamps_ns),
    )


def _boxes(
    gathering: _Gathering, sides: Sequence[Side]
) -> dict[str, tuple[list[float], list[float]]]:
    """From the task's sizes, else around the Gaussians."""
    boxes = {}
    splats = {} if gathering.parts is None else gathering.parts.objects
    models = {} if gathering.task is None else gathering.task.objects
    for name in dict.fromkeys(name for side in sides for name in side.Ts_base_object):
        if name in models:
            model = models[name]
            centre = np.array([0.0, 0.0, 0.0 if model.origin_at_centre else model.size_m[2] / 2])
            half = np.array(model.size_m) / 2
        elif name in splats and len(splats[name].cloud):
            low, high = np.percentile(splats[name].cloud.means_m, [1, 99], axis=0)
            centre, half = (low + high) / 2, (high - low) / 2
        else:
            continue
        boxes[name] = (centre.tolist(), half.tolist())
    return boxes
