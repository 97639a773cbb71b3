"""What the cell's cameras see of the twin while a policy acts."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from bridge.episode import streams
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from twin.policies.cell import Sight, TwinCell
from twin.policies.errors import PolicyError
from twin.policies.mapping import fitting
from twin.policies.shutter import ALWAYS, shutter_of
from twin.policies.starts import Start
from twin.policies.variation import ANGLE, POSITION, Drawn
from twin.replay.images import Drawable, mounting, set_up
from twin.robot.model import RobotModel, load_robot
from twin.robot.posture import Posture
from twin.scene.backdrop import Backdrop
from twin.scene.frames.camera_poses import base_tree, calibrated_tree_at
from twin.scene.gaussians import GaussianCloud, concatenate
from twin.scene.objects.decompose import covered, lowered, without
from twin.scene.raster.backend import open_rasteriser
from twin.scene.raster.rasteriser import Rasteriser, View
from twin.scene.standpoint import sized_camera
from twin.scene.store.calibration import read_calibration

Pictures = Mapping[str, UInt8[np.ndarray, "height width 3"]]
Gains = Mapping[str, tuple[float, float, float]]
"""Of red, green and blue, by camera."""
Places = Mapping[str, Float[np.ndarray, "4 4"]]
"""Of objects, ``T_base_object``."""
Nodes = Mapping[str, Float32[np.ndarray, "num_nodes 3"]]
"""Of soft objects."""


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


@dataclass(frozen=True, kw_only=True)
class Resting:
    """What stands still, composed once."""

    cloud: GaussianCloud
    objects: frozenset[str]
    """Those in it."""
    covered: Bool[np.ndarray, " num_splats"]
    """Background that they cover."""


class Canvas:
    """What one camera sees; one that stands still draws what rests once."""

    def __init__(self, place: Viewpoint, backdrop: Backdrop | None) -> None:
        """Nothing is drawn yet."""
        self._place, self._backdrop = place, backdrop
        self._rasteriser = open_rasteriser()
        self._under: tuple[GaussianCloud, Float32[np.ndarray, "5 height width"]] | None = None

    def picture(
        self,
        rest: GaussianCloud,
        over: Sequence[GaussianCloud],
        hidden: Bool[np.ndarray, " num_splats"] | None,
        T_base_tcp: Float[np.ndarray, "4 4"],
    ) -> UInt8[np.ndarray, "height width 3"]:
        """Colours alone: depth costs as much again, and no policy is sent it.

        Args:
            over: What moves.
            hidden: Which of what rests that covers.
        """
        camera, T = self._place.camera, self._place.T(T_base_tcp)
        carried = self._place.T_tcp_camera is not None
        if carried or not isinstance(self._rasteriser, Rasteriser):
            cloud = rest if hidden is None else without(rest, hidden)
            planes = self._rasteriser.draw_planes(concatenate([cloud, *over]), camera, T)
        else:
            if self._under is None or self._under[0] is not rest:
                self._under = rest, self._rasteriser.draw_planes(rest, camera, T)
            planes = self._under[1]
            if over:
                planes = self._rasteriser.draw_over(concatenate([*over]), planes, hidden)
        image = np.ascontiguousarray(np.moveaxis(planes[:3], 0, -1))
        view = View(image=image, depth_m=np.zeros_like(planes[4]), alpha=planes[4])
        if self._backdrop is not None:
            view = self._backdrop.behind(view, camera, T)
        return view.image_u8()


class TwinCameras:
    """Draws a cell through the cameras that recorded one of its episodes."""

    def __init__(
        self,
        run: RunFolder,
        start: Start,
        cameras: Sequence[str] = (),
        sizes: Mapping[str, tuple[int, int]] | None = None,
        drawn: Drawn | None = None,
        gains: Gains | None = None,
        *,
        live: bool = False,
    ) -> None:
        """Read the scene.

        Args:
            cameras: Ids; none: all that the episode has.
            sizes: Width and height in which the picture of a camera is to fit; others are drawn
                as they were recorded.
            drawn: Conditions that differ from the recorded ones.
            gains: Of the light, where it is another than when the scene was scanned.
            live: A person looks: pictures are of now, not as old as the cell's.
        """
        self._drawn = drawn or {}
        episode = Episode.open(start.episode_path)
        known = streams.camera_ids(episode)
        unknown = [name for name in cameras if name not in known]
        if unknown:
            raise PolicyError(
                f"no camera {', '.join(unknown)} in {episode.info.id}; it has: "
                f"{', '.join(known) or 'none'}"
            )
        self._drawable: Drawable = set_up(run, episode, start.scene)
        self._resting: Resting | None = None
        self._last: dict[str, bytes] = {}
        self.viewpoints = {
            name: _moved(
                _viewpoint(run, episode, start, name, (sizes or {}).get(name)), name, self._drawn
            )
            for name in cameras or known
        }
        self._gains = _varied(gains or {}, self._drawn, self.viewpoints)
        self.shutters = {
            name: ALWAYS if live else shutter_of(episode, name, start.stamp_ns)
            for name in self.viewpoints
        }
        self._newest: dict[str, UInt8[np.ndarray, "height width 3"]] = {}
        self._drawn_of: dict[str, Sight] = {}
        backdrop = self._drawable.parts.backdrop
        self._canvases = {name: Canvas(at, backdrop) for name, at in self.viewpoints.items()}

    def draw(self, cell: TwinCell) -> Pictures:
        """The newest picture of each camera that is there."""
        sights = {
            name: cell.sight(shutter.newest_ns(cell.t_ns))
            for name, shutter in self.shutters.items()
        }
        old = {name for name, sight in sights.items() if self._drawn_of.get(name) is not sight}
        for sight in {id(sights[name]): sights[name] for name in sights if name in old}.values():
            names = [name for name in sights if name in old and sights[name] is sight]
            self._newest |= self._taken(sight, names, cell.robot)
        self._drawn_of = sights
        return {name: self._newest[name].copy() for name in self.viewpoints}

    def _taken(self, sight: Sight, names: Sequence[str], robot: RobotModel) -> Pictures:
        places, nodes = sight.places, sight.nodes_m
        rest, parts = self._what_rests(places, nodes), self._drawable.parts
        moving = [name for name in parts.objects if name not in rest.objects]
        over = [self._object_at(name, places, nodes) for name in moving]
        if parts.links:
            posture = Posture(joints_rad=sight.joints_rad, width_m=sight.width_m)
            over.append(parts.robot_at(posture, self._drawable.urdf))
        hidden = self._covered(moving, places, nodes)[0] & ~rest.covered
        padded = np.zeros(len(rest.cloud), dtype=bool)
        padded[: len(hidden)] = hidden
        covered, T_base_tcp = padded if hidden.any() else None, robot.T_base_tcp(sight.joints_rad)
        pictures = {
            name: self._canvases[name].picture(rest.cloud, over, covered, T_base_tcp)
            for name in names
        }
        return lit(pictures, self._gains)

    def _what_rests(self, places: Places, nodes: Nodes) -> Resting:
        """As it was, unless some of it moved, or something else came to rest."""
        keys = {name: T.round(6).tobytes() for name, T in places.items()}
        keys |= {name: rows.tobytes() for name, rows in nodes.items()}
        last, self._last = self._last or keys, keys
        parts = self._drawable.parts
        resting = frozenset(name for name in parts.objects if keys.get(name) == last.get(name))
        if self._resting is None or self._resting.objects != resting:
            hidden, beside = self._covered(resting, places, nodes)
            clouds = [self._object_at(n, places, nodes) for n in parts.objects if n in resting]
            cloud = concatenate([lowered(without(parts.background, hidden), beside), *clouds])
            self._resting = Resting(cloud=cloud, objects=resting, covered=hidden)
        return self._resting

    def _object_at(self, name: str, places: Places, nodes: Nodes) -> GaussianCloud:
        if name in self._drawable.bindings and name in nodes:
            return self._drawable.bent(name, nodes)
        return self._drawable.parts.object_at(name, places)

    def _covered(
        self, names: Iterable[str], places: Places, nodes: Nodes
    ) -> Bool[np.ndarray, "2 num_splats"]:
        """Background that some of the objects cover, or beside them; soft ones cover none."""
        parts = self._drawable.parts
        rigid = [n for n in names if n not in self._drawable.bindings or n not in nodes]
        where = {name: places.get(name, parts.objects[name].T_base_object) for name in rigid}
        return covered(parts.background, parts.objects, where)


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


def _moved(place: Viewpoint, camera_id: str, drawn: Drawn) -> Viewpoint:
    """A camera that stands, or sits in the hand, elsewhere, seen along its own axes."""
    shift = np.array(drawn.get(f"camera.{camera_id}{POSITION}", (0.0, 0.0, 0.0)))
    turn = np.array(drawn.get(f"camera.{camera_id}{ANGLE}", (0.0, 0.0, 0.0)))
    T: Float[np.ndarray, "4 4"] = se3.from_rotation(se3.rotation_from_vector(turn), shift)
    mount = place.T_tcp_camera
    return replace(
        place,
        T_base_camera=place.T_base_camera @ T,
        T_tcp_camera=None if mount is None else mount @ T,
    )


def _varied(gains: Gains, drawn: Drawn, cameras: Iterable[str]) -> Gains:
    """Gains of the light with what ``drawn`` changes of it."""
    share = 1.0 + drawn.get("light", (0.0,))[0]
    if share == 1.0:
        return gains
    found = ((name, gains.get(name, (1.0, 1.0, 1.0))) for name in cameras)
    return {name: (share * red, share * green, share * blue) for name, (red, green, blue) in found}


def lit(pictures: Pictures, gains: Gains) -> Pictures:
    """Pictures as another light makes them."""
    found = dict(pictures)
    for name in gains.keys() & found.keys():
        image = np.rint(found[name] * np.array(gains[name], dtype=np.float32))
        found[name] = np.clip(image, 0, 255).astype(np.uint8)
    return found


def _fitted_in(camera: Camera, size: tuple[int, int]) -> Camera:
    """The same view, as large as fits."""
    width, height = fitting(camera.width, camera.height, size)
    return sized_camera(camera, f"{width}x{height}")
