"""Final states: the distributions of Eq. 8 and 9, what is measured, and where things are let go."""

from dataclasses import replace

import coal
import numpy as np
import pytest
from scipy import stats
from upright import upright

from bridge.geometry import se3
from bridge.robots.default import ROBOT
from bridge.task.task_file import ObjectModel, Task, load_task
from twin.plan.constrain.bodies import surface_points
from twin.plan.constrain.kinds import compile_constraint
from twin.plan.problem import Grasp, Miss, NoPlanError, Problem, Release, Shape, State
from twin.plan.release.final_states import final_states
from twin.plan.release.obstacles import hand_points, obstacles_of
from twin.plan.release.resting import lying_there, orientations, target_of
from twin.plan.stage.solver import perturbed
from twin.replay.clearance.bodies import SCENE, TABLE, placed_panels
from twin.replay.clearance.surroundings import scene_grid
from twin.replay.scene import ReplayScene
from twin.robot.collision import hulls_of, signed_distance
from twin.robot.model import load_robot
from twin.scene.shape.known import shape_mesh
from twin.scene.shape.sdf import SdfGrid, distances_of_solid
from twin.scene.shape.static import StaticSdf

SURE = np.diag([1e-8] * 6)


def box_shape(size_m: tuple[float, float, float]) -> Shape:
    model = ObjectModel(id="box", shape="box", size_m=size_m, color_srgb=(0, 0, 0))
    vertices, triangles = shape_mesh(model)
    return Shape(vertices_m=vertices, triangles=triangles, source="test")


def problem_of(task: Task, poses: dict[str, np.ndarray], **scene: object) -> Problem:
    where = ReplayScene(task=task, urdf=ROBOT.urdf_text(), Ts_base_object=poses, **scene)
    shapes = {name: box_shape(model.size_m) for name, model in task.objects.items()}
    return Problem(scene=where, robot=load_robot(where.urdf), shapes=shapes)


def cube_problem(**scene: object) -> Problem:
    poses = {"cube": upright(0.5, -0.15, 0.02, 0.4), "box": upright(0.5, 0.19, 0.0, 0.3)}
    return problem_of(load_task("cube_into_box"), poses, **scene)


def from_above(object_id: str = "cube", width_m: float = 0.04) -> Grasp:
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[2, 3] = 0.004
    return Grasp(
        object_id=object_id,
        T_object_tcp=T,
        width_m=width_m,
        open_m=width_m + 0.02,
        margin=1.0,
        joints_rad=np.zeros(6),
        pregrasp_m=0.1,
    )


@pytest.fixture(scope="module")
def found() -> tuple[Release, ...]:
    return final_states(cube_problem(), from_above())


def test_shifts_and_turns_are_drawn_as_is_said() -> None:
    nominal = upright(0.3, 0.1, 0.2, 0.7) @ np.diag([1.0, -1.0, -1.0, 1.0])
    Ts = perturbed(nominal, tau_p_m=0.02, tau_r_rad=0.3, count=4000, rng=np.random.default_rng(0))
    shift = Ts[:, :3, 3] - nominal[:3, 3]
    for axis in range(3):
        assert stats.kstest(shift[:, axis], "uniform", (-0.02, 0.04)).pvalue > 1e-3
    turn = se3.vector_from_rotation(nominal[:3, :3].T @ Ts[:, :3, :3])  # in the tool's frame
    angle = np.linalg.norm(turn, axis=1)
    assert stats.kstest(angle, "uniform", (0.0, 0.3)).pvalue > 1e-3
    axis = turn / angle[:, None]
    for k in range(3):  # Archimedes: each coordinate of a point on the sphere is uniform
        assert stats.kstest(axis[:, k], "uniform", (-1.0, 2.0)).pvalue > 1e-3
    assert abs(np.corrcoef(angle, axis[:, 2])[0, 1]) < 0.05


