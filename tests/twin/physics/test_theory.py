"""Both engines, odd boxes and friction with anchors, against mechanics worked out by hand."""

from collections.abc import Callable, Iterator

import numpy as np
import pytest
from cells import ENGINES, HOME, at, cell, poses, push, rotations

from bridge.geometry import se3
from twin.physics import world as world_module
from twin.physics.config import PhysicsConfig, Unseen
from twin.physics.soft import SoftModel
from twin.physics.soft_solver import SoftSolver, surface_samples
from twin.physics.unseen import EVEN, box_inertia, solids
from twin.physics.world import World

RATE_HZ = 240
G = 9.81
CUBE = np.array([0.04, 0.04, 0.04])
SLAB = np.array([0.06, 0.06, 0.02])
"""Flat: it slides before it tips, up to a friction of 3."""
STEP_S = {"pybullet": 1 / 240, "mujoco": 1 / 480}

each_engine = pytest.mark.parametrize("engine", ENGINES)


@each_engine
def test_what_falls_has_fallen_by_half_g_t_squared(engine: str) -> None:
    with cell(engine) as world:
        world.add_free("cube", CUBE, 0.05, at(2, 2, 2))
        fallen = 2 - poses(world, "cube", RATE_HZ // 2)[-1, 2]
    t = 0.5
    # Semi-implicit Euler falls by g t dt / 2 too far, and by nothing else.
    assert fallen == pytest.approx(G * t * t / 2 + G * t * STEP_S[engine] / 2, rel=1e-9)


@each_engine
@pytest.mark.parametrize(("mu", "speed_m_s"), [(0.3, 1.0), (0.09, 0.5)])
def test_what_slides_stops_after_v_squared_over_two_mu_g(
    engine: str, mu: float, speed_m_s: float
) -> None:
    root = mu**0.5  # coefficients of two partners are multiplied
    with cell(engine, object_friction=root, surface_friction=root) as world:
        world.add_table(0.0)
        world.add_free("slab", SLAB, 0.05, at(0.8, 0.3, 0.0101))
        world.reset_robot(HOME, 0.08)
        poses(world, "slab", RATE_HZ // 4)
        push(world, "slab", (speed_m_s, 0, 0), (0, 0, 0))
        x = poses(world, "slab", 2 * RATE_HZ)[:, 0]
    theory = speed_m_s**2 / (2 * mu * G)
    # Friction acts from the first step on, before anything has moved: v dt / 2 too short.
    assert x[-1] - x[0] == pytest.approx(theory - speed_m_s * STEP_S[engine] / 2, rel=2e-3)
    assert abs(x[-1] - x[-RATE_HZ // 4]) < 1e-6, "it creeps"


# A cantilever of the soft solver. Tetrahedra whose strain is constant bend too stiffly: the error
# falls with the square of the cells across, not with shorter steps.


def _beam(
    box_of_cells: Callable[..., SoftModel], cells: tuple[int, int, int], cell_m: float
) -> tuple[float, float, float]:
    """What the end of a beam sinks by under a load [m]: here, by Euler and Bernoulli, with shear.

    The load is a kick in each step, which is small against the beam's own time: 0.1 m/s^2 times a
    step on the whole of it.
    """
    young_pa, load_N, poisson = 6e5, 0.02, 0.2
    length, width, height = (cell_m * n for n in cells)
    mass_kg = 300 * length * width * height
    model = box_of_cells(cells, cell_m, mass_kg=mass_kg, young_pa=young_pa, poisson=poisson)
    rest, surface = model.nodes_m.astype(np.float64), model.surface()
    clamped, end = (abs(rest[:, 0] - x) < 1e-6 for x in (-length / 2, length / 2))
    share = model.mass_fraction.astype(np.float64)
    masses = np.where(clamped, 1e5, mass_kg * share / share.sum())
    solver = SoftSolver(1 / RATE_HZ, 10, 0.0)
    body = solver.add_body(
        rest, rest, np.ascontiguousarray(model.tets), masses, surface_samples(surface),
        np.ascontiguousarray(surface), young_pa, poisson, 0.02, 0.0, 0.0, cell_m,
    )  # fmt: skip
    edge = np.isclose(np.abs(rest[end, 1:]), np.array([width, height]) / 2, atol=1e-6)
    area = np.prod(np.where(edge, 0.5, 1.0), axis=1)
    kick, sunk = load_N * area / area.sum() / masses[end] / RATE_HZ, []
    for step in range(5 * RATE_HZ // 2):
        v = np.array(solver.velocities(body))
        v[end, 2] -= kick * min(1.0, step / RATE_HZ)
        solver.set_velocities(body, v)
        solver.step(np.zeros(0, dtype=np.int32), np.zeros((0, 7)))
        sunk.append(float((rest[end, 2] - solver.nodes(body)[end, 2]).mean()))
    bent = load_N * length**3 / (3 * young_pa * width * height**3 / 12)
    sheared = load_N * length / (5 / 6 * young_pa / (2 + 2 * poisson) * width * height)
    return float(np.mean(sunk[-RATE_HZ // 2 :])), bent, bent + sheared


def test_a_cantilever_bends_as_euler_and_bernoulli_say_the_finer_the_better(
    box_of_cells: Callable[..., SoftModel],
) -> None:
    coarse, bent, sheared = _beam(box_of_cells, (8, 2, 2), 0.014)
    fine, _, _ = _beam(box_of_cells, (16, 4, 4), 0.007)
    assert coarse / bent == pytest.approx(0.66, abs=0.05), "two cells across"
    assert fine / bent == pytest.approx(0.91, abs=0.05), "four cells across"
    too_stiff = [sheared / measured - 1 for measured in (coarse, fine)]
    assert too_stiff[1] / too_stiff[0] == pytest.approx(0.25, abs=0.05)


SIZE = np.array([0.04, 0.04, 0.04])
STILL = np.zeros(6)
WEAK = PhysicsConfig(object_friction=0.5, grip_force_N=2.0)
CARRIED_KG = 2 * WEAK.object_friction * WEAK.finger_friction * WEAK.grip_force_N / G


def gripping(world: World, mass_kg: float) -> None:
    """Hold a cube between the fingers, weightless."""
    world.client.setGravity(0, 0, 0)
    world.reset_robot(HOME, 0.041)
    world.add_free("cube", SIZE, mass_kg, world.robot.T_base_link("tcp"))
    for _ in range(60):
        world.robot.command(HOME, STILL, 0.0)
        world.step()


def turning(world: World, angle_rad: float, speed_rad_s: float = 2.0) -> Iterator[np.ndarray]:
    """Turn the last joint step by step; where the joints are told to be."""
    joints, velocity = HOME.copy(), STILL.copy()
    velocity[5] = speed_rad_s
    steps = round(angle_rad / speed_rad_s * world.config.rate_hz)
    yield joints
    for _ in range(steps):
        joints[5] += angle_rad / steps
        world.robot.command(joints, velocity, 0.0)
        world.step()
        yield joints


def weigh_down(world: World, joints: np.ndarray, steps: int) -> float:
    """Switch gravity on; how far the cube has moved in the tool's frame [m]."""
    world.client.setGravity(0, 0, -G)
    start = se3.invert(world.robot.T_base_link("tcp")) @ world.T_base_object("cube")
    for _ in range(steps):
        world.robot.command(joints, STILL, 0.0)
        world.step()
    end = se3.invert(world.robot.T_base_link("tcp")) @ world.T_base_object("cube")
    return float(np.linalg.norm(end[:3, 3] - start[:3, 3]))


def normal_error_rad(world: World) -> float:
    """Angle between the fingers' closing direction and contact normals, weighted by force."""
    finger = world.robot.T_base_link("gripper_left_finger")[:3, :3]
    axis = finger @ np.array([0.0, 1.0, 0.0])
    points = world.client.getContactPoints(world.robot.id, world.free_ids["cube"])
    angles = [np.arccos(min(1.0, abs(axis @ np.array(point[7])))) for point in points]
    return float(np.average(angles, weights=[point[9] for point in points]))


@pytest.mark.parametrize("turn_rad", [0.0, 1.2])
def test_fingers_hold_what_friction_carries_and_lose_what_it_does_not(
    urdf: str, turn_rad: float
) -> None:
    moved = {}
    for share in (0.9, 1.1):
        with World(urdf, {}, WEAK) as world:
            gripping(world, share * CARRIED_KG)
            *_, joints = turning(world, turn_rad)
            moved[share] = weigh_down(world, joints, 72)
    assert moved[0.9] < 1e-3
    assert moved[1.1] > 0.02


def test_what_is_held_does_not_creep(urdf: str) -> None:
    with World(urdf, {}, PhysicsConfig()) as world:
        gripping(world, 0.05)
        weigh_down(world, HOME, 60)
        assert weigh_down(world, HOME, 480) < 2e-5


def test_contact_normals_turn_with_what_is_held(urdf: str, monkeypatch: pytest.MonkeyPatch) -> None:
    errors = {}
    for every in (world_module.EVERY_STEPS, 10**9):
        monkeypatch.setattr(world_module, "EVERY_STEPS", every)
        with World(urdf, {}, PhysicsConfig()) as world:
            gripping(world, 0.05)
            found = [normal_error_rad(world) for _ in turning(world, 1.2)]
        errors[every] = np.rad2deg(np.mean(found))
    kept_fresh, left_alone = errors.values()
    assert kept_fresh < 5.0
    assert left_alone > 15.0, "the engine turns normals itself: nothing need be let go"


MASS_KG = 0.05
TURN = se3.rotation_from_vector(np.array([0.3, -0.5, 0.8]))


def test_a_stepped_box_is_as_wide_as_before_and_its_faces_are_smaller() -> None:
    size = np.array([0.03, 0.04, 0.06])
    boxes = solids(Unseen(edge_m=0.005), size)
    np.testing.assert_allclose(np.max(boxes, axis=0), size)
    for axis, extents in enumerate(boxes):
        face = np.delete(extents, axis)
        np.testing.assert_allclose(face, np.delete(size, axis) - 0.01)
    assert len(solids(EVEN, size)) == 1
    assert (np.array(solids(Unseen(edge_m=1.0), size)) > 0).all()


@each_engine
@pytest.mark.parametrize("off_m", [(0.0, 0.0, 0.0), (0.006, -0.004, 0.01)])
@pytest.mark.parametrize("edge_m", [0.0, 0.004])
def test_a_pose_comes_out_as_it_went_in_wherever_the_weight_is(
    engine: str, edge_m: float, off_m: tuple[float, float, float]
) -> None:
    T = at(2, 2, 2, TURN)
    with cell(engine) as world:
        unseen = Unseen(edge_m=edge_m, centre_of_mass_m=off_m)
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
        world.add_table(-0.3)
        world.add_free("cube", CUBE, MASS_KG, at(0.8, 0.3, -0.2797), unseen)
        world.reset_robot(HOME, 0.08)
        p = poses(world, "cube", RATE_HZ)[-1, :3]
    np.testing.assert_allclose(p, [0.8, 0.3, -0.28], atol=5e-4)
