"""The likelihood against SciPy, and what it makes of turns, outliers and coins."""

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy import integrate, stats

from bridge.geometry import se3
from twin.calibrate.physics.cases import Case, Prediction, planar
from twin.calibrate.physics.likelihood import (
    DEGREES,
    EXPECTED_M,
    LEVER_M,
    NOISE_SHARE,
    POSE_DISCREPANCY_M,
    SHARED_WAY,
    SHARED_WIDTH_M,
    WIDTH_DISCREPANCY_M,
    WIDTH_SIGMA_M,
    DiscrepancyPosterior,
    Features,
    Score,
    features_of,
    observations_of,
    scales_of,
    score,
    unflatten,
)

sys.path.insert(0, str(Path(__file__).parent))
import synthetic

GOOD = np.array([0.5, -0.1, 0.2])


def seen(**changes: object) -> Case:
    return Case(**{**vars(synthetic.make_case("squeeze", 0, num_holds=1)), **changes})


def predicted(pose: np.ndarray, width_m: float = 0.04) -> Prediction:
    return Prediction(settled=pose[None], held_widths_m=np.array([width_m]))


def weights(sizes_m: tuple[float, ...]) -> np.ndarray:
    """Log-normal, as believed beforehand."""
    dense = stats.norm.pdf(np.log2(np.array(sizes_m) / EXPECTED_M))
    return dense / dense.sum()


@pytest.mark.parametrize(("own_sigma", "axes"), [(0.0, 2), (0.003, 2), (0.003, 3)])
def test_poses_and_widths_follow_mixtures_of_the_t_distributions_of_scipy(
    own_sigma: float, axes: int
) -> None:
    # The turn of what was held, by two axes, does not count.
    widths = np.full(3 - axes, 0.0407)
    case = seen(settled=GOOD[None], hold_times_s=np.zeros(3 - axes), held_widths_m=widths)
    pose = np.array([0.502, -0.101, 0.23])
    observed = observations_of([case])
    scales = scales_of(observed, np.full(3 + len(widths), own_sigma**2))
    said = Prediction(settled=pose[None], held_widths_m=0 * widths + 0.04)
    found = score(observed, features_of([case], [said]), scales=scales)
    way = GOOD / np.linalg.norm(GOOD * [1.0, 1.0, LEVER_M])
    likelihood = 0.0
    for share in NOISE_SHARE:
        for size, weight in zip(POSE_DISCREPANCY_M, weights(POSE_DISCREPANCY_M), strict=True):
            scale = share**2 * case.settled_covariance[0] + own_sigma**2 * np.eye(3)
            scale += size**2 * np.diag([1, 1, LEVER_M**-2])
            t = stats.multivariate_t(pose[:axes], scale[:axes, :axes], df=DEGREES)
            density = over_shared(
                lambda z, t=t, d=size: t.pdf((GOOD - SHARED_WAY * d * z * way)[:axes])
            )
            likelihood += weight * density / len(NOISE_SHARE)
    held = 0.0
    for size, weight in zip(WIDTH_DISCREPANCY_M, weights(WIDTH_DISCREPANCY_M), strict=True):
        t = stats.t(DEGREES, 0.04, np.sqrt(size**2 + WIDTH_SIGMA_M**2 + own_sigma**2))
        held += weight * over_shared(lambda z, t=t: t.pdf(0.0407 - SHARED_WIDTH_M * z))
    expected = np.log(likelihood) + len(widths) * np.log(held)
    assert found.log_likelihood == pytest.approx(expected, abs=2e-3)


def over_shared(density: Callable[[float], float]) -> float:
    """An integral over a standard normal error."""
    return integrate.quad(lambda z: stats.norm.pdf(z) * density(z), -8, 8)[0]


def test_what_slides_have_in_common_gets_no_surer_by_repetition() -> None:
    def sigma_m(count: int) -> float:
        cases = scattered(count, 0.002, 8, kind="slide", moved=True)
        steps = np.linspace(-0.004, 0.004, 41)
        way = GOOD / np.linalg.norm(GOOD * [1.0, 1.0, LEVER_M])
        logs = np.array([worth(cases, GOOD + s * way).log_likelihood for s in steps])
        dense = np.exp(logs - logs.max())
        mean = np.average(steps, weights=dense)
        return float(np.sqrt(np.average((steps - mean) ** 2, weights=dense)))

    assert sigma_m(6) < 1.3 * 0.002
    assert sigma_m(96) > 0.5 * SHARED_WAY * 0.002


def test_one_jam_at_another_place_does_not_make_the_others_less_sure() -> None:
    def drop(*extra_m: float) -> float:
        widths = np.array([0.0470, 0.0472, 0.0468, 0.0471, *extra_m])
        cases = [seen(hold_times_s=np.zeros(1), held_widths_m=np.array([w])) for w in widths]
        observed = observations_of(cases)
        rows = [
            score(observed, features_of(cases, [predicted(np.zeros(3), at)] * len(cases)))
            for at in (0.0470, 0.0500)
        ]
        return rows[0].log_likelihood - rows[1].log_likelihood

    assert drop() > 2.0
    assert drop(0.0439) > 0.7 * drop()


