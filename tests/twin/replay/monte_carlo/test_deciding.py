"""Laws of drawing varied replays, and what goes with their success: ranked against chance."""

import json
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import stats
from verdicts import verdict_of

from bridge.geometry import se3
from bridge.task.task_file import load_task
from bridge.task.verdict import Factor, Verdict
from twin.replay.config import ReplayConfig
from twin.replay.deciding import goes_with_success, what_decides
from twin.replay.monte_carlo import draw_variation, sample_rng, with_samples
from twin.replay.scene import ReplayScene

NAMES = ["cube along x m", "cube along y m", "finger friction times", "grip delay s"]


def verdict(accepted: bool, **more: Any) -> Verdict:
    return verdict_of(terminal=Factor(value=accepted, cause=None if accepted else "inside"), **more)


def said(values: np.ndarray, good: np.ndarray) -> Verdict:
    samples = {
        "accepted": good.tolist(),
        "cause": ["" if each else "inside" for each in good],
        "missed_m": [None] * len(good),
        "drawn": {name: row.tolist() for name, row in zip(NAMES, values, strict=True)},
    }
    p = {"k": int(good.sum()), "n": len(good), "value": good.mean(), "low": 0.0, "high": 1.0}
    return verdict(True, p_success=p, samples=samples)


def test_what_decides_is_named_first_and_as_strong_as_somers_d() -> None:
    rng = np.random.default_rng(3)
    values = rng.normal(size=(4, 60))
    good = values[1] + 0.3 * rng.normal(size=60) > 0.2
    found = goes_with_success(said(values, good))
    text, strength = next(iter(found.items()))
    assert text.startswith("cube along y: ")
    yes_mm, no_mm = (1e3 * np.median(values[1][which]) for which in (good, ~good))
    assert f"{yes_mm:+.1f} mm where it succeeds, {no_mm:+.1f} mm where not" in text
    assert strength == pytest.approx(stats.somersd(good, values[1]).statistic)
    assert list(found.values()) == sorted(found.values(), reverse=True)


def test_a_quantity_that_fails_to_both_sides_is_found_by_its_distance() -> None:
    values = np.random.default_rng(4).normal(size=(4, 60))
    found = goes_with_success(said(values, np.abs(values[0]) < 0.7))
    assert next(iter(found)).startswith("cube along x off the middle: ")


def test_equal_draws_count_half() -> None:
    rng = np.random.default_rng(5)
    values = rng.integers(0, 3, size=(4, 40)).astype(float)
    good = values[2] + rng.random(40) > 1.4
    strength = goes_with_success(said(values, good)).popitem()[1]
    assert strength == pytest.approx(stats.somersd(good, values[2]).statistic)


def test_chance_alone_names_something_once_in_twenty() -> None:
    rng = np.random.default_rng(6)
    named = 0
    for _ in range(200):
        good = rng.random(16) < 0.5
        good[:2] = True, False
        named += any(goes_with_success(said(rng.normal(size=(4, 16)), good)).values())
    assert named <= stats.binom(200, 0.05).ppf(0.999)


@pytest.mark.parametrize("good", [[True] * 8, [False] * 8])
def test_samples_that_end_alike_show_nothing(good: list[bool]) -> None:
    found = goes_with_success(said(np.random.default_rng(0).normal(size=(4, 8)), np.array(good)))
    word = "succeed" if good[0] else "fail"
    assert found == {f"all {word}, so none shows what decides": 0.0}


def test_few_samples_show_nothing_and_more_are_asked_for() -> None:
    values = np.random.default_rng(1).normal(size=(4, 4))
    ((text, strength),) = goes_with_success(said(values, values[0] > np.median(values[0]))).items()
    assert strength == 0
    assert text.startswith("none of 4 varied quantities")
    assert text.endswith("more samples may show one")


def test_a_verdict_of_before_samples_were_kept_is_read_and_says_so() -> None:
    p = {"k": 4, "n": 8, "value": 0.5, "low": 0.2, "high": 0.8}
    old = json.loads(verdict(True, p_success=p).to_json())
    assert "samples" not in old
    read = Verdict.from_json(json.dumps(old).encode())
    assert list(goes_with_success(read)) == ["what they varied was not kept: replay once more"]
    assert goes_with_success(replace(read, p_success=None)) == {}
    assert not list(what_decides(read))


