"""The robot's part of a rebuild: found in the frames, kept out of the background, kept as links.

Where its joints are known, pixels that show the robot are masked and its points go to its links.
What it hid in one frame is filled by the frames in which it stood elsewhere; nothing is invented.
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, Int64
from scipy.ndimage import binary_dilation
from scipy.spatial import cKDTree

from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.streams import RgbdFrame, recorded_robot
from bridge.errors import GstError
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from twin.robot.model import load_robot
from twin.robot.posture import PostureTrack, distinct_postures, posture_track
from twin.robot.surface import PosedSurface, link_poses, link_surfaces
from twin.scene.fit.initialise import NoSurfaceError, fuse
from twin.scene.fit.lighting import EVEN, Lighting, Patches, fit_lighting
from twin.scene.fit.on_mesh import (
    colors_around,
    even_points,
    surface_area_m2,
    thin_gaussians,
    within_edges,
)
from twin.scene.frames.rgbd import DepthLimits, FrameSurface, PointSet, TrainingView
from twin.scene.frames.selection import FrameChoice, load, root_frame
from twin.scene.gaussians import GaussianCloud, as_float32, concatenate
from twin.scene.robot.splats import posed, surface_links, write_links
from twin.scene.shape.mesh import Mesh

IN_FRONT_M = 0.03
"""A measurement this much nearer than the robot shows something in front of it."""
GROW_PX = 2
"""Masks grow by this much at half size: cameras and joints are never quite where they say."""
MIN_POINTS = 60
"""A link seen by fewer points is not kept."""
ROBOT_SHARE = 0.25
"""Of the budget of Gaussians, for the robot's links."""
FEWEST = 400
"""Gaussians that a link has at least: a finger of few would be all edge."""
UNUSED = 0.25
"""Share of a link's Gaussians that fusing leaves unused; nothing splits them later."""


@dataclass(frozen=True, kw_only=True)
class LitLinks:
    """The robot's links as Gaussians."""

    clouds: Mapping[str, GaussianCloud] = field(default_factory=dict)
    """Each in its link's frame and its own colours."""
    lighting: Lighting = EVEN
    """Makes of them the colours that a camera sees."""


FITS_M = 0.006
"""Half of the measured points lie nearer to a shape that is the link's."""
REACH_M = 0.03
"""Colours of points farther away are not the surface's."""
NEIGHBOURS, LEAST_TOLD = 16, 0.05
PATCH_M, PATCH_NEIGHBOURS = 0.012, 4
"""Pieces of a link's surface whose light is compared between postures, and how many are looked at
to find the one that a point lies on."""
FACES_ALIKE = 0.7
"""Cosine between a measured normal and that of the surface it is of."""
MOST_WEIGHT = 10
"""More points on one piece count no more."""


@dataclass(frozen=True, kw_only=True)
class SeenLink:
    """What one frame measured of a link."""

    points: PointSet
    """In the link's frame."""
    R_base_link: Float[np.ndarray, "3 3"]
    """How the link was turned."""


def link_lighting(
    shapes: Mapping[str, Sequence[Mesh]], seen: Mapping[str, Sequence[SeenLink]]
) -> Lighting:
    """The light on a robot, from links that were seen turned in several ways."""
    patches: list[Patches] = []
    first = 0
    for link, items in sorted(seen.items()):
        if not shapes.get(link):
            continue
        p, normals = even_points(shapes[link], PATCH_M)
        tree = cKDTree(p)
        for item in items:
            piece, is_on = _pieces(item.points, tree, normals)
            ids, inverse = np.unique(piece[is_on], return_inverse=True)
            count = np.maximum(np.bincount(inverse, minlength=len(ids)), 1)
            colors = [
                np.bincount(inverse, item.points.colors[is_on, k], len(ids)) / count
                for k in range(3)
            ]
            patches.append(
                Patches(
                    ids=first + ids,
                    colors=np.stack(colors, axis=1),
                    normals=normals[ids] @ item.R_base_link.T,
                    weights=np.minimum(count, MOST_WEIGHT).astype(np.float64),
                )
            )
        first += len(p)
    return fit_lighting(patches)


def own_colors(
    shapes: Sequence[Mesh], seen: Sequence[SeenLink], lighting: Lighting
) -> list[PointSet]:
    """What was measured of a link with its own colours, as in even light.

    Args:
        shapes: Of the link, in its frame: measured normals are noisy, theirs are not; may be none.
    """
    if lighting == EVEN:
        return [item.points for item in seen]
    p, normals = even_points(shapes, PATCH_M) if shapes else (np.zeros((1, 3)), np.zeros((1, 3)))
    tree = cKDTree(p)
    result = []
    for item in seen:
        piece, is_on = _pieces(item.points, tree, normals)
        facing = np.where(is_on[:, None], normals[piece], item.points.normals)
        light = lighting.brightness(facing @ item.R_base_link.T)
        colors = as_float32(item.points.colors / light[:, None])
        result.append(replace(item.points, colors=colors))
    return result


