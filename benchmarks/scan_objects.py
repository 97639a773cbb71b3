"""A scan of the stand-in cell taken apart as ``rebuild`` does it, with the truth beside it."""

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from localise_cell import Start, look_around
from scipy.ndimage import binary_erosion

from bridge.episode.streams import RgbdFrame
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from bridge.task.meshes.catalogue import object_mesh
from twin.scene.fit.initialise import fuse
from twin.scene.fit.optimise import fit
from twin.scene.frames.rgbd import DepthLimits, FrameSurface, TrainingView, training_view
from twin.scene.gaussians import GaussianCloud, moved_cloud
from twin.scene.localise.objects import MAX_VIEWS, localise_objects
from twin.scene.localise.result import LocalisedObject
from twin.scene.objects.decompose import ObjectSplats, object_splats
from twin.scene.raster.rasteriser import RasterConfig, Rasteriser
from twin.scene.settings import FitConfig, InitialiseConfig
from twin.scene.shape.from_training import shapes_of
from twin.scene.shape.known import shape_mesh
from twin.scene.shape.mesh import volume_m3
from twin.scene.shape.reconstruct import ObjectShape

LIMITS = DepthLimits(max_depth_m=5.0, flying_fraction=0.03)
GRIPPER_M = 0.28
"""The gripper hangs into the wrist camera's frames nearer than this; ``rebuild`` knows it by the
joints."""
STRIDE = 2
TURNED = Camera(width=160, height=160, fx=200.0, fy=200.0, cx=80.0, cy=80.0)
Mesh = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True, kw_only=True)
class Scanned:
    """What a scan gave."""

    start: Start
    views: list[TrainingView]
    cloud: GaussianCloud
    localised: dict[str, LocalisedObject]
    poses: dict[str, np.ndarray]
    shapes: dict[str, ObjectShape | str]

    def closed(self, key: str) -> ObjectSplats | None:
        """An object's Gaussians, on all of its surface."""
        model, T = self.start.task.objects[key], self.poses[key]
        return object_splats(model, self.shapes[key], self.views, T)


def take_scan(task_name: str, seed: int, *, iterations: int = 0, honest: bool = False) -> Scanned:
    """Scan a start, fuse and fit it, find the objects and reconstruct them.

    Args:
        iterations: Images to fit the Gaussians to; 0 leaves them as fused.
        honest: A laboratory that hides nothing.
    """
    start = look_around(task_name, seed, honest=honest)
    wrist = [frame for frame in start.frames if frame.camera_id == "wrist"]
    others = [frame for frame in start.frames if frame.camera_id != "wrist"]
    surfaces = [FrameSurface(f, LIMITS) for f in [*map(without_gripper, wrist), *others]]
    views = [training_view(surface) for surface in surfaces]
    config = InitialiseConfig()
    cloud = fuse([surface.points(STRIDE) for surface in surfaces], config.first_splats)
    if iterations:
        settings = FitConfig(iterations=iterations, threads=1)
        cloud = fit(cloud, views, settings, lambda *_: None, max_splats=config.max_splats).cloud
    chosen = [wrist[k] for k in np.linspace(0, len(wrist) - 1, MAX_VIEWS).round().astype(int)]
    localised = localise_objects([*chosen, *others], start.task)
    poses = {
        k: item.T_base_object for k, item in localised.items() if item.T_base_object is not None
    }
    return Scanned(
        start=start,
        views=views,
        cloud=cloud,
        localised=localised,
        poses=poses,
        shapes=shapes_of(views, start.task.objects, poses),
    )


def without_gripper(frame: RgbdFrame) -> RgbdFrame:
    """The frame without what is nearer than anything on the table."""
    return replace(frame, depth_m=np.where(frame.depth_m > GRIPPER_M, frame.depth_m, 0.0))


def true_mesh(start: Start, key: str) -> Mesh:
    """The object as it really is, deformed as it lies, in its own frame."""
    model = start.task.objects[key]
    if key in start.skins_m:
        T_object_base = se3.invert(start.Ts_base_object[key])
        return se3.apply(T_object_base, start.skins_m[key]), object_mesh(model).triangles
    return shape_mesh(model)


@dataclass(frozen=True, kw_only=True)
class ShapeScore:
    """How one reconstructed object compares with what it is."""

    watertight: bool
    mean_error_m: float
    """Of the true surface to the reconstructed one, after laying one onto the other: where the
    object is, is another question."""
    volume_ratio: float


