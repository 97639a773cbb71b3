"""Objects of a scene, each in its own frame, and the background without them.

The background is fitted to what shows no object. An object is made from the views of one episode
alone, the first that shows it, so that scans of several tasks make one library: its mesh is
reconstructed from these views where they allow it, otherwise it is the known shape of the task
file, and ``shape_source`` says so; its Gaussians are set on the mesh, all around it. Table under
objects that no scan saw is filled with the distance-weighted mean of the table around: a guess
that keeps renders free of black holes.
"""

import json
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from bridge.episode import provenance
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder, check_episode_id
from bridge.errors import InvalidRecordError
from bridge.geometry import se3
from bridge.task.task_file import ObjectModel
from bridge.terminal import Output
from bridge.whole_file import write_whole
from twin.scene.fit.initialise import flat_gaussians
from twin.scene.fit.lighting import EVEN, Lighting
from twin.scene.frames.rgbd import TrainingView
from twin.scene.gaussians import GaussianCloud, concatenate, moved_cloud, read_ply, write_ply
from twin.scene.objects.closing import closed_object
from twin.scene.objects.placement import Placements
from twin.scene.shape.from_training import ObjectViews, is_known, shapes_of, write_static
from twin.scene.shape.known import shape_mesh
from twin.scene.shape.mesh import mesh_ply
from twin.scene.shape.reconstruct import ObjectShape
from twin.scene.shape.sdf import SdfGrid
from twin.scene.store.folder import UnreadableSceneError
from twin.scene.store.library import MESH, SDF, TASK_SHAPE, objects_folder

SPACING_M, WIDER = 0.004, 1.4
"""Of Gaussians that fill holes, and how much wider than that they are."""
GROWN_M = 0.018
"""How far beyond the footprint holes are looked for: what is left out reaches to the halo."""
TABLE_M = 0.008
"""Gaussians this near z = 0 are table."""
NEIGHBOURS = 12
UP = np.array([0.0, 0.0, 1.0])


def fill_footprint(
    background: GaussianCloud, model: ObjectModel, T_base_object: Float[np.ndarray, "4 4"]
) -> GaussianCloud:
    """Flat Gaussians on the table wherever the background leaves a hole under an object.

    Returns:
        The filling alone, marked as completed; empty where the table was seen, or where there is
        none around.
    """
    half = np.array(model.size_m[:2]) / 2 + GROWN_M
    steps = [np.arange(-h, h + SPACING_M / 2, SPACING_M) for h in half]
    local = np.stack([*np.meshgrid(*steps), np.zeros((len(steps[1]), len(steps[0])))], axis=-1)
    xy = se3.apply(T_base_object, local.reshape(-1, 3))[:, :2]
    means = background.means_m.astype(np.float64)
    reach = float(np.linalg.norm(half)) + 0.03
    near = np.linalg.norm(means[:, :2] - T_base_object[:2, 3], axis=1) < reach
    table = np.flatnonzero(near & (np.abs(means[:, 2]) < TABLE_M))
    if len(table) < NEIGHBOURS:
        return background.take(np.zeros(0, dtype=np.int64))
    distance, ids = cKDTree(means[table, :2]).query(xy, k=NEIGHBOURS)
    holes = distance[:, 0] > SPACING_M
    weight = 1.0 / distance[holes] ** 2
    weight /= weight.sum(axis=1, keepdims=True)
    around = table[ids[holes]]
    z = (weight * means[around, 2]).sum(axis=1)
    colors = (weight[..., None] * background.colors[around]).sum(axis=1)
    sizes = np.full(len(z), WIDER * SPACING_M)
    up = np.tile(UP, (len(z), 1))
    return flat_gaussians(np.column_stack([xy[holes], z]), up, colors, sizes).as_completed()


UNDER_M = 0.008
"""Background this far below an object is covered by it."""
BESIDE_M, LOWERED_M = 0.02, 0.002
"""Table this near to an object is drawn so far below z = 0."""
TRANSPARENT_LOGIT = -30.0
OBJECT_VERSION = 4


@dataclass(frozen=True, kw_only=True)
class ObjectSplats:
    """One object's Gaussians in its own frame."""

    cloud: GaussianCloud
    T_base_object: Float[np.ndarray, "4 4"]
    """Where it was scanned: as localised, like in every trial."""
    sdf: SdfGrid | None = None
    """Distances to its reconstructed surface; None where there is none."""


def uncovered(
    background: GaussianCloud,
    objects: Mapping[str, ObjectSplats],
    Ts_base_object: Mapping[str, Float[np.ndarray, "4 4"]],
) -> GaussianCloud:
    """The background, transparent where closed objects stand in or on it, lowered beside them."""
    hidden, beside = covered(background, objects, Ts_base_object)
    return lowered(without(background, hidden), beside)


