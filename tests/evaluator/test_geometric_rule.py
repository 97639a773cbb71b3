"""Forecasts without a twin: a rule worked out by hand, and baselines beside the twin's answers."""

from collections.abc import Sequence

import numpy as np
import pytest
from jaxtyping import Float
from small_plans import plan_of, waypoint

from bridge.geometry import se3
from bridge.task.plan import Plan
from bridge.task.task_file import load_task
from evaluator.compare.baselines import GEOMETRIC_RULE, RuleSummary, baseline_results, with_rule
from evaluator.compare.rows import TrialRow
from evaluator.compare.success import WITHOUT
from evaluator.metrics.geometric_rule import RuleAnswer, judge_by_geometry
from evaluator.result import Measurement
from evaluator.statistics.differences import paired_points

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
    tau = tuple(
        waypoint(t_s, moved @ pose(p_m, R=DOWN), None if g else width_m, g)
        for t_s, (p_m, g) in enumerate(steps)
    )
    return plan_of(robot="ur5_parallel_gripper", tau=tau)


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


def trial(
    number: int,
    recorded: bool,
    twin: bool | None,
    rule: bool | None,
    *,
    task: str = "cube_into_box",
) -> TrialRow:
    """One trial without replanning; the rule may be unknown."""
    return TrialRow(
        episode=f"trial_{number:04d}",
        task=task,
        condition=WITHOUT,
        policy="nominal",
        start_id=None,
        cell="cell",
        stand_in=True,
        recorded=recorded,
        sim_planned=twin,
        verdict=twin,
        baselines=() if rule is None else ((GEOMETRIC_RULE, rule),),
    )


def study() -> list[TrialRow]:
    """60 trials: the twin is right in 48, the rule in 38; 15 only the twin, 5 only the rule."""
    made = []
    for count, twin_right, rule_right in (
        (33, True, True),
        (15, True, False),
        (5, False, True),
        (7, False, False),
    ):
        for k in range(count):
            outcome = k % 2 == 0
            made.append((outcome, outcome == twin_right, outcome == rule_right))
    return [
        trial(number, *answers, task="stack" if number % 3 else "push")
        for number, answers in enumerate(made)
    ]


def by_id(measurements: Sequence[Measurement]) -> dict[str, Measurement]:
    return {m.id: m for m in measurements}


def test_the_paired_difference_counts_the_trials_only_one_got_right() -> None:
    found = by_id(baseline_results(study()))
    gain = found["baseline.sim_planned.geometric_rule.twin_gain_pp"]
    expected = paired_points(15, 5, 60)[1]
    assert gain.value == pytest.approx(100 * 10 / 60)
    assert (gain.interval.low, gain.interval.high) == pytest.approx((expected.low, expected.high))
    accuracy = found["baseline.sim_planned.geometric_rule.rate"]
    assert (accuracy.k, accuracy.n) == (38, 60)


def test_always_yes_is_right_as_often_as_trials_succeed() -> None:
    rows = study()
    succeeded = sum(row.recorded for row in rows)
    base = by_id(baseline_results(rows))["baseline.sim_planned.base_rate"]
    assert (base.k, base.n) == (succeeded, 60)


def test_both_are_judged_over_the_trials_where_both_spoke() -> None:
    rows = [trial(0, True, True, True), trial(1, True, True, None), trial(2, False, None, False)]
    found = by_id(baseline_results(rows))
    assert found["baseline.sim_planned.geometric_rule.rate"].n == 1
    assert found["baseline.sim_planned.base_rate"].n == 2


def test_a_run_without_the_rules_answers_still_names_its_base_rate() -> None:
    found = by_id(baseline_results([trial(0, True, True, None)]))
    assert found["baseline.sim_planned.base_rate"].value == 1.0
    assert not any(GEOMETRIC_RULE.replace(" ", "_") in key for key in found)


def test_without_answers_of_the_twin_nothing_is_compared() -> None:
    assert baseline_results([trial(0, True, None, True)]) == []


def test_the_rule_enters_the_row_of_its_trial_only() -> None:
    rows = [trial(0, True, True, None), trial(1, True, True, None)]
    plain, judged = with_rule(rows, [RuleSummary(episode="trial_0001", value=False)])
    assert plain == rows[0]
    assert judged.baselines == ((GEOMETRIC_RULE, False),)
    unknown = [RuleSummary(episode="trial_0001", value=None)]
    assert with_rule(rows, unknown) == rows
