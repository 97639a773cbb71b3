"""A fixed tabletop without any noise: what a fit reaches when only the fit is to blame.

pybullet's software renderer draws its own models (wooden table, KUKA arm, tray, duck, teddy,
bricks and blocks on a chequered floor) with exact poses and depth. 59 views on a wavy turn around
the table; every second one trains (30), those between are held out (29). The numbers below are
the generator: change one and it is another scene.
"""

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np

from bridge.episode.streams import RgbdFrame
from bridge.geometry import se3
from bridge.geometry.camera import Camera

NUM_VIEWS = 59
WIDTH, HEIGHT = 640, 480
FIELD_OF_VIEW_DEG, HELD_OUT_FIELD_OF_VIEW_DEG = 45.0, 40.0
"""Held-out views have the longer lens: with the same one, their corners show floor that no
training view saw, and nobody can be blamed for not knowing it."""
NEAR_M, FAR_M = 0.2, 8.0
SAMPLE_COLUMN, SAMPLE_ROW = 0.0, 1.0
"""Where in its pixel the renderer looks, from the upper left corner [px]; seen in its images."""
TABLE_M = 0.625
SEED = 20
LIGHT = {
    "lightDirection": [1.2, -0.9, 2.4],
    "lightColor": [1.0, 1.0, 1.0],
    "lightAmbientCoeff": 0.55,
    "lightDiffuseCoeff": 0.45,
    "lightSpecularCoeff": 0.05,
    "shadow": 0,
}
ARM_RAD = (0.4, 0.7, 0.0, -1.5, 0.0, 0.9, 0.0)
THINGS = (
    # file, x, y, yaw, roll, size
    ("tray/traybox.urdf", 0.34, 0.22, 0.3, 0.0, 0.5),
    ("duck_vhacd.urdf", 0.12, -0.22, 0.8, np.pi / 2, 2.2),
    ("teddy_vhacd.urdf", -0.12, 0.30, -0.5, np.pi / 2, 2.2),
)
BLOCKS = (
    *(("lego/lego.urdf", 2.0),) * 4,
    *(("cube_small.urdf", 1.0),) * 4,
    *(("block.urdf", 1.5),) * 4,
)
PALETTE = (
    *((0.85, 0.2, 0.15), (0.15, 0.45, 0.8), (0.95, 0.75, 0.1), (0.2, 0.6, 0.3)),
    *((0.6, 0.3, 0.65), (0.95, 0.5, 0.15), (0.9, 0.9, 0.88), (0.25, 0.25, 0.28)),
)


@dataclass(frozen=True, kw_only=True)
class CleanTabletop:
    """The views of the scene."""

    train: list[RgbdFrame]
    held_out: list[RgbdFrame]


def load(folder: Path) -> CleanTabletop:
    """Read the views from a cache folder, or draw them (a minute or two)."""
    name = hashlib.sha256(Path(__file__).read_bytes()).hexdigest()[:12]
    path = folder / f"clean_tabletop.{name}.npz"
    if not path.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        images, depths = draw(range(NUM_VIEWS))
        np.savez(path, images=images, depths=depths)
    with np.load(path, allow_pickle=False) as stored:
        images, depths = stored["images"], stored["depths"]
    frames = [frame_of(index, images[index], depths[index]) for index in range(NUM_VIEWS)]
    return CleanTabletop(train=frames[::2], held_out=frames[1::2])


def field_of_view_deg(index: int) -> float:
    """Vertical, of one view."""
    return HELD_OUT_FIELD_OF_VIEW_DEG if index % 2 else FIELD_OF_VIEW_DEG


def camera(index: int = 0) -> Camera:
    """The renderer's camera for one view, with our pixel centres at +0.5."""
    focal = HEIGHT / 2 / np.tan(np.radians(field_of_view_deg(index)) / 2)
    return Camera(
        width=WIDTH,
        height=HEIGHT,
        fx=focal,
        fy=focal,
        cx=WIDTH / 2 + 0.5 - SAMPLE_COLUMN,
        cy=HEIGHT / 2 + 0.5 - SAMPLE_ROW,
    )


def camera_pose(index: int) -> np.ndarray:
    """Pose ``T_base_camera`` of one view."""
    return look_at_table(index / NUM_VIEWS)


def look_at_table(along: float) -> np.ndarray:
    """Pose on a wavy path once around the table; ``along`` goes from 0 to 1."""
    turn = 2 * np.pi * along
    radius = 0.9 - 0.08 * np.sin(3 * turn)
    height = 1.65 + 0.15 * np.sin(3 * turn)
    eye = np.array([0.05 + radius * np.cos(turn), radius * np.sin(turn), height])
    return se3.look_at(eye, np.array([0.05, 0.0, 0.66]), np.array([0.0, 0.0, 1.0]))


