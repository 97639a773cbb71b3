"""Varied replays: what is drawn, from what, the same everywhere, and what they add up to."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from verdicts import verdict_of

from bridge.errors import GstError
from bridge.geometry import se3
from bridge.task.task_file import load_task
from bridge.task.verdict import Factor, Verdict
from twin.errors import TwinError
from twin.physics.config import PhysicsConfig
from twin.replay.config import UNKNOWN_POSE_M, ReplayConfig, VariationConfig
from twin.replay.monte_carlo import decided, draw_variation, given_upright, sample_rng, with_samples
from twin.replay.path import path_of_plan
from twin.replay.rebuilt_scene import calibrated
from twin.replay.scene import ReplayScene
from twin.robot.model import load_robot
from twin.scene.store.calibration import Calibration

UNSURE = np.diag([4e-6, 9e-6, 1e-6, 1e-4, 1e-4, 4e-4])
CORRELATED = UNSURE.copy()
CORRELATED[0, 1] = CORRELATED[1, 0] = 4e-6


def scene_with(script: SimpleNamespace, covariance: np.ndarray | None = CORRELATED) -> ReplayScene:
    scene: ReplayScene = script.scene()
    spreads = {} if covariance is None else dict.fromkeys(scene.Ts_base_object, covariance)
    return replace(scene, covariances=spreads)


def draws(
    scene: ReplayScene, count: int, **settings: Any
) -> list[tuple[ReplayScene, ReplayConfig]]:
    config = ReplayConfig(variation=VariationConfig(**settings))
    return [draw_variation(sample_rng(0, "start", k), scene, config) for k in range(count)]


def verdict(accepted: bool | None) -> Verdict:
    cause = "inside" if accepted is False else None
    return verdict_of(terminal=Factor(value=accepted, cause=cause))


def test_what_stands_goes_on_standing_and_moves_as_far_as_localisation_is_unsure(
    script: SimpleNamespace,
) -> None:
    scene = scene_with(script)
    T = scene.Ts_base_object["cube"]
    moved = np.array([there.Ts_base_object["cube"] for there, _ in draws(scene, 800)])
    np.testing.assert_array_equal(moved[:, 2, 3], T[2, 3])
    np.testing.assert_allclose(moved[:, 2, 2], 1.0, atol=1e-12)
    shifts = moved[:, :2, 3] - T[:2, 3]
    # Compared with the sampling error of 800 draws (5 standard errors).
    np.testing.assert_allclose(np.cov(shifts.T), CORRELATED[:2, :2], atol=5 * 9e-6 / np.sqrt(400))
    turns = np.arctan2(*(T[:3, :3].T @ moved[:, :3, :3])[:, (1, 0), 0].T)
    assert np.std(turns) == pytest.approx(0.02, rel=0.12)


def test_given_upright_is_the_conditional_distribution() -> None:
    rng = np.random.default_rng(3)
    root = rng.normal(size=(6, 6)) * 1e-2
    covariance = root @ root.T
    left = given_upright(covariance)
    precision = np.linalg.inv(covariance)
    keep = [0, 1, 5]  # a conditional covariance is the inverse of that block of the precision
    np.testing.assert_allclose(
        left[np.ix_(keep, keep)], np.linalg.inv(precision[np.ix_(keep, keep)]), rtol=1e-8
    )
    assert not left[[2, 3, 4]].any()


def test_a_cube_turned_by_a_quarter_is_the_same_cube(script: SimpleNamespace) -> None:
    anyhow = np.diag([0.0, 0.0, 0.0, 0.0, 0.0, 100.0])
    scene = scene_with(script, anyhow)
    cube = scene.Ts_base_object["cube"]
    turns = [
        se3.rotation_angle_rad(cube[:3, :3].T @ there.Ts_base_object["cube"][:3, :3])
        for there, _ in draws(scene, 200)
    ]
    assert np.max(turns) <= np.pi / 4 + 1e-9
    assert np.max(turns) > 0.6


def test_a_toy_looks_different_from_every_side() -> None:
    task = load_task("sloth_into_basket")
    T = np.eye(4)
    T[2, 3] = task.objects["sloth"].rest_height_m
    scene = ReplayScene(
        task=task,
        Ts_base_object={"sloth": T},
        urdf="",
        covariances={"sloth": np.diag([0.0, 0.0, 0.0, 0.0, 0.0, 100.0])},
    )
    yaws = [np.arctan2(*d.Ts_base_object["sloth"][(1, 0), 0]) for d, _ in draws(scene, 200)]
    assert stats.kstest(yaws, "uniform", args=(-np.pi, 2 * np.pi)).pvalue > 1e-3


def test_without_a_covariance_the_prior_says_how_unsure_a_pose_is(script: SimpleNamespace) -> None:
    scene = scene_with(script, None)
    moved = np.array([d.Ts_base_object["cube"] for d, _ in draws(scene, 300)])
    assert np.std(moved[:, 0, 3]) == pytest.approx(UNKNOWN_POSE_M, rel=0.2)


def test_physics_is_log_normal_around_what_the_nominal_replay_uses(script: SimpleNamespace) -> None:
    scene = scene_with(script)
    found = draws(scene, 600)
    frictions = np.log([config.physics.object_friction / 0.8 for _, config in found])
    assert stats.kstest(frictions / 0.4, "norm").pvalue > 1e-3
    masses = np.log([there.task.objects["cube"].mass_kg for there, _ in found])
    assert np.exp(np.median(masses)) == pytest.approx(scene.task.objects["cube"].mass_kg, rel=0.05)
    assert all(d.task.objects["box"] == scene.task.objects["box"] for d, _ in found)
    delays = [config.grip_delay_s for _, config in found]
    assert stats.kstest(delays, "uniform", args=(0.0, 0.1)).pvalue > 1e-3


def test_a_calibration_replaces_the_priors_of_what_it_identified(script: SimpleNamespace) -> None:
    found = draws(scene_with(script), 200, calibrated=(("object_friction", 0.01),))
    for friction, spread in (("object_friction", 0.01), ("finger_friction", 0.4)):
        drawn = np.log([getattr(config.physics, friction) for _, config in found])
        assert np.std(drawn) == pytest.approx(spread, rel=0.2)


def test_the_same_start_draws_the_same_whatever_else_is_asked(script: SimpleNamespace) -> None:
    """Common random numbers: one more object, or another order of samples, changes nothing."""
    scene = scene_with(script)
    config = ReplayConfig()
    first = [draw_variation(sample_rng(1, "a", k), scene, config) for k in (0, 1, 2)]
    again = [draw_variation(sample_rng(1, "a", k), scene, config) for k in (2, 1, 0)]
    for one, other in zip(first, reversed(again), strict=True):
        assert one[1] == other[1]
        assert one[0].task == other[0].task
        for name, T in one[0].Ts_base_object.items():
            np.testing.assert_array_equal(T, other[0].Ts_base_object[name])
    others = [sample_rng(2, "a", 0), sample_rng(1, "b", 0), sample_rng(1, "a", 1)]
    values = {rng.random() for rng in [sample_rng(1, "a", 0), *others]}
    assert len(values) == 4


def test_a_lost_object_does_not_change_what_the_others_draw(script: SimpleNamespace) -> None:
    scene = scene_with(script)
    only = replace(scene, Ts_base_object={"cube": scene.Ts_base_object["cube"]})
    config = ReplayConfig()
    whole, _ = draw_variation(sample_rng(0, "s", 0), scene, config)
    part, _ = draw_variation(sample_rng(0, "s", 0), only, config)
    np.testing.assert_array_equal(whole.Ts_base_object["cube"], part.Ts_base_object["cube"])
    assert set(part.Ts_base_object) == {"cube"}


def asked(
    scene: ReplayScene, answers: list[Any], until: float | None = None
) -> tuple[Any, list[tuple[ReplayScene, Any]]]:
    """The success probability when varied replays answer so, and what was replayed."""
    seen: list[tuple[ReplayScene, ReplayConfig]] = []

    def replay(there: ReplayScene, config: ReplayConfig) -> Verdict:
        seen.append((there, config))
        answer = answers[len(seen) - 1]
        if isinstance(answer, GstError):
            raise answer
        return verdict(answer)

    config = ReplayConfig(samples=len(answers))
    said = with_samples(verdict(True), replay, scene, config, identity="start", until=until)
    return said.p_success, seen


NOWHERE = ReplayScene(task=load_task("cube_into_box"), Ts_base_object={}, urdf="")


@pytest.mark.parametrize(
    ("answers", "until", "n"),
    [
        ([True] * 32, 0.0, 7),
        ([False] * 32, 0.0, 7),
        ([True, False] * 16, 0.0, 32),
        ([True] * 32, 0.595, 32),  # 0.1 + 0.9 x 0.55: as probable as nine of ten make it
        ([False] * 32, 0.595, 2),  # 3 / 8 on average, 0.01 at nine of ten
        ([True] * 32, None, 32),
        ([True] * 3 + [False] * 29, 1.0, 4),
    ],
)
def test_samples_end_once_they_decide(answers: list[bool], until: float | None, n: int) -> None:
    """By hand: all of n, C(2 n, n) / 2^n times as likely on average as by a fair coin: 14, 27."""
    p, seen = asked(NOWHERE, answers, until)
    assert (p["k"], p["n"], len(seen)) == (sum(answers[:n]), n, n)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.65, 0.9])
def test_samples_that_succeed_as_often_as_asked_seldom_decide_anything(share: float) -> None:
    """However often one looks: the exact chance over 200 samples, by counting."""
    chances, wrong = np.ones(1), 0.0
    for n in range(1, 201):
        chances = np.convolve(chances, [1 - share, share])
        over = [decided(float(k), n, share) for k in range(n + 1)]
        wrong += chances[over].sum()
        chances[over] = 0.0
    assert wrong <= 0.05


def test_a_yes_says_what_decides_it_and_what_a_little_more_would_bring() -> None:
    """Two miss by 1.2 and 2.4 mm; one by 80 mm, one touched the box."""
    inside = {"kind": "inside", "value": False, "detail": "the middle is 2 mm within the cavity"}
    missed = [
        replace(verdict(False), findings=({**inside, "short_m": short_m},))
        for short_m in (0.0012, 0.0024, 0.08)
    ]
    touched = replace(missed[0], clearance=Factor(value=False, cause="too_close"))
    nominal = replace(verdict(True), findings=({**inside, "value": True, "short_m": -0.002},))
    answers = iter([*missed, touched, nominal, nominal])

    def replay(*_: Any) -> Verdict:
        return next(answers)

    config = ReplayConfig(samples=6)
    said = with_samples(nominal, replay, NOWHERE, config, identity="start")
    assert said.reason == (
        "the middle is 2 mm within the cavity, 2 mm to spare; with 3 mm more 4 of 6 varied replays "
        "would succeed; 1 fail by inside"
    )


def test_every_sample_is_another_draw_and_the_share_has_wilsons_interval(
    script: SimpleNamespace,
) -> None:
    p, seen = asked(scene_with(script), [True, True, True, False] * 2)
    assert len({there.task.objects["cube"].mass_kg for there, _ in seen}) == 8
    assert len({config.physics.grip_force_N for _, config in seen}) == 8
    assert all(config.samples == 0 for _, config in seen)
    # Wilson (1927), by hand: centre (k + z2/2) / (n + z2), n = 8, k = 6.
    z2 = stats.norm.ppf(0.975) ** 2
    centre, half = (6 + z2 / 2) / (8 + z2), np.sqrt(z2 * (6 * 2 / 8 + z2 / 4)) / (8 + z2)
    low, high = (0.1 + 0.55 * (centre + sign * half) for sign in (-1, 1))  # nobody tried the cell
    value = 0.65 * 0.75 + 0.1 * 0.25
    assert p == pytest.approx({"value": value, "low": low, "high": high, "k": 6, "n": 8})


@given(st.lists(st.sampled_from([True, False, None]), max_size=30))
def test_the_interval_holds_the_share_and_undecided_is_no_success(said: list[bool | None]) -> None:
    p, _ = asked(NOWHERE, said)
    if not said:
        assert p is None
        return
    assert p["k"] == said.count(True)
    assert p["n"] == len(said)
    assert 0 <= p["low"] <= p["value"] <= p["high"] <= 1


def test_a_variation_that_cannot_be_replayed_costs_only_itself(script: SimpleNamespace) -> None:
    p, seen = asked(scene_with(script), [True, TwinError("the cube lies inside the box"), True])
    assert (p["k"], p["n"], len(seen)) == (2, 3, 3)


def test_a_late_gripper_lags_behind_the_arm(script: SimpleNamespace) -> None:
    scene = script.scene()
    path, _, _ = path_of_plan(script.plan(scene), load_robot(scene.urdf))
    late = path.with_late_gripper(0.2)
    times = np.arange(0, path.end_ns(), 10_000_000)
    np.testing.assert_array_equal(late.joints_at(times), path.joints_at(times))
    np.testing.assert_array_equal(late.width_at(times + 200_000_000), path.width_at(times))
    assert path.first_close_ns is not None
    assert late.first_close_ns == path.first_close_ns + 200_000_000
    assert path.with_late_gripper(0.0) is path


def calibration(**identified: Any) -> Calibration:
    return Calibration(record={"physics": {"identified": identified}}, cameras={})


def test_calibrated_settings_have_its_values_and_spreads_but_where_the_user_set_one() -> None:
    known = calibration(
        grip_force_N={"value": 14.0, "sigma_log": 0.05}, finger_friction={"value": 0.9}
    )
    task, nominal = load_task("cube_into_box"), ReplayConfig()
    config = calibrated(nominal, known, task)
    assert config.physics.grip_force_N == 14.0
    assert config.variation.calibrated == (("grip_force_N", 0.05),)
    assert config.variation.physics_spreads()["grip_force_N"] == 0.05
    assert calibrated(nominal, None, task) == calibrated(nominal, calibration(), task) == nominal
    mine = calibrated(ReplayConfig(physics=PhysicsConfig(grip_force_N=11.0)), known, task)
    assert (mine.physics.grip_force_N, mine.variation.calibrated) == (11.0, ())