def lowered(cloud: GaussianCloud, beside: Bool[np.ndarray, " num_splats"]) -> GaussianCloud:
    """Some of a table's Gaussians below it: as measured they would be drawn over objects' feet."""
    means = cloud.means_m.copy()
    means[beside, 2] = np.minimum(means[beside, 2], -LOWERED_M)
    return replace(cloud, means_m=means)


def without(cloud: GaussianCloud, hidden: Bool[np.ndarray, " num_splats"]) -> GaussianCloud:
    """The same Gaussians, some of them transparent."""
    logits = np.where(hidden, np.float32(TRANSPARENT_LOGIT), cloud.opacities_logit)
    return replace(cloud, opacities_logit=logits)


def covered(
    background: GaussianCloud,
    objects: Mapping[str, ObjectSplats],
    Ts_base_object: Mapping[str, Float[np.ndarray, "4 4"]],
) -> Bool[np.ndarray, "2 num_splats"]:
    """Which Gaussians lie in a closed object or just under it, and which of the table beside it."""
    means, found = background.means_m, np.zeros((2, len(background)), dtype=bool)
    for name, T in Ts_base_object.items():
        sdf = objects[name].sdf
        if sdf is None:
            continue
        reach_m = sdf.voxel_m * float(np.linalg.norm(sdf.values_m.shape)) + BESIDE_M
        near = np.ones(len(means), dtype=bool)
        for axis in range(3):
            near &= np.abs(means[:, axis] - np.float32(T[axis, 3])) < reach_m
        ids = np.flatnonzero(near)
        p = se3.apply(se3.invert(T), means[ids].astype(np.float64))
        there = sdf.may_hold(p, BESIDE_M)
        ids, lifts_m = ids[there], np.multiply.outer((0.0, UNDER_M / 2, UNDER_M), T[2, :3])
        distance_m = sdf.distance(p[there] + lifts_m[:, None]).min(axis=0)
        found[0, ids] |= distance_m < 0
        found[1, ids] |= (distance_m < BESIDE_M) & (np.abs(means[ids, 2]) < TABLE_M)
    return found


@dataclass(frozen=True, kw_only=True)
class LibraryObject:
    """One object as the views of one episode show it."""

    model: ObjectModel
    splats: ObjectSplats
    shape: ObjectShape | str
    """Reconstructed, in the frame of the object, or why not: it has the task's shape then."""
    episode_id: str
    """Whose views it was made from."""

    def write(self, place: Path) -> dict[str, Any]:
        """Write Gaussians, mesh and ``object.json``, and return what ``scene.json`` says.

        A reconstructed object also gets ``sdf.npz``, in the object frame.
        """
        place.mkdir(parents=True, exist_ok=True)
        write_ply(place / "gaussians.ply", self.splats.cloud)
        names, geometry = self._write_geometry(place)
        about = {
            "schema_version": OBJECT_VERSION,
            "id": self.model.id,
            "scanned_in": self.episode_id,
            "frame": "all files of this folder are in the object frame",
            "num_splats": len(self.splats.cloud),
            "num_completed": int(self.splats.cloud.completed.sum()),
            "T_base_object": se3.pose_record(self.splats.T_base_object),
            **geometry,
        }
        about["files"] = {
            name: provenance.hash_file(place / name) for name in ("gaussians.ply", *names)
        }
        write_whole(place / "object.json", (json.dumps(about, indent=2) + "\n").encode())
        hashed = provenance.hash_file(place / "object.json")
        told = ("scanned_in", "num_splats", "num_completed", "T_base_object", "shape_source")
        return {
            "folder": f"objects/{place.name}",
            **{name: about[name] for name in told},
            "files": {**about["files"], "object.json": hashed},
        }

    def _write_geometry(self, place: Path) -> tuple[list[str], dict[str, Any]]:
        """Write the reconstructed shape, or the known one with the reason why."""
        shape = self.shape
        if isinstance(shape, str):
            write_whole(place / MESH, mesh_ply(*shape_mesh(self.model)))
            return [MESH], {"shape_source": TASK_SHAPE, "shape_remark": shape}
        write_whole(place / MESH, mesh_ply(shape.vertices_m, shape.faces))
        shape.sdf.save(place / SDF)
        made = "stated by the task, seen in" if is_known(self.model) else "reconstructed from"
        geometry = {
            "watertight": shape.is_watertight,
            "volume_m3": shape.volume_m3,
            "voxel_m": shape.sdf.voxel_m,
            "truncation_m": shape.truncation_m,
            "num_views": shape.num_views,
        }
        source = f"{made} {shape.num_views} views"
        return [MESH, SDF], {"shape_source": source, "geometry": geometry}


