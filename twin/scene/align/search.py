"""Where on a level surface the robot may stand: every yaw and place is tried.

A hypothesis is judged by looking: points of the posed robot are carried into the depth image and
compared with what was measured there. That needs no idea which points of the scene are robot,
counts what hides the robot as no evidence, and what is seen through it as evidence against.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from bridge.geometry import se3
from twin.robot.model import RobotModel
from twin.robot.surface import sample_surface
from twin.scene.align.plane import LevelPlane
from twin.scene.align.view import RobotView

NUM_YAWS = 60
STEP_M = 0.07
MAX_PLACES = 400
MARGIN_M = 0.15
"""The base may stand this far outside of what is seen of the surface."""
NUM_SAMPLES = 250
MAX_VIEWS = 3
CAP_M, FINE_CAP_M = 0.08, 0.04
"""Depth differences beyond are worth nothing; the first on the grid, then around its best."""
NUM_NEAR = 7
"""Yaws and places to each side of a hypothesis, tried in finer steps."""
SEEN_THROUGH = 0.3
"""What a point costs that the camera looks through, in units of a point that fits."""
APART_RAD = 0.35
APART_M = 0.12
"""Hypotheses nearer to each other than both of these are one."""
PER_PLANE = 8


@dataclass(frozen=True, kw_only=True)
class Hypothesis:
    """A rough guess of the robot's place."""

    T_base_source: Float[np.ndarray, "4 4"]
    score: float