def score_shape(scan: Scanned, key: str) -> ShapeScore | None:
    """Compare with the true mesh; None without a shape."""
    import cast_views

    shape = scan.shapes.get(key, "not found")
    if isinstance(shape, str):
        print(f"  {key}: {shape}")
        return None
    truth = true_mesh(scan.start, key)
    laid = laid_onto((shape.vertices_m, shape.faces), truth)
    mean, _ = cast_views.mean_error_m(laid, truth)
    return ShapeScore(
        watertight=shape.is_watertight,
        mean_error_m=mean,
        volume_ratio=shape.volume_m3 / abs(volume_m3(*truth)),
    )


def laid_onto(mesh: Mesh, reference: Mesh) -> Mesh:
    """The mesh after point-to-plane steps onto a reference that is millimetres away (Open3D)."""
    import open3d as o3d

    def cloud(of: Mesh) -> o3d.geometry.PointCloud:
        triangles = o3d.geometry.TriangleMesh(
            o3d.utility.Vector3dVector(of[0]), o3d.utility.Vector3iVector(np.asarray(of[1], "i4"))
        )
        triangles.compute_triangle_normals()
        o3d.utility.random.seed(0)
        return triangles.sample_points_uniformly(6000, use_triangle_normal=True)

    registration = o3d.pipelines.registration
    found = registration.registration_icp(
        cloud(mesh),
        cloud(reference),
        0.01,
        np.eye(4),
        registration.TransformationEstimationPointToPlane(),
        registration.ICPConvergenceCriteria(max_iteration=40),
    )
    return se3.apply(found.transformation, mesh[0]), mesh[1]


@dataclass(frozen=True, kw_only=True)
class TurnedScore:
    """How an object looks that is turned over."""

    see_through: float
    """Share of the pixels of its silhouette that let more than half through, in the worst turn."""
    seen_error: float
    """Mean colour over its pixels of a view against the recorded one, worst channel, 0..255; the
    median over views."""
    hidden_error: float
    """Mean hue of what no view saw against that of the task file."""


def score_turned(scan: Scanned, key: str) -> TurnedScore | None:
    """Turn an object about; None where it was not closed."""
    shape = scan.shapes.get(key)
    splats = scan.closed(key) if isinstance(shape, ObjectShape) else None
    if splats is None or not isinstance(shape, ObjectShape):
        return None
    cloud, T = splats.cloud, splats.T_base_object
    rasteriser = Rasteriser(RasterConfig(threads=1))
    mesh = (shape.vertices_m, shape.faces)
    through = []
    for turn in product((-1, 1), repeat=3):
        away = 4.0 * float(np.linalg.norm(shape.vertices_m, axis=1).max())
        T_object_camera = se3.look_at(
            away * np.array(turn) / np.sqrt(3), np.zeros(3), np.array([0.0, 0.0, 1.0])
        )
        inside = np.isfinite(_depth(mesh, T_object_camera, TURNED))
        alpha = rasteriser.view(cloud, TURNED, T_object_camera).alpha
        through.append(float((alpha[inside] < 0.5).mean()))
    placed, errors = moved_cloud(cloud, T), []
    for view in scan.views:
        shown = scan_mask(view, mesh, T)
        if shown.sum() < 100:
            continue
        drawn = rasteriser.view(placed, view.full.camera, view.T_base_color).image[shown]
        recorded = np.moveaxis(view.full.image(), 0, -1)[shown]
        errors.append(255 * float(np.abs((drawn - recorded).mean(axis=0)).max()))
    error, true = 0.0, np.array(scan.start.task.objects[key].color_srgb)
    if cloud.completed.any():  # as bright as they are: nobody says how light falls there
        found = cloud.colors[cloud.completed].mean(axis=0)
        error = float(np.abs(found * true.sum() / found.sum() - true).max())
    return TurnedScore(
        see_through=max(through), seen_error=float(np.median(errors)), hidden_error=error
    )


def scan_mask(view: TrainingView, mesh: Mesh, T_base_object: np.ndarray) -> np.ndarray:
    """Pixels two or more inside an object's outline in which its surface was measured."""
    camera, measured = view.full.camera, view.full.depth_m
    expected = _depth(mesh, se3.invert(T_base_object) @ view.T_base_color, camera)
    near = np.abs(measured - np.where(np.isfinite(expected), expected, -1.0)) < 0.01
    return np.asarray(binary_erosion(near & (measured > 0), iterations=2))


def _depth(mesh: Mesh, T_mesh_camera: np.ndarray, camera: Camera) -> np.ndarray:
    import cast_views
    import open3d as o3d

    directions = camera.rays() @ T_mesh_camera[:3, :3].T
    origins = np.broadcast_to(T_mesh_camera[:3, 3], directions.shape)
    rays = np.concatenate([origins, directions], axis=-1).astype(np.float32)
    return np.asarray(
        cast_views.ray_scene([mesh]).cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy()
    )
