"""Things on a table made of primitives, ray-cast by Open3D: the truth for semantics."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
import open3d

from bridge.episode.streams import RgbdFrame
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from twin.naming.things import Mask
from twin.scene.fit.initialise import fuse
from twin.scene.frames.rgbd import DepthLimits, FrameSurface
from twin.scene.gaussians import GaussianCloud
from twin.scene.semantics.lift import Viewpoint

CAMERA = Camera(width=320, height=240, fx=285.0, fy=285.0, cx=160.0, cy=120.0)
TABLE = 0
LIGHT = np.array([0.3, -0.4, 0.87])


@dataclass(frozen=True)
class Piece:
    """One primitive: whose it is, which part, its colour and its triangles."""

    instance: int
    part: str
    color: tuple[float, float, float]
    vertices: np.ndarray
    faces: np.ndarray


@dataclass(frozen=True)
class Shot:
    """One frame with the truth about its pixels."""

    frame: RgbdFrame
    instance: np.ndarray
    piece: np.ndarray
    """Index of the primitive, -1 where the ray hits nothing."""

    @property
    def viewpoint(self) -> Viewpoint:
        return Viewpoint(camera=self.frame.color_camera, T_base_camera=self.frame.T_base_color)


@dataclass(frozen=True)
class World:
    """Primitives, frames that train, frames that are held out, and the fused Gaussians."""

    pieces: list[Piece]
    names: dict[int, str]
    train: list[Shot]
    held_out: list[Shot]
    cloud: GaussianCloud

    def masks(self, shot: Shot) -> list[Mask]:
        """The true masks of a frame."""
        return [
            Mask(image=shot.instance == number, label=name)
            for number, name in self.names.items()
            if (shot.instance == number).any()
        ]

    @cached_property
    def _nearest(self) -> np.ndarray:
        return nearest_piece(self.pieces, self.cloud.means_m)

    def true_pieces(self) -> np.ndarray:
        """The primitive whose surface each Gaussian is nearest to."""
        return self._nearest

    def true_instances(self) -> np.ndarray:
        """The instance each Gaussian belongs to."""
        return np.array([piece.instance for piece in self.pieces])[self._nearest]


def nearest_piece(pieces: Sequence[Piece], p_m: np.ndarray) -> np.ndarray:
    """Index of the primitive whose surface is nearest to each point."""
    distances = []
    for piece in pieces:
        distances.append(ray_scene([piece]).compute_distance(p_m.astype(np.float32)).numpy())
    return np.argmin(distances, axis=0)


def box(
    instance: int,
    centre: Sequence[float],
    size: Sequence[float],
    color: tuple[float, float, float],
    part: str = "",
    yaw_rad: float = 0.0,
) -> Piece:
    mesh = open3d.geometry.TriangleMesh.create_box(*size)
    vertices = np.asarray(mesh.vertices) - np.array(size) / 2
    turn = np.array(
        [[np.cos(yaw_rad), -np.sin(yaw_rad), 0], [np.sin(yaw_rad), np.cos(yaw_rad), 0], [0, 0, 1]]
    )
    faces = np.asarray(mesh.triangles)
    return Piece(instance, part, color, vertices @ turn.T + np.array(centre), faces)


def ellipsoid(
    instance: int,
    centre: Sequence[float],
    radii: Sequence[float],
    color: tuple[float, float, float],
    part: str = "",
) -> Piece:
    mesh = open3d.geometry.TriangleMesh.create_sphere(1.0, 24)
    vertices = np.asarray(mesh.vertices) * np.array(radii) + np.array(centre)
    return Piece(instance, part, color, vertices, np.asarray(mesh.triangles))


def rod(
    instance: int,
    start: Sequence[float],
    end: Sequence[float],
    radius: float,
    color: tuple[float, float, float],
    part: str = "",
) -> Piece:
    """A chain of spheres."""
    chain = [
        ellipsoid(instance, np.array(start) * (1 - t) + np.array(end) * t, [radius] * 3, color)
        for t in np.linspace(0, 1, 9)
    ]
    vertices = np.concatenate([item.vertices for item in chain])
    step = len(chain[0].vertices)
    faces = np.concatenate([item.faces + k * step for k, item in enumerate(chain)])
    return Piece(instance, part, color, vertices, faces)


RED, BLUE, YELLOW, GREEN, BROWN = (
    (0.80, 0.12, 0.10),
    (0.13, 0.30, 0.75),
    (0.95, 0.80, 0.12),
    (0.15, 0.55, 0.25),
    (0.45, 0.30, 0.20),
)


def table(size_m: float = 0.7) -> Piece:
    return box(TABLE, [0, 0, -0.01], [size_m, size_m, 0.02], (0.62, 0.60, 0.58), "table")


def open_box(
    instance: int, x: float, y: float, color: tuple[float, float, float], wall_m: float = 0.006
) -> list[Piece]:
    """12 x 12 x 6 cm outside."""
    half, top = 0.06, 0.06
    side = half - wall_m / 2
    inner = 2 * (half - wall_m)
    pieces = [box(instance, [x, y, wall_m / 2], [inner, inner, wall_m], color, "floor")]
    for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        size = [wall_m if dx else 2 * half, wall_m if dy else 2 * half, top]
        pieces.append(box(instance, [x + dx * side, y + dy * side, top / 2], size, color, "walls"))
    return pieces


def duck(instance: int, x: float, y: float, yaw_rad: float = 0.0) -> list[Piece]:
    """Body, head and beak, 10 cm long."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)

    def at(forward: float, z: float) -> list[float]:
        return [x + c * forward, y + s * forward, z]

    return [
        ellipsoid(instance, at(0.0, 0.028), [0.036, 0.036, 0.030], YELLOW, "body"),
        ellipsoid(instance, at(0.020, 0.068), [0.020, 0.020, 0.020], YELLOW, "head"),
        ellipsoid(instance, at(0.042, 0.066), [0.009, 0.009, 0.005], (0.95, 0.5, 0.1), "head"),
    ]


