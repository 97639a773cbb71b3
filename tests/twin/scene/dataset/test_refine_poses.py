"""Rough poses get better by laying depth onto the model; the gauge stays."""

from dataclasses import replace

import numpy as np
import pytest
import textured_room

from bridge.geometry import se3
from bridge.terminal import Output
from twin.scene.dataset.refine_poses import refine_poses, without_drift
from twin.scene.frames.rgbd import DepthLimits, FrameSurface, TrainingView, training_view

LIMITS = DepthLimits(max_depth_m=5.0, flying_fraction=0.1)
NUM_FRAMES = 10
QUIET = Output(quiet=True)


def spoilt(rng: np.random.Generator, T: np.ndarray) -> np.ndarray:
    wrong = np.eye(4)
    wrong[:3, :3] = se3.rotation_from_vector(rng.normal(0, 0.006, 3))
    wrong[:3, 3] = rng.normal(0, 0.006, 3)
    return np.asarray(T @ wrong)


def errors_m(views: list[TrainingView]) -> np.ndarray:
    """Distance of points half a metre before each camera from where they should be.

    The rigid motion that all cameras share does not count.
    """
    truth = [textured_room.camera_pose(k, NUM_FRAMES) for k in range(NUM_FRAMES)]
    corrections = [v.T_base_color @ se3.invert(T) for v, T in zip(views, truth, strict=True)]
    right = [
        TrainingView(camera_id="", stamp_ns=0, T_base_color=T, half=v.half, full=v.full)
        for T, v in zip(truth, views, strict=True)
    ]
    free = without_drift(corrections, right)
    ahead = np.array([0.0, 0.0, 0.5])
    return np.array(
        [
            np.linalg.norm(se3.apply(D @ T, ahead) - se3.apply(T, ahead))
            for D, T in zip(free, truth, strict=True)
        ]
    )


@pytest.mark.slow
def test_poses_move_towards_the_truth_along_what_depth_can_see() -> None:
    rng = np.random.default_rng(0)
    points, views = [], []
    for index in range(NUM_FRAMES):
        frame = textured_room.frame(index, NUM_FRAMES)
        T = spoilt(rng, frame.T_base_color)
        item = replace(frame, T_base_color=T, T_base_depth=T @ textured_room.T_COLOR_DEPTH)
        surface = FrameSurface(item, LIMITS)
        points.append(surface.points())
        views.append(training_view(surface))
    moved = refine_poses(points, views, QUIET).views
    # Two planes leave sliding along their edge open; the rest is determined.
    assert errors_m(moved).mean() < 0.75 * errors_m(views).mean()


def test_a_motion_that_all_cameras_share_is_taken_out() -> None:
    views = [training_view(FrameSurface(textured_room.frame(k, 4), LIMITS)) for k in range(4)]
    T = np.eye(4)
    T[:3, :3] = se3.rotation_from_vector(np.array([0.1, -0.05, 0.2]))
    T[:3, 3] = (0.1, 0.2, -0.3)
    for left in without_drift([T] * 4, views):
        np.testing.assert_allclose(left, np.eye(4), atol=1e-9)