def _pieces(
    points: PointSet, tree: cKDTree, normals: Float[np.ndarray, "num_pieces 3"]
) -> tuple[Int[np.ndarray, " num_points"], Bool[np.ndarray, " num_points"]]:
    """The piece of surface each point lies on, and whether it does."""
    count = min(PATCH_NEIGHBOURS, tree.n)
    distance, ids = tree.query(points.p_m, k=count)
    distance, ids = distance.reshape(-1, count), ids.reshape(-1, count)
    alike = np.einsum("pkc,pc->pk", normals[ids], points.normals)
    rows, best = np.arange(len(ids)), alike.argmax(axis=1)
    is_on = (alike[rows, best] > FACES_ALIKE) & (distance[rows, best] < 2 * PATCH_M)
    return ids[rows, best], is_on


def on_surface(
    shapes: Sequence[Mesh], sets: Sequence[PointSet], spacing_m: float
) -> GaussianCloud | None:
    """Gaussians on a link's shapes, in its frame; None where these do not fit what was measured.

    Depth is noisy and postures are few: points fused over a link leave ragged edges and gaps. A
    side that nobody saw takes the link's own middle colour.
    """
    p, normals = even_points(shapes, spacing_m)
    seen_m, facing, seen_colors = (
        np.concatenate([getattr(item, name) for item in sets])
        for name in ("p_m", "normals", "colors")
    )
    away_m, _ = cKDTree(p).query(seen_m)
    if np.median(away_m) > FITS_M + spacing_m / 2:
        return None
    p = within_edges(p, normals, shapes, spacing_m)
    seen = seen_m, facing, seen_colors
    colors, told = colors_around(p, normals, seen, NEIGHBOURS, reach_m=REACH_M)
    colors[told <= LEAST_TOLD] = np.median(seen_colors, axis=0)
    return thin_gaussians(p, normals, colors, spacing_m)