def basket(instance: int, x: float, y: float) -> list[Piece]:
    """An open box with an arched handle and a rim of another shade."""
    color, dark = (0.70, 0.52, 0.30), (0.5, 0.35, 0.2)
    pieces = open_box(instance, x, y, color)
    for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        ends = (
            [x + dx * 0.057 - dy * 0.06, y + dy * 0.057 - dx * 0.06, 0.06],
            [x + dx * 0.057 + dy * 0.06, y + dy * 0.057 + dx * 0.06, 0.06],
        )
        pieces.append(rod(instance, *ends, 0.0065, dark, "rim"))
    angles = np.linspace(0, np.pi, 9)
    for a, b in pairwise(angles):
        ends = [[x + 0.056 * np.cos(t), y, 0.063 + 0.06 * np.sin(t)] for t in (a, b)]
        pieces.append(rod(instance, *ends, 0.006, dark, "handle"))
    return pieces


def tabletop_pieces() -> list[Piece]:
    return [
        table(),
        box(1, [-0.13, -0.10, 0.02], [0.04, 0.04, 0.04], RED, yaw_rad=0.4),
        *open_box(2, 0.10, 0.08, BLUE),
        ellipsoid(3, [-0.10, 0.11, 0.035], [0.035] * 3, GREEN),
        *duck(4, 0.10, -0.12, 0.6),
    ]


TABLETOP_NAMES = {1: "red cube", 2: "blue open container", 3: "green ball", 4: "yellow thing"}


def look(angle: float, height_m: float, radius_m: float = 0.42) -> np.ndarray:
    eye = np.array([radius_m * np.cos(angle), radius_m * np.sin(angle), height_m])
    return se3.look_at(eye, np.array([0.0, 0.0, 0.02]), np.array([0.0, 0.0, 1.0]))


def ray_scene(pieces: Sequence[Piece]) -> open3d.t.geometry.RaycastingScene:
    scene = open3d.t.geometry.RaycastingScene()
    for piece in pieces:
        scene.add_triangles(piece.vertices.astype(np.float32), piece.faces.astype(np.uint32))
    return scene


def shoot(
    scene: open3d.t.geometry.RaycastingScene,
    pieces: Sequence[Piece],
    T_base_camera: np.ndarray,
    index: int,
    noise_m: float,
    seed: int = 0,
) -> Shot:
    """Cast a ray through every pixel centre; shading is diffuse."""
    directions = CAMERA.rays() @ T_base_camera[:3, :3].T
    origins = np.broadcast_to(T_base_camera[:3, 3], directions.shape)
    hit = scene.cast_rays(np.concatenate([origins, directions], axis=-1).astype(np.float32))
    depth = hit["t_hit"].numpy().astype(np.float64)  # rays have z = 1: this is depth
    known = np.isfinite(depth)
    piece_ids = np.where(known, hit["geometry_ids"].numpy().astype(np.int64), -1)
    normals = hit["primitive_normals"].numpy()
    normals = np.where((normals * directions).sum(axis=-1, keepdims=True) > 0, -normals, normals)
    shade = 0.45 + 0.55 * np.clip(normals @ (LIGHT / np.linalg.norm(LIGHT)), 0, 1)
    colors = np.array([piece.color for piece in pieces])[piece_ids] * shade[..., None]
    rng = np.random.default_rng([seed, index])
    depth = np.where(known, depth, 0.0)
    noisy = depth + rng.normal(size=depth.shape) * noise_m * (depth / 0.5) ** 2
    frame = RgbdFrame(
        camera_id="scan",
        stamp_ns=index * 100_000_000,
        image_u8=np.where(known[..., None], np.rint(np.clip(colors, 0, 1) * 255), 0).astype(
            np.uint8
        ),
        depth_m=np.where(known, noisy, 0.0).astype(np.float32),
        color_camera=CAMERA,
        depth_camera=CAMERA,
        T_base_color=T_base_camera,
        T_base_depth=T_base_camera,
    )
    owners = np.array([piece.instance for piece in pieces])
    return Shot(frame, np.where(known, owners[piece_ids], 0), piece_ids)


def make_world(
    pieces: list[Piece],
    *,
    num_train: int = 20,
    num_held_out: int = 6,
    noise_m: float = 0.001,
    names: dict[int, str] | None = None,
) -> World:
    """Look from a ring at two heights, and fuse what the training frames saw."""
    total = num_train + num_held_out
    scene = ray_scene(pieces)
    shots = [
        shoot(
            scene,
            pieces,
            look(2 * np.pi * index * 0.381966, 0.26 + 0.16 * ((index * 7) % 3) / 2),
            index,
            noise_m,
        )
        for index in range(total)
    ]
    train, held_out = shots[:num_train], shots[num_train:]
    return World(pieces, names or TABLETOP_NAMES, train, held_out, fused(train))


def fused(shots: Sequence[Shot]) -> GaussianCloud:
    limits = DepthLimits(max_depth_m=2.0, flying_fraction=0.03)
    return fuse([FrameSurface(shot.frame, limits).points() for shot in shots], 45_000)


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / max((a | b).sum(), 1))