def test_distances_are_those_of_coal_from_above() -> None:
    """Never below, and hardly above: points on the faces, 200 of them."""
    problem = cube_problem()
    obstacles = obstacles_of(problem, hulls_of(problem.robot), {"cube"})
    assert tuple(obstacles) == (TABLE, "box")
    points = surface_points(problem, "cube")
    rng = np.random.default_rng(1)
    nominal = upright(0.5, 0.19, 0.08)
    Ts = perturbed(nominal, tau_p_m=0.09, tau_r_rad=1.0, count=150, rng=rng)
    found = obstacles["box"](points, Ts)
    cube = coal.Box(0.04, 0.04, 0.04)
    panels = placed_panels(problem.model("box"), problem.scene.Ts_base_object["box"])
    exact = []
    for T in Ts:
        placed = coal.Transform3s(T[:3, :3], T[:3, 3])
        exact.append(
            min(
                signed_distance(cube, placed, coal.Box(*e), coal.Transform3s(P[:3, :3], P[:3, 3]))
                for P, e in panels
            )
        )
    apart = np.array(exact) > 0.001
    assert apart.sum() > 30
    assert (found[apart] >= np.array(exact)[apart] - 1e-6).all()
    assert (found[apart] - np.array(exact)[apart]).max() < 0.004


def wall_behind(voxel_m: float) -> StaticSdf:
    """A wall at y = 0.35 of a scene that was seen in coarse voxels."""
    solid = np.zeros((60, 60, 40), dtype=np.bool_)
    origin = np.array([0.2, -0.1, 0.005])
    y = origin[1] + voxel_m * np.arange(60)
    solid[:, (y > 0.35) & (y < 0.37), :] = True
    grid = SdfGrid(
        values_m=distances_of_solid(solid, voxel_m), origin_m=origin, voxel_m=voxel_m, closed=False
    )
    return StaticSdf(conservative=grid, observed=grid)


def test_the_static_grid_is_made_thicker_by_its_own_error() -> None:
    voxel_m = 0.0107
    problem = cube_problem(static_sdf=wall_behind(voxel_m))
    obstacles = obstacles_of(problem, hulls_of(problem.robot), {"cube"})
    assert tuple(obstacles) == (TABLE, "box", SCENE)
    T = upright(0.5, 0.25, 0.2)[None]
    distance = obstacles[SCENE](np.zeros((1, 3)), T)[0]
    grid = scene_grid(problem.scene, hulls_of(problem.robot))
    assert grid is not None
    there = float(grid.distance(T[:, :3, 3])[0])
    assert distance == pytest.approx(there - np.sqrt(3) / 2 * voxel_m, abs=1e-6)
    assert distance <= 0.36 - 0.25  # never more than there is


def every_pose(releases: tuple[Release, ...], problem: Problem) -> State:
    num = len(releases)
    poses = {
        name: np.broadcast_to(T, (num, 4, 4)) for name, T in problem.scene.Ts_base_object.items()
    }
    poses[releases[0].object_id] = np.stack([r.T_base_object for r in releases])
    return State(
        Ts_base_object=poses,
        T_base_tcp=np.stack([r.T_base_tcp for r in releases]),
        width_m=np.full(num, 0.06),
    )


def test_a_cube_is_let_go_inside_of_the_box_and_touches_nothing(found: tuple[Release, ...]) -> None:
    problem, grasp = cube_problem(), from_above()
    assert len(found) >= 5
    inside = compile_constraint({"kind": "inside", "object": "cube", "container": "box"}, problem)
    assert (inside.violation(every_pose(found, problem)) <= 0).all()
    costs = [release.cost for release in found]
    assert costs == sorted(costs)
    cube = coal.Box(0.04, 0.04, 0.04)
    panels = placed_panels(problem.model("box"), problem.scene.Ts_base_object["box"])
    for release in found:
        T = release.T_base_object
        np.testing.assert_allclose(release.T_base_tcp, T @ grasp.T_object_tcp, atol=1e-12)
        placed = coal.Transform3s(T[:3, :3], T[:3, 3])
        for P, extents in panels:
            box = coal.Transform3s(P[:3, :3], P[:3, 3])
            assert signed_distance(cube, placed, coal.Box(*extents), box) > -0.001
        assert np.arccos(min(1.0, T[2, 2])) <= np.radians(12.0) + 1e-6
    best = found[0].T_base_object
    np.testing.assert_allclose(best[:2, 3], (0.5, 0.19), atol=1e-3)
    assert best[2, 3] == pytest.approx(0.006 + 0.02 + 0.004, abs=1e-3)


