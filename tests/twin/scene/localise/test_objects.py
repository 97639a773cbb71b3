"""Objects found in ray-cast frames with noise, camera errors, occlusion and partial views."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from bridge.episode.streams import RgbdFrame
from bridge.geometry import se3
from bridge.task.task_file import Task
from twin.scene.localise.objects import localise_objects
from twin.scene.shape.known import pose_of, turned_alike

SIDE = ("side", (1.15, -0.15, 0.65), (0.45, 0.0, 0.0))
WRIST = ("wrist", (0.48, 0.0, 0.55), (0.49, 0.02, 0.0))
POSES = {
    "cube": pose_of(np.array([0.50, -0.15, 0.02, 0.4])),
    "box": pose_of(np.array([0.49, 0.19, 0.0, -0.12])),
}


def errors(T: np.ndarray, T_true: np.ndarray) -> tuple[float, float]:
    """Distance in mm and yaw difference modulo a quarter turn in degrees."""
    turn = np.arctan2(T[1, 0], T[0, 0]) - np.arctan2(T_true[1, 0], T_true[0, 0])
    turn = np.mod(turn + np.pi / 4, np.pi / 2) - np.pi / 4
    return float(np.linalg.norm(T[:3, 3] - T_true[:3, 3])) * 1e3, abs(float(np.degrees(turn)))


def shoot(
    scene: Any, cameras: Sequence[tuple[Any, ...]], seed: int = 0, count: int = 1, **settings: Any
) -> list[RgbdFrame]:
    rng = np.random.default_rng(seed)
    return [
        scene.frame(name, eye, target, rng, stamp_ns=index, **settings)
        for name, eye, target in cameras
        for index in range(count)
    ]


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(
    "cameras", [(SIDE, WRIST), (SIDE,), (WRIST,)], ids=["both", "side", "wrist"]
)
def test_noisy_frames_give_poses_within_3_mm_and_3_degrees(
    stage: Callable[..., Any], task: Task, cameras: Any, seed: int
) -> None:
    poses = task.draw_start(np.random.default_rng(seed))
    found = localise_objects(shoot(stage(poses), cameras, seed), task)
    for object_id, T in poses.items():
        assert found[object_id].found, found[object_id].reason
        distance_mm, angle_deg = errors(found[object_id].T_base_object, T)
        assert distance_mm < 2.5
        assert angle_deg < 1.5


def test_the_table_takes_out_a_wrong_camera_height_and_tilt(
    stage: Callable[..., Any], task: Task
) -> None:
    T_error = np.eye(4)
    T_error[:3, :3] = se3.rotation_from_quaternion(np.array([1.0, 0.003, -0.003, 0.0]))
    T_error[2, 3] = 0.006
    cube = localise_objects(shoot(stage(POSES), [SIDE], T_error=T_error), task)["cube"]
    assert cube.found
    assert abs(cube.detail["lift_m"]) < 0.001  # without the table it would float or sink


@pytest.mark.slow
@pytest.mark.usefixtures("unchecked")
def test_the_covariance_covers_errors_of_the_cameras(stage: Callable[..., Any], task: Task) -> None:
    """Over drawn camera errors, squared errors are on average what the covariance says."""
    scene, ratios = stage(POSES), []
    for seed in range(8):
        rng = np.random.default_rng(100 + seed)
        frames = []
        for name, eye, target in (SIDE, WRIST):
            T = np.eye(4)
            vector = rng.normal(0, 0.003, 3)
            T[:3, :3] = se3.rotation_from_quaternion(np.array([1.0, *(vector / 2)]))
            T[:3, 3] = eye - T[:3, :3] @ eye + rng.normal(0, 0.0015, 3)
            frames.append(scene.frame(name, eye, target, rng, T_error=T))
        cube = localise_objects(frames, task)["cube"]
        offset = (cube.T_base_object - POSES["cube"])[:2, 3]
        ratios.append(offset @ np.linalg.inv(cube.covariance[:2, :2]) @ offset / 2)
    assert 0.05 < np.mean(ratios) < 1.5


def test_more_still_frames_of_one_camera_are_averaged_into_one_view(
    stage: Callable[..., Any], task: Task
) -> None:
    one = localise_objects(shoot(stage(POSES), [SIDE], count=1), task)["cube"]
    three = localise_objects(shoot(stage(POSES), [SIDE], count=3), task)["cube"]
    assert three.detail["num_frames"] == 3
    assert three.detail["residual_m"] < 0.8 * one.detail["residual_m"]
    assert three.stamp_ns == 2


def test_a_cube_that_is_not_there_is_not_found_and_the_reason_says_so(
    stage: Callable[..., Any], task: Task
) -> None:
    found = localise_objects(shoot(stage({"box": POSES["box"]}), [SIDE]), task)
    assert found["box"].found
    assert not found["cube"].found
    assert found["cube"].T_base_object is None
    assert found["cube"].confidence == 0
    assert "0 points have the colour of cube" in str(found["cube"].reason)


def test_grey_fingers_over_the_cube_do_not_drag_it(stage: Callable[..., Any], task: Task) -> None:
    scene = stage(POSES)
    for offset in (-0.035, 0.035):
        scene.add_box(
            np.array([0.0, offset, 0.05]),
            np.array([0.03, 0.02, 0.1]),
            (120, 120, 124),
            POSES["cube"],
        )
    cube = localise_objects(shoot(scene, [SIDE]), task)["cube"]
    assert cube.found, cube.reason
    distance_mm, angle_deg = errors(cube.T_base_object, POSES["cube"])
    assert distance_mm < 3.0
    assert angle_deg < 3.0


def test_a_cube_half_out_of_the_image_is_laid_out_by_its_known_size(
    stage: Callable[..., Any], task: Task
) -> None:
    pose = POSES["cube"][:3, 3]
    camera = ("wrist", (0.53, -0.15 + 0.216, 0.55), (0.54, -0.15 + 0.216, 0.0))
    frames = shoot(stage(POSES), [camera])
    uv, _ = frames[0].color_camera.project(
        se3.apply(
            se3.invert(frames[0].T_base_color), pose + np.array([[0, 0.02, 0], [0, -0.02, 0]])
        )
    )
    cut = int(uv[:, 0].mean())
    image, depth = frames[0].image_u8.copy(), frames[0].depth_m.copy()
    hidden = slice(cut, None) if cut > 160 else slice(0, cut)
    image[:, hidden] = 0
    depth[:, hidden] = 0
    cube = localise_objects([replace(frames[0], image_u8=image, depth_m=depth)], task)["cube"]
    assert cube.found, cube.reason
    assert errors(cube.T_base_object, POSES["cube"])[0] < 6.0


def test_a_cube_inside_the_box_is_found_on_the_floor_of_the_box(
    stage: Callable[..., Any], task: Task
) -> None:
    poses = {**POSES, "cube": POSES["box"] @ pose_of(np.array([0.01, -0.02, 0.026, 0.5]))}
    found = localise_objects(shoot(stage(poses), [SIDE, WRIST]), task)
    assert found["cube"].found, found["cube"].reason
    distance_mm, _ = errors(found["cube"].T_base_object, poses["cube"])
    assert distance_mm < 3.0
    assert errors(found["box"].T_base_object, poses["box"])[0] < 3.0


@pytest.mark.parametrize("quarter", [-3, -1, 1, 2, 6])
def test_yaw_is_reduced_modulo_the_symmetry(task: Task, quarter: int) -> None:
    cube = task.objects["cube"]
    turned = pose_of(np.array([0.1, 0.2, 0.02, 0.3 + quarter * np.pi / 2]))
    np.testing.assert_allclose(
        turned_alike(turned, np.eye(4), cube), pose_of(np.array([0.1, 0.2, 0.02, 0.3])), atol=1e-12
    )
    long = replace(cube, size_m=(0.08, 0.04, 0.04))
    yaw = turned_alike(turned, np.eye(4), long)
    expected = 0.3 if quarter % 2 == 0 else 0.3 - np.pi / 2
    np.testing.assert_allclose(yaw, pose_of(np.array([0.1, 0.2, 0.02, expected])), atol=1e-12)


def test_a_lifted_cube_is_reported_as_not_standing_on_the_table(
    stage: Callable[..., Any], task: Task
) -> None:
    poses = {**POSES, "cube": pose_of(np.array([0.5, -0.15, 0.12, 0.2]))}
    cube = localise_objects(shoot(stage(poses), [SIDE, WRIST]), task)["cube"]
    assert cube.found
    assert abs(cube.T_base_object[2, 3] - 0.12) < 0.004
    assert "+100 mm from standing on the table" in str(cube.reason)