@dataclass(frozen=True, kw_only=True)
class Decomposition:
    """A scene in parts; without objects where the placements' remark says why."""

    background: GaussianCloud
    """What ``background.ply`` holds: the table under the objects is filled in."""
    placements: Placements
    library: Mapping[str, LibraryObject] = field(default_factory=dict)

    def write(
        self,
        run: RunFolder,
        views: Sequence[TrainingView],
        views_of: Callable[[Episode], Sequence[TrainingView]],
    ) -> dict[str, Any]:
        """Write ``objects/`` and ``sdf.npz``, and return what ``scene.json`` says about them."""
        folder = objects_folder(run)
        shutil.rmtree(folder, ignore_errors=True)
        scans = [
            ObjectViews(views=views_of(item.episode), task=item.task, Ts_base_object=item.poses)
            for item in self.placements.by_episode.values()
        ]
        return {
            "objects": {key: item.write(folder / key) for key, item in self.library.items()},
            "objects_remark": self.placements.remark,
            "sdf": write_static(run.scene_dir, views, scans),
        }

    @property
    def objects(self) -> dict[str, ObjectSplats]:
        """All objects, each with the place where it was scanned."""
        return {key: item.splats for key, item in self.library.items()}

    def surfaces_m(self) -> dict[str, Float[np.ndarray, "_ 3"]]:
        """Vertices of the reconstructed objects where they were scanned."""
        return {
            key: se3.apply(item.splats.T_base_object, item.shape.vertices_m)
            for key, item in self.library.items()
            if isinstance(item.shape, ObjectShape)
        }

    def as_seen_in(self, episode: Episode) -> GaussianCloud:
        """The scene as an episode of the sources has it: with its own objects alone."""
        placement = self.placements.by_episode.get(episode.path)
        poses = {} if placement is None else placement.poses
        places = {key: T for key, T in poses.items() if key in self.library}
        bare = uncovered(self.background, self.objects, places)
        own = [moved_cloud(self.library[key].splats.cloud, T) for key, T in places.items()]
        return concatenate([bare, *own])


def decompose(
    placements: Placements,
    cloud: GaussianCloud,
    views_of: Callable[[Episode], Sequence[TrainingView]],
    output: Output,
    lighting: Lighting = EVEN,
) -> Decomposition:
    """Make each object from the first episode that shows it, and fill the table underneath."""
    library: dict[str, LibraryObject] = {}
    placed = list(placements.by_episode.values())
    left = np.ones(len(cloud), dtype=bool)  # but what the fit left where pixels were masked
    for placement in placed:
        left &= ~placement.owns(cloud.means_m)
    if placed:
        left &= ~np.logical_and.reduce([each.covers(cloud.means_m) for each in placed])
    cloud = cloud.take(left)
    filling: list[GaussianCloud] = []
    for placement in placed:
        views, poses = views_of(placement.episode), placement.poses
        models = placement.task.objects
        wanted = [key for key in poses if key not in library]
        with output.progress("reconstruct objects", len(wanted)) as advance:
            shapes = shapes_of(views, models, poses, wanted, advance=advance)
        for key in wanted:
            splats = object_splats(models[key], shapes[key], views, poses[key], lighting)
            if splats is not None:
                library[key] = LibraryObject(
                    model=models[key],
                    splats=splats,
                    shape=shapes[key],
                    episode_id=placement.episode.info.id,
                )
        for key, T in poses.items():
            filling.append(fill_footprint(concatenate([cloud, *filling]), models[key], T))
    if placements.remark:
        output.say(placements.remark)
    return Decomposition(
        background=concatenate([cloud, *filling]), placements=placements, library=library
    )


def object_splats(
    model: ObjectModel,
    shape: ObjectShape | str,
    views: Sequence[TrainingView],
    T_base_object: Float[np.ndarray, "4 4"],
    lighting: Lighting = EVEN,
) -> ObjectSplats | None:
    """Gaussians on all of an object's surface; None where no view shows it.

    On the task's shape of what is rigid: views leave rims ragged. On what was reconstructed of the
    rest.
    """
    if is_known(model) or isinstance(shape, str):
        mesh = shape_mesh(model)
    else:
        mesh = shape.vertices_m, shape.faces
    cloud = closed_object(mesh, views, T_base_object, lighting)
    if cloud is None:
        return None
    sdf = None if isinstance(shape, str) else shape.sdf
    return ObjectSplats(cloud=cloud, T_base_object=T_base_object, sdf=sdf)


def read_objects(
    run: RunFolder, record: Mapping[str, Any], wanted: Iterable[str] | None = None
) -> dict[str, ObjectSplats]:
    """Load objects that ``scene.json`` lists, or the wanted ones, each in its own frame."""
    objects = {}
    for key in record.get("objects", {}) if wanted is None else wanted:
        folder = objects_folder(run) / check_episode_id(key)
        has_sdf, path = SDF in record["objects"][key].get("files", {}), folder / "object.json"
        try:
            T = se3.pose_from_record(json.loads(path.read_text())["T_base_object"])
        except (OSError, ValueError, KeyError, TypeError, InvalidRecordError) as error:
            raise UnreadableSceneError(path=path, found=f"no pose ({error})") from error
        objects[key] = ObjectSplats(
            cloud=read_ply(folder / "gaussians.ply"),
            T_base_object=T,
            sdf=SdfGrid.load(folder / SDF) if has_sdf else None,
        )
    return objects