def test_the_same_seed_gives_the_same_bytes(found: tuple[Release, ...]) -> None:
    again = final_states(cube_problem(), from_above())
    poses = [release.T_base_object.tobytes() for release in found]
    assert poses == [release.T_base_object.tobytes() for release in again]
    other = final_states(cube_problem(), from_above(), seed=1)
    assert poses != [release.T_base_object.tobytes() for release in other]


def test_the_less_sure_a_place_is_the_farther_the_edge() -> None:
    def farthest(sigma_m: float) -> float:
        covariance = np.diag([sigma_m**2] * 3 + [1e-6] * 3)
        problem = cube_problem(covariances={"box": covariance, "cube": SURE})
        found = final_states(problem, from_above())
        local = [
            se3.apply(se3.invert(problem.scene.Ts_base_object["box"]), release.T_base_object[:3, 3])
            for release in found
        ]
        return float(np.abs(np.array(local)[:, :2]).max())

    assert farthest(0.026) <= 0.075 - 0.02 - 2 * 0.026 + 1e-6
    assert farthest(0.0001) > 0.008


def test_a_box_that_is_taken_is_shared_without_touching() -> None:
    task = load_task("cube_into_box")
    objects = {**task.objects, "other": replace(task.objects["cube"], id="other")}
    poses = {
        "cube": upright(0.5, -0.15, 0.02),
        "box": upright(0.5, 0.19, 0.0),
        "other": upright(0.5, 0.19, 0.026),
    }
    problem = problem_of(replace(task, objects=objects), poses)
    found = final_states(problem, from_above())
    cube = coal.Box(0.04, 0.04, 0.04)
    other = coal.Transform3s(poses["other"][:3, :3], poses["other"][:3, 3])
    for release in found:
        T = release.T_base_object
        placed = coal.Transform3s(T[:3, :3], T[:3, 3])
        assert signed_distance(cube, placed, cube, other) > 0


def test_a_cube_is_put_on_a_cube() -> None:
    task = load_task("stack_two_cubes")
    (name,) = task.manipulated[:1]
    relation, support = task.goal_of(name) or ("", "")
    assert relation == "on"
    poses = {key: upright(0.4 + 0.1 * i, 0.1 * i, model.rest_height_m, 0.2 * i)
             for i, (key, model) in enumerate(task.objects.items())}  # fmt: skip
    problem = problem_of(task, poses)
    found = final_states(problem, from_above(name))
    T = found[0].T_base_object
    np.testing.assert_allclose(T[:2, 3], poses[support][:2, 3], atol=2e-3)
    heights = [task.objects[key].size_m[2] / 2 for key in (name, support)]
    gap = T[2, 3] - poses[support][2, 3] - sum(heights)
    assert 0 < gap < 0.01


def test_constraints_alone_say_where() -> None:
    """Beside the box: no success predicate says so, a pose to look around and a constraint do."""
    problem = cube_problem()
    record = {
        "kind": "beside",
        "object": "cube",
        "reference": "box",
        "direction": "right",
        "gap_m": [0.02, 0.05],
    }
    constraint = compile_constraint(record, problem)
    found = final_states(
        problem, from_above(), goals=[constraint], near=[upright(0.5, 0.05, 0.024)]
    )
    violations = constraint.violation(every_pose(found, problem))
    assert (violations <= 0).all()


def test_a_height_asked_of_the_release_holds_there_whatever_the_usual_drop() -> None:
    """Higher than 30 mm over the rim, which is the most where nothing is asked."""
    problem = cube_problem()
    record = {
        "kind": "height",
        "a": {"object": "cube", "anchor": "bottom"},
        "min": 0.13,
        "max": 0.14,
    }
    wish = compile_constraint(record, problem)
    found = final_states(problem, from_above(), wishes=[wish])
    assert (wish.violation(every_pose(found, problem)) <= 0).all()
    assert found[0].T_base_object[2, 3] - 0.02 >= 0.13


