"""The forecast without a twin: hand-worked plans, and what may not change its answer."""

from collections.abc import Sequence

import numpy as np
import pytest
from jaxtyping import Float

from bridge.geometry import se3
from bridge.task.plan import Plan, Waypoint
from bridge.task.task_file import load_task
from evaluator.metrics.geometric_rule import RuleAnswer, judge_by_geometry

TASK = load_task("cube_into_box")
DOWN = np.diag([1.0, -1.0, -1.0])
"""Tool axis down; the fingers close along the table's y axis."""
CUBE, BOX = (0.5, -0.1, 0.02), (0.5, 0.2, 0.0)


Pose = Float[np.ndarray, "4 4"]


def pose(
    p_m: Sequence[float], yaw_rad: float = 0.0, R: Float[np.ndarray, "3 3"] | None = None
) -> Pose:
    """A pose on the table, turned about the vertical."""
    T = np.eye(4)
    T[:3, :3] = se3.rotation_from_vector(np.array([0.0, 0.0, yaw_rad])) @ (
        np.eye(3) if R is None else R
    )
    T[:3, 3] = p_m
    return T


def plan(
    grasp: Sequence[float] = CUBE,
    release: Sequence[float] = (0.5, 0.2, 0.10),
    *,
    width_m: float = 0.085,
    moved: Pose | None = None,
) -> Plan:
    """Close at one pose, carry, open at another; all of it moved by a rigid motion."""
    moved = np.eye(4) if moved is None else moved
    steps = [(grasp, 0), (grasp, 1), (release, 1), (release, 0)]
    tau = []
    for t_s, (p_m, g) in enumerate(steps):
        q, p = se3.split(moved @ pose(p_m, R=DOWN))
        tau.append(
            Waypoint(
                t_ns=t_s * 1_000_000_000,
                p_m=tuple(p),
                q_wxyz=tuple(q),
                g=g,
                width_m=None if g else width_m,
            )
        )
    return Plan(
        id="p",
        planner="test",
        policy="test",
        condition="without_replanning",
        robot="ur5_parallel_gripper",
        frame="base_link",
        instruction="",
        stages=(),
        tau=tuple(tau),
    )


def answer(made: Plan, *, yaw_rad: float = 0.0, moved: Pose | None = None) -> RuleAnswer:
    """Ask the rule, everything moved by the same rigid motion."""
    moved = np.eye(4) if moved is None else moved
    poses = {"cube": moved @ pose(CUBE, yaw_rad), "box": moved @ pose(BOX)}
    return judge_by_geometry(made, TASK, poses)


def test_a_centred_grasp_and_a_release_over_the_box_is_a_yes() -> None:
    found = answer(plan())
    assert found.value is True
    assert "20 mm within the cavity of box" in found.detail


@pytest.mark.parametrize(
    ("grasp", "words"),
    [
        ((0.535, -0.1, 0.02), "5 mm beside"),  # half the cube, 10 mm of pad: 30 mm are free
        ((0.5, -0.1, 0.055), "5 mm beside"),
        ((0.5, -0.077, 0.02), "not between pads"),  # 23 + 20 mm beyond 42.5
    ],
)
def test_fingers_that_do_not_enclose_the_cube_are_a_no(grasp: Sequence[float], words: str) -> None:
    found = answer(plan(grasp))
    assert found.value is False
    assert words in found.detail


def test_a_cube_across_the_corner_is_too_wide_for_half_open_fingers() -> None:
    assert answer(plan(width_m=0.05), yaw_rad=np.pi / 4).value is False
    assert answer(plan(width_m=0.05)).value is True


def test_an_offset_in_the_hand_is_carried_to_the_release() -> None:
    """The cavity ends 75 mm from its middle; the cube hangs 10 mm further out than the tool."""
    release = (0.57, 0.2, 0.10)
    assert answer(plan(release=release)).value is True
    assert answer(plan((0.49, -0.1, 0.02), release)).value is False
    assert answer(plan((0.51, -0.1, 0.02), release)).value is True


def test_closing_fingers_take_the_offset_along_their_axis_away() -> None:
    release = (0.5, 0.27, 0.10)
    assert answer(plan((0.5, -0.11, 0.02), release)).value is True
    assert answer(plan((0.5, -0.09, 0.02), release)).value is True


def test_a_cube_that_is_not_released_stays_where_the_hand_is() -> None:
    made = plan()
    held = Plan(**{**vars(made), "tau": made.tau[:-1]})
    assert answer(held).value is False  # 10 cm above the floor of a box 5 cm deep


def test_a_rigid_motion_of_everything_changes_nothing() -> None:
    rng = np.random.default_rng(7)
    for _ in range(20):
        moved = pose((*rng.uniform(-1, 1, 2), 0.0), rng.uniform(-np.pi, np.pi))
        grasp = np.array(CUBE) + rng.uniform((-0.04, -0.04, -0.01), (0.04, 0.04, 0.03))
        release = rng.uniform((0.4, 0.1, 0.1), (0.6, 0.3, 0.1))
        made, turned = plan(grasp, release), plan(grasp, release, moved=moved)
        assert answer(turned, moved=moved).value is answer(made).value


def test_what_was_not_localised_leaves_the_answer_open() -> None:
    found = judge_by_geometry(plan(), TASK, {"cube": pose(CUBE)})
    assert found.value is None
    assert found.detail == "box: not localised at the start"
