"""The likelihood against SciPy, and what it makes of turns, outliers and coins."""

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from twin.calibrate.physics.case import Case, Prediction, planar
from twin.calibrate.physics.likelihood import (
    DEGREES,
    LEVER_M,
    POSE_DISCREPANCY_M,
    SHARED_WIDTH_M,
    WIDTH_DISCREPANCY_M,
    WIDTH_SIGMA_M,
    Features,
    features_of,
    observations_of,
    score,
    unflatten,
)

sys.path.insert(0, str(Path(__file__).parent))
import synthetic

KNOWN = (POSE_DISCREPANCY_M[1], WIDTH_DISCREPANCY_M[1])


def seen(**changes: object) -> Case:
    return Case(**{**vars(synthetic.make_case("squeeze", 0, num_holds=1)), **changes})


def predicted(pose: np.ndarray, width_m: float = 0.04, success: float = np.nan) -> Prediction:
    return Prediction(settled=pose[None], held_widths_m=np.array([width_m]), success=success)


def test_poses_and_widths_follow_the_t_distributions_of_scipy() -> None:
    case = seen(settled=np.array([[0.5, -0.1, 0.2]]), held_widths_m=np.array([0.0407]))
    pose = np.array([0.502, -0.101, 0.23])
    observed = observations_of([case], 0)
    found = score(observed, features_of([case], [predicted(pose)]), discrepancies_m=KNOWN)
    scale = case.settled_covariance[0] + KNOWN[0] ** 2 * np.diag([1, 1, LEVER_M**-2])
    expected = stats.multivariate_t.logpdf(case.settled[0], pose, scale, df=DEGREES)
    sigma = np.sqrt(KNOWN[1] ** 2 + WIDTH_SIGMA_M**2 + SHARED_WIDTH_M**2)
    expected += stats.t.logpdf(0.0407, DEGREES, 0.04, sigma)
    assert found.log_likelihood == pytest.approx(expected)


def test_turns_that_look_the_same_are_the_same() -> None:
    case = seen(settled=np.array([[0.5, -0.1, 0.75]]))
    observed = observations_of([case], 0)
    values = [
        score(
            observed,
            features_of([case], [predicted(np.array([0.5, -0.1, 0.75 + quarter * np.pi / 2]))]),
        ).log_likelihood
        for quarter in (-2, -1, 0, 1, 3)
    ]
    np.testing.assert_allclose(values, values[0])


def test_one_miss_does_not_outweigh_the_rest() -> None:
    cases = [seen(settled=np.array([[0.5, -0.1, 0.2]])) for _ in range(8)]
    observed = observations_of(cases, 0)
    good = np.array([0.5, -0.1, 0.2])
    missed = np.array([0.9, -0.1, 0.2])
    near = [predicted(good + np.array([0.0005, 0, 0])) for _ in range(7)]
    far = [predicted(good + np.array([0.006, 0, 0])) for _ in range(7)]
    one_miss = score(observed, features_of(cases, [*near, predicted(missed)]))
    all_off = score(observed, features_of(cases, [*far, predicted(good)]))
    assert one_miss.log_likelihood > all_off.log_likelihood


def test_a_coin_counts_by_the_share_of_noisy_starts() -> None:
    case = seen(success=True)
    observed = observations_of([case], 4)
    values = [
        score(
            observed, features_of([case], [predicted(case.settled[0], success=share)])
        ).log_likelihood
        for share in (0.0, 0.5, 1.0)
    ]
    assert values[0] < values[1] < values[2]
    assert values[2] - values[0] == pytest.approx(np.log(0.9 / 0.1))


def test_features_survive_the_way_through_one_row() -> None:
    cases = [seen(success=True), seen()]
    observed = observations_of(cases, 4)
    features = features_of(
        cases, [predicted(np.array([0.1, 0.2, 0.3]), 0.05, 0.5), predicted(np.zeros(3))]
    )
    back = unflatten(features.flat(), observed)
    for name in Features.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(back, name), getattr(features, name))


def test_the_turn_of_a_tipped_box_is_that_of_a_level_side() -> None:
    T = np.eye(4)
    T[:3, :3] = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])
    assert np.isfinite(planar(T)).all()
    assert planar(T)[2] == pytest.approx(np.pi)
