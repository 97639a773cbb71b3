"""Batched geometry against the scalar functions that the predicates and the twin use."""

import numpy as np
import pytest

from bridge.geometry import se3
from bridge.task.relations import Box, footprint_gap_m
from twin.plan.constrain import arrays

pytestmark = pytest.mark.parity


def random_poses(rng: np.random.Generator, count: int, far_m: float) -> np.ndarray:
    q = rng.normal(size=(count, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    return se3.transform_from(q, rng.uniform(-far_m, far_m, size=(count, 3)))


def test_gaps_of_outlines_are_those_of_the_predicates() -> None:
    rng = np.random.default_rng(0)
    a, b = random_poses(rng, 600, 0.15), random_poses(rng, 600, 0.15)
    upright = np.eye(3)[[[0, 1, 2], [1, 2, 0], [2, 0, 1]]]
    a[:200, :3, :3], b[100:300, :3, :3] = upright[np.arange(200) % 3], upright[0]
    half_a, half_b = np.array([0.06, 0.03, 0.02]), np.array([0.05, 0.05, 0.1])
    found = arrays.footprint_gap(a, half_a, b, half_b)
    for one, other, gap in zip(a, b, found, strict=True):
        boxes = Box(T_base_box=one, half_m=half_a), Box(T_base_box=other, half_m=half_b)
        assert gap == pytest.approx(footprint_gap_m(*boxes), abs=1e-9)
    assert (found > 0).sum() > 50
    assert (found < 0).sum() > 50


def test_distances_to_a_box_are_those_to_its_nearest_point() -> None:
    rng = np.random.default_rng(2)
    half = np.array([0.1, 0.2, 0.3])
    points = rng.uniform(-0.5, 0.5, size=(500, 3))
    found = arrays.box_distance(points, half)
    outside = np.linalg.norm(points - np.clip(points, -half, half), axis=1)
    inside = np.min(half - np.abs(points), axis=1)
    wanted = np.where(outside > 0, outside, -inside)
    np.testing.assert_allclose(found, wanted, atol=1e-11)


def test_distances_to_several_boxes_are_to_the_nearest() -> None:
    rng = np.random.default_rng(4)
    centres, halves = rng.uniform(-0.2, 0.2, (4, 3)), rng.uniform(0.02, 0.2, (4, 3))
    points = rng.uniform(-0.5, 0.5, size=(500, 3))
    each = [arrays.box_distance(points, *box) for box in zip(halves, centres, strict=True)]
    found = arrays.boxes_distance(points, list(centres), list(halves))
    np.testing.assert_allclose(found, np.min(each, axis=0), atol=1e-11)


def test_angles_are_exact_where_a_cosine_is_flat() -> None:
    a = np.array([[1.0, 0.0, 0.0]])
    for wanted in (1e-7, 1e-3, 1.0, np.pi - 1e-7):
        b = np.array([[np.cos(wanted), np.sin(wanted), 0.0]]) * 3.0
        assert arrays.angle(a, b)[0] == pytest.approx(wanted, rel=1e-6)
        assert arrays.angle(a, -b, undirected=True)[0] == pytest.approx(min(wanted, np.pi - wanted))
