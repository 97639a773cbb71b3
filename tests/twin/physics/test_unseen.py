"""Boxes with steps along their edges and their weight off the middle, in both engines, by hand."""

import numpy as np
import pytest
from cells import ENGINES, HOME, at, cell, poses, push, rotations

from bridge.geometry import se3
from twin.physics.unseen import EVEN, Unseen, box_inertia

RATE_HZ = 240
CUBE = np.array([0.04, 0.04, 0.04])
MASS_KG = 0.05
TURN = se3.rotation_from_vector(np.array([0.3, -0.5, 0.8]))

each_engine = pytest.mark.parametrize("engine", ENGINES)


def test_a_stepped_box_is_as_wide_as_before_and_its_faces_are_smaller() -> None:
    size = np.array([0.03, 0.04, 0.06])
    solids = Unseen(edge_m=0.005).solids(size)
    np.testing.assert_allclose(np.max(solids, axis=0), size)
    for axis, extents in enumerate(solids):
        face = np.delete(extents, axis)
        np.testing.assert_allclose(face, np.delete(size, axis) - 0.01)
    assert len(EVEN.solids(size)) == 1
    assert (np.array(Unseen(edge_m=1.0).solids(size)) > 0).all()


@each_engine
@pytest.mark.parametrize("edge_m", [0.0, 0.004])
def test_a_pose_comes_out_as_it_went_in_wherever_the_weight_is(engine: str, edge_m: float) -> None:
    T = at(2, 2, 2, TURN)
    with cell(engine) as world:
        unseen = Unseen(edge_m=edge_m, centre_of_mass_m=(0.006, -0.004, 0.01))
        world.add_free("cube", CUBE, MASS_KG, T, unseen)
        world.reset_robot(HOME, 0.08)
        np.testing.assert_allclose(world.T_base_object("cube"), T, atol=1e-6)


@each_engine
def test_what_flies_turns_about_its_centre_of_mass(engine: str) -> None:
    """The centre falls straight; the middle goes round it."""
    centre = np.array([0.012, 0.0, 0.0])
    with cell(engine) as world:
        world.add_free("cube", CUBE, MASS_KG, at(2, 2, 2), Unseen(centre_of_mass_m=tuple(centre)))
        world.reset_robot(HOME, 0.08)
        push(world, "cube", (0, 0, 0), (0, 0, 6.0))
        rows = poses(world, "cube", RATE_HZ // 4)
    where = rows[:, :3] + rotations(rows) @ centre
    drift = where[:, :2] - where[0, :2]
    steady = np.linspace(0, 1, len(rows))[:, None] * drift[-1]
    np.testing.assert_allclose(drift, steady, atol=2e-4)  # a straight line at an even speed
    turned = np.abs(rows[-1, :2] - rows[0, :2]).max()
    assert turned > 0.005


@each_engine
@pytest.mark.parametrize(
    ("edge_m", "off_m", "stays"),
    [(0.0, 0.009, True), (0.0, 0.015, False), (0.004, 0.007, True), (0.004, 0.011, False)],
)
def test_a_stack_stays_while_the_weight_is_over_the_lower_face(
    engine: str, edge_m: float, off_m: float, stays: bool
) -> None:
    """Half a lower face is 13 mm, 9 mm with steps of 4 mm; the upper box lies in the middle."""
    low = np.array([0.026, 0.026, 0.026])
    with cell(engine) as world:
        world.add_table(0.0)
        world.add_free("low", low, MASS_KG, at(0.8, 0.3, 0.013), Unseen(edge_m=edge_m))
        unseen = Unseen(edge_m=edge_m, centre_of_mass_m=(off_m, 0.0, 0.0))
        world.add_free("high", CUBE, MASS_KG, at(0.8, 0.3, 0.0462), unseen)
        world.reset_robot(HOME, 0.08)
        height_m = poses(world, "high", 2 * RATE_HZ)[-1, 2]
    assert (abs(height_m - 0.046) < 0.001) == stays


def test_inertia_is_that_of_the_textbook() -> None:
    assert box_inertia(np.array([0.1, 0.2, 0.3]), 12.0) == pytest.approx((0.13, 0.1, 0.05))


@each_engine
@pytest.mark.parametrize("edge_m", [0.0, 0.004])
def test_what_rests_rests_on_its_own_face_wherever_its_weight_is(
    engine: str, edge_m: float
) -> None:
    unseen = Unseen(edge_m=edge_m, centre_of_mass_m=(0.003, 0.002, -0.008))
    with cell(engine) as world:
        world.add_table(0.0)
        world.add_free("cube", CUBE, MASS_KG, at(0.8, 0.3, 0.0203), unseen)
        world.reset_robot(HOME, 0.08)
        p = poses(world, "cube", RATE_HZ)[-1, :3]
    np.testing.assert_allclose(p, [0.8, 0.3, 0.02], atol=5e-4)