def test_a_known_miss_is_made_up_for() -> None:
    """Where it will lie, not where it is let go, is in the gap of one millimetre."""
    problem, miss = cube_problem(), Miss(shift_m=np.array([0.004, -0.003, 0.0]), turn_rad=0.1)
    record = {"kind": "beside", "object": "cube", "reference": "box", "gap_m": [0.02, 0.021]}
    goal = compile_constraint(record, problem)
    near = [upright(0.5, 0.05, 0.024)]
    found = final_states(problem, from_above(), goals=[goal], near=near, miss=miss)
    state = every_pose(found, problem)
    Ts = {**state.Ts_base_object, "cube": miss.applied(state.Ts_base_object["cube"])}
    assert (goal.violation(replace(state, Ts_base_object=Ts)) <= 0).all()
    assert not (goal.violation(state) <= 0).all()
    lies = lying_there(problem, found[0], miss)
    assert lies[2, 3] == pytest.approx(0.006 + 0.02, abs=2e-3)
    np.testing.assert_allclose(lies[:2, 3], Ts["cube"][0, :2, 3])


def test_the_hand_is_as_wide_as_it_opens() -> None:
    robot = load_robot(ROBOT.urdf_text())
    closed, opened = (hand_points(robot, width, 400) for width in (0.0, 0.08))
    assert np.ptp(opened[:, 1]) >= np.ptp(closed[:, 1])
    tips = opened[opened[:, 2] > -0.01]
    assert np.abs(tips[:, 1]).min() >= 0.039
    assert opened[:, 2].max() == pytest.approx(0.01, abs=0.003)  # tips reach past the tool frame


def model_of(symmetry: str) -> ObjectModel:
    return replace(load_task("cube_into_box").objects["cube"], symmetry=symmetry)


@pytest.mark.parametrize(("symmetry", "count"), [("none", 4), ("cube", 24)])
def test_ways_to_lie_are_as_many_as_the_symmetry_says(symmetry: str, count: int) -> None:
    R_now = upright(0, 0, 0, 0.4)[:3, :3]
    R_target = upright(0, 0, 0, 0.1)[:3, :3]
    found = orientations(model_of(symmetry), R_now, R_target)
    assert len(found) == count
    for R in found:
        local = np.abs(R_target.T @ R)
        np.testing.assert_allclose(np.sort(local.ravel()), [0] * 6 + [1] * 3, atol=1e-9)
    angles = [se3.rotation_angle_rad(R_now.T @ R) for R in found]
    assert angles[0] == pytest.approx(min(angles))


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        ("nowhere", "nowhere_said"),
        ("sideways", "tool_direction"),
        ("full", "no_free_pose"),
    ],
)
def test_where_nothing_can_be_let_go_the_cause_is_named(
    change: str, cause: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem, grasp = cube_problem(), from_above()
    task, poses = problem.scene.task, dict(problem.scene.Ts_base_object)
    if change == "nowhere":
        problem = problem_of(replace(task, success=()), poses)
    elif change == "sideways":
        task = replace(task, objects={**task.objects, "cube": model_of("none")})
        problem = problem_of(task, poses)
        T = np.eye(4)
        T[:3, :3] = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]
        grasp = replace(grasp, T_object_tcp=T)
    else:
        lid = replace(task.objects["cube"], id="lid", size_m=(0.148, 0.148, 0.2))
        poses["lid"] = upright(0.5, 0.19, 0.107, 0.3)
        problem = problem_of(replace(task, objects={**task.objects, "lid": lid}), poses)
    monkeypatch.setattr("twin.plan.release.final_states.MOST_DROP_M", 0.005)
    with pytest.raises(NoPlanError) as caught:
        final_states(problem, grasp)
    assert caught.value.cause == cause
    assert str(caught.value).endswith(".")
    if cause == "no_free_pose":
        assert "the distance of cube from lid is -" in str(caught.value)
        assert "missed by" in str(caught.value)


def test_the_mark_of_a_pushed_object_is_a_target_too() -> None:
    task = load_task("push_cube_to_mark")
    (name,) = task.manipulated
    problem = problem_of(task, {name: upright(0.5, 0.0, 0.02)})
    target = target_of(problem, name)
    assert target.relation == "at"
    assert tuple(target.T_base[:2, 3]) == task.mark_of(name)