class RobotFrames:
    """Tells robot from background in the frames of some episodes, and collects its surface."""

    def __init__(self, episodes: Sequence[Episode], remark: str = "") -> None:
        """Read joints and descriptions; an episode without them is passed over, with a remark."""
        self._tracks: dict[str, PostureTrack] = {}
        remarks = [remark] if remark else []
        for episode in episodes:
            try:
                track = posture_track(episode)
                link_surfaces(load_robot(track.urdf))
            except GstError as error:
                remarks.append(f"{episode.info.id}: {error}")
                continue
            self._tracks[str(episode.path)] = track
        self.remark = "; ".join(remarks)
        """Why the robot is not told apart in some episodes; empty when it is in all."""
        self._seen: dict[str, list[SeenLink]] = {}

    def knows(self, episode: Episode) -> bool:
        """Say whether joints tell where the robot is in the frames of an episode."""
        return str(episode.path) in self._tracks

    def take_out(
        self, episode: Episode, frame: RgbdFrame, points: PointSet, view: TrainingView
    ) -> tuple[PointSet, TrainingView]:
        """Return a frame's points without the robot's, and its view with the robot masked.

        The robot's points are kept for its links when it stood still.
        """
        surface = self._surface(episode, frame.stamp_ns)
        if surface is None:
            return points, view
        owner = self._keep(episode, frame.stamp_ns, surface, points)
        shown = robot_mask(surface, view.half.camera, view.T_base_color, view.half.depth_m)
        return points.take(owner < 0), view.without(shown)

    def look_closer(self, choice: FrameChoice, limits: DepthLimits, stride: int) -> None:
        """Collect its surface from frames that a camera standing still has to spare.

        A few of its frames are enough for the background. The robot shows another side in each
        posture, so up to two dozen postures far from each other are read for its links.
        """
        track, episode = self._tracks.get(str(choice.episode.path)), choice.episode
        if track is None or not choice.stationary:
            return
        stamps = np.array([t for t in sorted(choice.spare_ns) if track.is_stationary(t)])
        joints = np.array([track.at(t).joints_rad for t in stamps.tolist()])
        wanted = stamps[distinct_postures(joints, MAX_POSTURES)] if len(stamps) else stamps
        for frame in load(choice, frozenset(wanted.tolist())):
            surface = self._surface(episode, frame.stamp_ns)
            if surface is not None:
                points = FrameSurface(frame, limits).points(stride)
                self._keep(episode, frame.stamp_ns, surface, points)

    def _surface(self, episode: Episode, stamp_ns: int) -> PosedSurface | None:
        track = self._tracks.get(str(episode.path))
        if track is None or not track.covers(stamp_ns):
            return None
        return PosedSurface(load_robot(track.urdf), track.at(stamp_ns))

    def _keep(
        self, episode: Episode, stamp_ns: int, surface: PosedSurface, points: PointSet
    ) -> Int64[np.ndarray, " num_points"]:
        """Keep the robot's points if it stood still; return which shape owns each point, or -1."""
        track = self._tracks[str(episode.path)]
        robot = load_robot(track.urdf)
        owner = surface_links(
            robot,
            surface,
            points.p_m.astype(np.float64),
            points.normals.astype(np.float64),
        )
        if track.is_stationary(stamp_ns):
            poses = link_poses(robot, track.at(stamp_ns))
            for link in {surface.links[index] for index in np.unique(owner[owner >= 0])}:
                mine = np.isin(owner, [i for i, name in enumerate(surface.links) if name == link])
                T_link_base, own = se3.invert(poses[link]), points.take(mine)
                moved = replace(
                    own,
                    p_m=as_float32(se3.apply(T_link_base, own.p_m.astype(np.float64))),
                    normals=as_float32(own.normals @ T_link_base[:3, :3].T),
                )
                seen = SeenLink(points=moved, R_base_link=poses[link][:3, :3])
                self._seen.setdefault(link, []).append(seen)
        return owner

    def links(self, max_splats: int) -> LitLinks:
        """Gaussians of each link that was seen, in the link's frame, and the light on them.

        They lie on the shapes of the description where these fit what was measured; else what was
        measured is fused.

        Args:
            max_splats: Of the whole fit.
        """
        total = sum(len(item.points.p_m) for seen in self._seen.values() for item in seen)
        clouds = {}
        shapes = self._shapes()
        lighting = link_lighting(shapes, self._seen)
        area_m2 = sum(surface_area_m2(shapes.get(link, [])) for link in self._seen)
        spacing_m = float(np.sqrt(area_m2 / (ROBOT_SHARE * max_splats)))
        for link, seen in sorted(self._seen.items()):
            sets = own_colors(shapes.get(link, []), seen, lighting)
            count = sum(len(item.p_m) for item in sets)
            if count < MIN_POINTS:
                continue
            own = shapes.get(link)
            finest_m = float(np.sqrt(surface_area_m2(own or []) / FEWEST))
            cloud = None if own is None else on_surface(own, sets, min(spacing_m, finest_m))
            if cloud is not None:
                clouds[link] = cloud
                continue
            budget = max(int(ROBOT_SHARE * max_splats * count / total), 1)
            with suppress(NoSurfaceError):
                clouds[link] = fuse(sets, max(round(budget * (1 - UNUSED)), 1))
        return LitLinks(clouds=clouds, lighting=lighting)

    def _shapes(self) -> dict[str, list[Mesh]]:
        """Shapes of the links by name, where all episodes have one description."""
        urdfs = {track.urdf for track in self._tracks.values()}
        if len(urdfs) != 1:
            return {}
        shapes: dict[str, list[Mesh]] = {}
        for item in link_surfaces(load_robot(urdfs.pop())):
            shapes.setdefault(item.link, []).append((item.vertices_m, item.triangles))
        return shapes

    def joined(
        self, links: LitLinks, cloud: GaussianCloud, episode: Episode, stamp_ns: int
    ) -> GaussianCloud:
        """Put the robot into a scene as it stood at an instant of an episode."""
        track = self._tracks.get(str(episode.path))
        if track is None or not links.clouds or not track.covers(stamp_ns):
            return cloud
        robot = posed(links.clouds, track.at(stamp_ns), track.urdf, links.lighting)
        return concatenate([cloud, robot])


def robot_mask(
    surface: PosedSurface,
    camera: Camera,
    T_base_camera: Float[np.ndarray, "4 4"],
    depth_m: Float[np.ndarray, "height width"],
) -> Bool[np.ndarray, "height width"]:
    """Pixels that show the posed robot, grown by two; not those with something in front of it.

    Args:
        depth_m: What the camera measured; 0 is "not measured" and hides nothing.
    """
    expected = surface.depth_along(camera.rays(), T_base_camera)
    hidden = (depth_m > 0) & (depth_m < expected - IN_FRONT_M)
    around = np.ones((2 * GROW_PX + 1, 2 * GROW_PX + 1), dtype=bool)
    return np.asarray(binary_dilation(np.isfinite(expected) & ~hidden, around))


MAX_POSTURES = 24


def find_robot(choices: Sequence[FrameChoice]) -> RobotFrames:
    """Say where the robot is in the frames of a rebuild, if that can be said.

    Joints say it where the frames' root is the robot's base.
    """
    root = root_frame(choices[0])
    episodes = list({choice.episode.path: choice.episode for choice in choices}.values())
    if root in {recorded_robot(episode).base_frame for episode in episodes}:
        return RobotFrames(episodes)
    remark = (
        f"the scene's root is {root!r}, not the robot's base: robot-gst calibrate RUN --cameras "
        "finds where cameras are to it"
    )
    return RobotFrames([], remark)


def write_robot(run: RunFolder, frames: RobotFrames, links: LitLinks) -> dict[str, Any]:
    """Write ``robot/<link>.ply`` and return what ``scene.json`` says about the robot."""
    links_record, lighting = write_links(run, links.clouds), links.lighting.to_record()
    return {"robot": {"remark": frames.remark, "links": links_record, "lighting": lighting}}