def search(
    views: Sequence[RobotView], robot: RobotModel, planes: Sequence[LevelPlane]
) -> list[Hypothesis]:
    """Try 60 yaws and a grid of places on each plane; return distinct ones, best first.

    The base frame's z = 0 is taken to lie in the plane; refinement corrects that by some
    centimetres.
    """
    used = list(views[:: max(1, -(-len(views) // MAX_VIEWS))])
    samples = [sample_surface(robot, v.posture, NUM_SAMPLES, seed=i) for i, v in enumerate(used)]
    found = [item for plane in planes for item in _on_plane(used, samples, plane)]
    return sorted(found, key=lambda item: -item.score)


def _on_plane(
    views: Sequence[RobotView], samples: Sequence[np.ndarray], plane: LevelPlane
) -> list[Hypothesis]:
    places = _grid(plane)
    yaws = np.arange(NUM_YAWS) * 2 * np.pi / NUM_YAWS
    scores = _scores(views, samples, plane, yaws, places, CAP_M)
    return [
        _polished(views, samples, plane, yaw, place)
        for yaw, place in _distinct(scores, yaws, places)
    ]


def search_near(
    views: Sequence[RobotView], robot: RobotModel, T_base_source: Float[np.ndarray, "4 4"]
) -> Hypothesis:
    """Try yaws within 6 degrees and places within 7 cm of a pose whose tilt is about right."""
    samples = [sample_surface(robot, v.posture, NUM_SAMPLES, seed=i) for i, v in enumerate(views)]
    nowhere = np.zeros(2)
    plane = LevelPlane(T_level_source=T_base_source, low_m=nowhere, high_m=nowhere, share=0.0)
    return _polished(views, samples, plane, 0.0, np.zeros(3))


def _polished(
    views: Sequence[RobotView],
    samples: Sequence[np.ndarray],
    plane: LevelPlane,
    yaw: float,
    place: Float[np.ndarray, "3"],
) -> Hypothesis:
    """The best of finer steps around a yaw and a place."""
    near_yaws = yaw + np.linspace(-1.0, 1.0, NUM_NEAR) * 2 * np.pi / NUM_YAWS
    step = np.linspace(-STEP_M, STEP_M, NUM_NEAR)
    near = np.stack([*np.meshgrid(step, step), np.zeros((NUM_NEAR,) * 2)], axis=-1)
    around = place + near.reshape(-1, 3)
    finer = _scores(views, samples, plane, near_yaws, around, FINE_CAP_M)
    i, k = np.unravel_index(int(np.argmax(finer)), finer.shape)
    T_level_base = _place(float(near_yaws[i]), around[k])
    return Hypothesis(
        T_base_source=se3.invert(T_level_base) @ plane.T_level_source, score=float(finer[i, k])
    )


def _scores(
    views: Sequence[RobotView],
    samples: Sequence[np.ndarray],
    plane: LevelPlane,
    yaws: Float[np.ndarray, " num_yaws"],
    places: Float[np.ndarray, "num_places 3"],
    cap_m: float,
) -> Float[np.ndarray, "num_yaws num_places"]:
    scores = np.zeros((len(yaws), len(places)))
    for view, p_base in zip(views, samples, strict=True):
        T_camera_level = se3.invert(plane.T_level_source @ view.T_source_camera)
        shifts = places @ T_camera_level[:3, :3].T
        for index, yaw in enumerate(yaws):
            p_camera = se3.apply(T_camera_level @ _place(float(yaw), np.zeros(3)), p_base)
            scores[index] += _credit(view, p_camera, shifts, cap_m)
    return np.asarray(scores / len(views))


def _grid(plane: LevelPlane) -> Float[np.ndarray, "num_places 3"]:
    low, high = plane.low_m - MARGIN_M, plane.high_m + MARGIN_M
    step = max(STEP_M, float(np.sqrt(np.prod(high - low) / MAX_PLACES)))
    x, y = (np.arange(a, b + step / 2, step) for a, b in zip(low, high, strict=True))
    grid = np.stack([*np.meshgrid(x, y), np.zeros((len(y), len(x)))], axis=-1)
    return np.asarray(grid.reshape(-1, 3))


def _credit(
    view: RobotView,
    p_camera: Float[np.ndarray, "num_points 3"],
    shifts_m: Float[np.ndarray, "num_places 3"],
    cap_m: float,
) -> Float[np.ndarray, " num_places"]:
    """Mean credit of the points, moved by each shift."""
    camera = view.camera
    p = (p_camera[None] + shifts_m[:, None]).astype(np.float32)
    z = p[..., 2]
    front = z > 0.1
    inverse = 1.0 / np.where(front, z, 1.0)
    column = np.floor(p[..., 0] * inverse * np.float32(camera.fx) + np.float32(camera.cx))
    row = np.floor(p[..., 1] * inverse * np.float32(camera.fy) + np.float32(camera.cy))
    inside = front & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    index = np.where(inside, row * camera.width + column, 0).astype(np.int64)
    behind = view.depth_m.astype(np.float32).ravel()[index] - z
    known = inside & (behind > -z)  # depth 0 is unknown
    credit = np.maximum(0.0, 1.0 - np.abs(behind) / cap_m) - SEEN_THROUGH * (behind > cap_m)
    return np.asarray(np.where(known, credit, 0.0).mean(axis=1), dtype=np.float64)


def _distinct(
    scores: Float[np.ndarray, "num_yaws num_places"],
    yaws: Float[np.ndarray, " num_yaws"],
    places: Float[np.ndarray, "num_places 3"],
) -> list[tuple[float, Float[np.ndarray, "3"]]]:
    """Yaw and place of the best hypotheses none of which is another's neighbour."""
    left = scores.copy()
    found = []
    for _ in range(PER_PLANE):
        yaw, place = np.unravel_index(int(np.argmax(left)), left.shape)
        if not np.isfinite(left[yaw, place]):
            break
        found.append((float(yaws[yaw]), places[place]))
        turn = np.abs((yaws - yaws[yaw] + np.pi) % (2 * np.pi) - np.pi)
        shift = np.linalg.norm(places - places[place], axis=1)
        left[(turn[:, None] < APART_RAD) & (shift[None] < APART_M)] = -np.inf
    return found


def _place(yaw_rad: float, p_m: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    T = np.eye(4)
    T[:2, :2] = [[c, -s], [s, c]]
    T[:3, 3] = p_m
    return T
