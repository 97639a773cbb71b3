"""Points of bodies in many states against one state at a time."""

import numpy as np

from bridge.geometry import se3
from twin.plan.constrain.bodies import carried, seen_from


def test_points_of_many_states_are_carried_and_seen_as_of_each_alone() -> None:
    rng = np.random.default_rng(1)
    q = rng.normal(size=(7, 4))
    Ts = se3.transform_from(q / np.linalg.norm(q, axis=1, keepdims=True), rng.normal(size=(7, 3)))
    points = rng.normal(size=(11, 3))
    there = carried(Ts, points)
    for T, moved in zip(Ts, there, strict=True):
        np.testing.assert_allclose(moved, se3.apply(T, points), atol=1e-12)
    np.testing.assert_allclose(
        seen_from(Ts, there), np.broadcast_to(points, there.shape), atol=1e-12
    )
