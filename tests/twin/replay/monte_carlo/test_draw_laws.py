"""Laws of drawing: in which frame, how far, and what is independent of what."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from bridge.geometry import se3
from bridge.task.task_file import load_task
from twin.replay.config import ReplayConfig
from twin.replay.monte_carlo import draw_variation, sample_rng
from twin.replay.scene import ReplayScene


def draws(scene: ReplayScene, count: int) -> list[ReplayScene]:
    return [
        draw_variation(sample_rng(0, "start", k), scene, ReplayConfig())[0] for k in range(count)
    ]


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_pose_error_is_drawn_about_the_axes_of_the_base(
    script: SimpleNamespace, axis: int
) -> None:
    """Unsure about one axis of the base only, however the object lies."""
    scene = script.scene()
    T = se3.transform_from(np.array([0.7, 0.5, -0.3, 0.4]), np.array([0.5, -0.1, 0.3]))
    spread = np.zeros(6)
    spread[[axis, 3 + axis]] = (1e-4, 4e-2)
    scene = replace(
        scene,
        Ts_base_object={**scene.Ts_base_object, "cube": T},
        covariances={"cube": np.diag(spread)},
    )
    others = [index for index in range(3) if index != axis]
    for draw in draws(scene, 30):
        moved = draw.Ts_base_object["cube"]
        turn = se3.vector_from_rotation(moved[:3, :3] @ T[:3, :3].T)
        np.testing.assert_allclose(turn[others], 0.0, atol=1e-12)
        np.testing.assert_allclose((moved[:3, 3] - T[:3, 3])[others], 0.0, atol=1e-12)
        assert turn[axis] != 0.0


def test_correlated_errors_are_drawn_with_their_correlation(script: SimpleNamespace) -> None:
    """The sample covariance is that of the localisation, all six numbers of it."""
    scene = script.scene()
    T = scene.Ts_base_object["cube"].copy()
    T[2, 3] += 0.2  # in the air: nothing is known of its height and tilt
    root = np.random.default_rng(1).normal(size=(6, 6)) * 1e-2
    covariance = root @ root.T
    scene = replace(
        scene, Ts_base_object={**scene.Ts_base_object, "cube": T}, covariances={"cube": covariance}
    )
    steps = []
    for draw in draws(scene, 2000):
        moved = draw.Ts_base_object["cube"]
        turn = se3.vector_from_rotation(moved[:3, :3] @ T[:3, :3].T)
        steps.append(np.concatenate([moved[:3, 3] - T[:3, 3], turn]))
    found = np.cov(np.array(steps).T)
    deviations = np.sqrt(np.diag(covariance))
    # 5 standard errors of a correlation over 2000 draws
    np.testing.assert_allclose(
        found / np.outer(deviations, deviations),
        covariance / np.outer(deviations, deviations),
        atol=5 / np.sqrt(2000),
    )


def test_mass_and_stiffness_of_a_soft_body_are_independent() -> None:
    task = load_task("sloth_into_basket")
    T = np.eye(4)
    T[2, 3] = task.objects["sloth"].rest_height_m
    scene = ReplayScene(task=task, Ts_base_object={"sloth": T}, urdf="")
    found = [draw.task.objects["sloth"] for draw in draws(scene, 400)]
    assert found[0].soft is not None
    masses = np.log([model.mass_kg for model in found])
    stiffnesses = np.log([model.soft.young_pa for model in found if model.soft is not None])
    assert abs(np.corrcoef(masses, stiffnesses)[0, 1]) < 5 / np.sqrt(400)
    assert np.std(stiffnesses) == pytest.approx(0.3, rel=0.2)