def test_a_plan_that_misses_says_by_how_much() -> None:
    outside = {"kind": "inside", "value": False, "detail": "the middle is outside the box"}
    missed = verdict(False, findings=({**outside, "short_m": 0.0031},))
    assert list(what_decides(missed)) == ["the middle is outside the box, 3 mm short"]
    deep = Factor(value=False, detail="a finger is 7 mm inside the cube")
    assert list(what_decides(replace(missed, clearance=deep))) == [deep.detail]


def test_what_was_drawn_is_kept_and_decides(script: SimpleNamespace) -> None:
    """The cube's place along y decides here; what a verdict kept says so after its bytes."""
    scene: ReplayScene = script.scene()
    config = ReplayConfig(samples=24)
    y_m = scene.Ts_base_object["cube"][1, 3]

    def replay(there: ReplayScene, _: ReplayConfig) -> Verdict:
        return verdict(bool(there.Ts_base_object["cube"][1, 3] > y_m + 0.001))

    told = with_samples(verdict(True), replay, scene, config, identity="start")
    read = Verdict.from_json(told.to_json())
    assert read.samples is not None
    for k in range(24):
        there, varied = draw_variation(sample_rng(0, "start", k), scene, config, index=k)
        drawn = {name: values[k] for name, values in read.samples["drawn"].items()}
        shift_m = there.Ts_base_object["cube"][:3, 3] - scene.Ts_base_object["cube"][:3, 3]
        assert drawn["cube along y m"] == pytest.approx(shift_m[1], rel=1e-2)
        assert drawn["grip delay s"] == pytest.approx(varied.grip_delay_s, rel=1e-2)
        assert drawn["finger friction times"] == pytest.approx(
            varied.physics.finger_friction / config.physics.finger_friction, rel=1e-2
        )
        assert read.samples["accepted"][k] is bool(shift_m[1] > 0.001)
    assert "rate hz times" not in read.samples["drawn"]
    text, strength = next(iter(goes_with_success(read).items()))
    assert text.startswith("cube along y: +")
    assert strength == pytest.approx(1.0)
    assert text in str(told.reason)


def draws(scene: ReplayScene, count: int) -> list[ReplayScene]:
    return [draw_variation(sample_rng(0, "s", k), scene, ReplayConfig())[0] for k in range(count)]


def test_correlated_errors_are_drawn_with_their_correlation(script: SimpleNamespace) -> None:
    """The sample covariance is that of the localisation, all six numbers of it."""
    scene = script.scene()
    T = scene.Ts_base_object["cube"].copy()
    T[2, 3] += 0.2  # in the air: nothing is known of its height and tilt
    root = np.random.default_rng(1).normal(size=(6, 6)) * 1e-2
    covariance = root @ root.T
    scene = replace(
        scene, Ts_base_object={**scene.Ts_base_object, "cube": T}, covariances={"cube": covariance}
    )
    steps = []
    for draw in draws(scene, 2000):
        moved = draw.Ts_base_object["cube"]
        turn = se3.vector_from_rotation(moved[:3, :3] @ T[:3, :3].T)
        steps.append(np.concatenate([moved[:3, 3] - T[:3, 3], turn]))
    found = np.cov(np.array(steps).T)
    deviations = np.sqrt(np.diag(covariance))
    # 5 standard errors of a correlation over 2000 draws
    np.testing.assert_allclose(
        found / np.outer(deviations, deviations),
        covariance / np.outer(deviations, deviations),
        atol=5 / np.sqrt(2000),
    )


def test_mass_and_stiffness_of_a_soft_body_are_independent() -> None:
    task = load_task("sloth_into_basket")
    T = np.eye(4)
    T[2, 3] = task.objects["sloth"].rest_height_m
    scene = ReplayScene(task=task, Ts_base_object={"sloth": T}, urdf="")
    found = [draw.task.objects["sloth"] for draw in draws(scene, 400)]
    assert found[0].soft is not None
    masses = np.log([model.mass_kg for model in found])
    stiffnesses = np.log([model.soft.young_pa for model in found if model.soft is not None])
    assert abs(np.corrcoef(masses, stiffnesses)[0, 1]) < 5 / np.sqrt(400)
    assert np.std(stiffnesses) == pytest.approx(0.3, rel=0.2)