def standing(pose: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = se3.rotation_from_vector(np.array([0.0, 0.0, pose[2]]))
    T[:2, 3] = pose[:2]
    return T


def scattered(
    count: int, sigma_m: float, seed: int, kind: str = "push", *, moved: bool = False
) -> list[Case]:
    """Poses around one, of which localisation states 2.5 mm and 0.083 rad."""
    rng = np.random.default_rng(seed)
    stated = np.diag([0.0025, 0.0025, 0.0025 / LEVER_M])[None] ** 2
    poses = GOOD + rng.standard_normal((count, 3)) * [sigma_m, sigma_m, sigma_m / LEVER_M]
    return [
        seen(
            kind=kind,
            Ts_base_start={"cube": np.eye(4) if moved else standing(pose)},
            settled=pose[None],
            settled_covariance=stated,
            hold_times_s=np.zeros(0),
            held_widths_m=np.zeros(0),
        )
        for pose in poses
    ]


def worth(cases: list[Case], pose: np.ndarray, prior: DiscrepancyPosterior | None = None) -> Score:
    said = Prediction(settled=pose[None], held_widths_m=np.zeros(0))
    return score(observations_of(cases), features_of(cases, [said] * len(cases)), prior=prior)


def test_what_some_episodes_teach_of_errors_is_taken_to_the_next_by_the_rule_of_bayes() -> None:
    cases = [*scattered(6, 0.001, 1), *scattered(5, 0.004, 2, kind="slide")]
    first = worth(cases[:8], GOOD)
    second = worth(cases[8:], GOOD, first.posterior)
    together = worth(cases, GOOD)
    assert first.log_likelihood + second.log_likelihood == pytest.approx(together.log_likelihood)
    np.testing.assert_allclose(second.posterior.share, together.posterior.share)
    for kind in ("push", "slide"):
        np.testing.assert_allclose(second.posterior.pose[kind], together.posterior.pose[kind])


def test_an_error_that_all_localisations_share_does_not_hide_a_better_point() -> None:
    # 0.3 mm of scatter, of which 2.5 mm are stated: 1.5 mm are five standard deviations.
    cases, off = scattered(14, 0.0003, 3), GOOD + np.array([0.0015, 0.0, 0.0])
    right, wrong = worth(cases, GOOD), worth(cases, off)
    assert right.posterior.most_likely()["noise_share"] == NOISE_SHARE[-1]
    assert right.log_likelihood - wrong.log_likelihood > 20.0
    new = scattered(6, 0.0003, 4)
    gain = worth(new, GOOD, right.posterior).log_likelihood
    assert gain - worth(new, off, wrong.posterior).log_likelihood > 6.0


def test_poses_that_scatter_as_stated_count_as_stated() -> None:
    well = [
        Case(**{**vars(case), "settled_covariance": case.settled_covariance / 100.0})
        for case in scattered(10, 0.00025, 5)
    ]
    poorly = scattered(10, 0.0025, 6)
    assert worth(well + poorly, GOOD).posterior.most_likely()["noise_share"] in NOISE_SHARE[:2]


def test_how_fingers_jam_on_an_object_is_counted_once() -> None:
    turned = GOOD + np.array([0.0, 0.0, 0.1])

    def loss(case: Case) -> float:
        observed = observations_of([case])
        width = np.full(len(case.hold_times_s), 0.04)
        told = [Prediction(settled=pose[None], held_widths_m=width) for pose in (GOOD, turned)]
        good, off = (score(observed, features_of([case], [item])).log_likelihood for item in told)
        return good - off

    pushed = scattered(1, 0.0, 9)[0]
    held = Case(**{**vars(pushed), "hold_times_s": np.zeros(1), "held_widths_m": np.full(1, 0.04)})
    assert loss(pushed) > 1.0
    assert loss(held) == pytest.approx(0.0, abs=0.05)


def test_each_kind_of_episode_has_a_discrepancy_of_its_own() -> None:
    cases = [*scattered(12, 0.0003, 6), *scattered(12, 0.008, 7, kind="slide")]
    found = worth(cases, GOOD).posterior.most_likely()["pose_m"]
    assert isinstance(found, dict)
    assert found["push"] <= 0.001
    assert found["slide"] >= 0.004


def test_turns_that_look_the_same_are_the_same() -> None:
    case = seen(settled=np.array([[0.5, -0.1, 0.75]]))
    observed = observations_of([case])
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
    observed = observations_of(cases)
    good = np.array([0.5, -0.1, 0.2])
    missed = np.array([0.9, -0.1, 0.2])
    near = [predicted(good + np.array([0.0005, 0, 0])) for _ in range(7)]
    far = [predicted(good + np.array([0.006, 0, 0])) for _ in range(7)]
    one_miss = score(observed, features_of(cases, [*near, predicted(missed)]))
    all_off = score(observed, features_of(cases, [*far, predicted(good)]))
    assert one_miss.log_likelihood > all_off.log_likelihood


def test_features_survive_the_way_through_one_row() -> None:
    cases = [seen(), seen()]
    observed = observations_of(cases)
    features = features_of(
        cases, [predicted(np.array([0.1, 0.2, 0.3]), 0.05), predicted(np.zeros(3))]
    )
    back = unflatten(features.flat(), observed)
    for name in Features.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(back, name), getattr(features, name))


def test_the_turn_of_a_tipped_box_is_that_of_a_level_side() -> None:
    T = np.eye(4)
    T[:3, :3] = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])
    assert np.isfinite(planar(T)).all()
    assert planar(T)[2] == pytest.approx(np.pi)