def frame_of(index: int, image_u8: np.ndarray, depth_m: np.ndarray) -> RgbdFrame:
    """One view as a recording would give it."""
    T = camera_pose(index)
    return RgbdFrame(
        camera_id="clean",
        stamp_ns=1_000_000_000 + index * 100_000_000,
        image_u8=image_u8,
        depth_m=depth_m,
        color_camera=camera(index),
        depth_camera=camera(index),
        T_base_color=T,
        T_base_depth=T,
    )


def draw(indices: Iterable[int]) -> tuple[np.ndarray, np.ndarray]:
    """Colour (views x height x width x 3) and depth along the axis [m] of some views."""
    import pybullet

    client = pybullet.connect(pybullet.DIRECT)
    try:
        _build(pybullet)
        views = [
            _draw_one(pybullet, camera_pose(index), field_of_view_deg(index)) for index in indices
        ]
    finally:
        pybullet.disconnect(client)
    return np.stack([image for image, _ in views]), np.stack([depth for _, depth in views])


def _build(pybullet: ModuleType) -> None:
    import pybullet_data

    pybullet.setAdditionalSearchPath(pybullet_data.getDataPath())
    pybullet.loadURDF("plane.urdf")
    pybullet.loadURDF("table/table.urdf", useFixedBase=True)
    arm = pybullet.loadURDF("kuka_iiwa/model.urdf", [-0.55, 0.0, TABLE_M], useFixedBase=True)
    for joint, angle in enumerate(ARM_RAD):
        pybullet.resetJointState(arm, joint, angle)
    taken = [np.array([-0.55, 0.0])]
    for file, x, y, yaw, roll, size in THINGS:
        _put(pybullet, file, (x, y), (roll, 0.0, yaw), size)
        taken.append(np.array([x, y]))
    rng = np.random.default_rng(SEED)
    for number, (file, size) in enumerate(BLOCKS):
        spot = rng.uniform([-0.30, -0.42], [0.68, 0.42])
        while min(np.linalg.norm(spot - other) for other in taken) < 0.13:
            spot = rng.uniform([-0.30, -0.42], [0.68, 0.42])
        taken.append(spot)
        body = _put(pybullet, file, spot, (0.0, 0.0, rng.uniform(0, np.pi)), size)
        color = [*PALETTE[number % len(PALETTE)], 1.0]
        pybullet.changeVisualShape(body, -1, rgbaColor=color)


def _put(
    pybullet: ModuleType, file: str, spot: np.ndarray, rpy: tuple[float, float, float], size: float
) -> int:
    """Set a thing on the table."""
    turn = pybullet.getQuaternionFromEuler(rpy)
    body = pybullet.loadURDF(file, [*spot, 1.0], turn, globalScaling=size)
    lowest = pybullet.getAABB(body)[0][2]
    p, q = pybullet.getBasePositionAndOrientation(body)
    pybullet.resetBasePositionAndOrientation(body, [p[0], p[1], p[2] + TABLE_M - lowest], q)
    return body


def _draw_one(
    pybullet: ModuleType, T_base_camera: np.ndarray, field_of_view_deg: float
) -> tuple[np.ndarray, np.ndarray]:
    to_gl = np.diag([1.0, -1.0, -1.0, 1.0]) @ se3.invert(T_base_camera)
    projection = pybullet.computeProjectionMatrixFOV(
        field_of_view_deg, WIDTH / HEIGHT, NEAR_M, FAR_M
    )
    _, _, color, depth, _ = pybullet.getCameraImage(
        WIDTH,
        HEIGHT,
        viewMatrix=to_gl.T.ravel().tolist(),
        projectionMatrix=projection,
        renderer=pybullet.ER_TINY_RENDERER,
        **LIGHT,
    )
    image = np.asarray(color, dtype=np.uint8).reshape(HEIGHT, WIDTH, 4)[..., :3]
    ratio = np.asarray(depth, dtype=np.float64).reshape(HEIGHT, WIDTH)
    depth_m = FAR_M * NEAR_M / (FAR_M - (FAR_M - NEAR_M) * ratio)
    depth_m[ratio >= 1.0] = 0.0
    return np.ascontiguousarray(image), depth_m.astype(np.float32)


def measured_offset(frame: RgbdFrame) -> tuple[np.ndarray, float]:
    """How far the principal point is off [px], and what is then left of the floor's height [m].

    The floor is z = 0: each of its pixels gives one equation that is linear in the offset.
    """
    T, c = frame.T_base_depth, frame.depth_camera
    points = se3.apply(T, c.unproject(frame.depth_m.astype(np.float64)))
    floor = (np.abs(points[..., 2]) < 0.05) & (frame.depth_m > 0)
    z = frame.depth_m[floor].astype(np.float64)
    slopes = np.stack([-z / c.fx * T[2, 0], -z / c.fy * T[2, 1]], axis=1)
    offset, *_ = np.linalg.lstsq(slopes, -points[floor][:, 2], rcond=None)
    return offset, float(np.abs(points[floor][:, 2] + slopes @ offset).mean())
