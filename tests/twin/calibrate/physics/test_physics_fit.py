"""From synthetic observations to parameters: recovered, covered, left alone, held out."""

import sys
from pathlib import Path

import numpy as np
import pytest

from twin.calibrate.config import CalibrateConfig
from twin.calibrate.physics.cases import Case
from twin.calibrate.physics.fit import Fit, fit, split_cases
from twin.calibrate.physics.parameters import (
    FINGER_FRICTION,
    MASS_SCALE,
    SURFACE_FRICTION,
    apply_values,
    rigid_parameters,
)
from twin.physics.config import PhysicsConfig

sys.path.insert(0, str(Path(__file__).parent))
import synthetic

EVERY = rigid_parameters(PhysicsConfig())
ALL = tuple(
    item
    for item in EVERY
    if item.name in (SURFACE_FRICTION, FINGER_FRICTION, MASS_SCALE, "bias_x_m")
)
PROBES = ("push", "slide", "squeeze") * 4
QUICK = CalibrateConfig(evaluations=40)

pytestmark = pytest.mark.usefixtures("unchecked")  # the first fit, made for all, is checked


def truth(**values: float) -> np.ndarray:
    return np.array([item.units(values.get(item.name, item.nominal)) for item in ALL])


def by_name(found: Fit) -> dict:
    return {item.parameter.name: item for item in found.estimates}


@pytest.fixture(scope="module")
def fitted() -> Fit:
    x = truth(**{SURFACE_FRICTION: 0.42, FINGER_FRICTION: 0.6, "bias_x_m": 0.004})
    return fit(synthetic.observe(PROBES, ALL, x, seed=1), ALL, QUICK)


def test_known_parameters_lie_in_their_intervals_and_are_promoted(fitted: Fit) -> None:
    found = by_name(fitted)
    for name, value in ((SURFACE_FRICTION, 0.42), (FINGER_FRICTION, 0.6), ("bias_x_m", 0.004)):
        assert found[name].identified, name
        assert found[name].low <= value <= found[name].high, name
        assert found[name].low <= found[name].value <= found[name].high, name
    half = (found[SURFACE_FRICTION].high - found[SURFACE_FRICTION].low) / 2
    assert half / found[SURFACE_FRICTION].value < 0.25
    assert fitted.promoted
    assert np.median(fitted.calibrated.settled_error_m) < np.median(fitted.nominal.settled_error_m)


def test_what_the_data_do_not_touch_is_reported_and_not_moved(fitted: Fit) -> None:
    found = by_name(fitted)
    assert not found[MASS_SCALE].identified
    assert found[MASS_SCALE].value == found[MASS_SCALE].parameter.nominal
    assert "not moved" in found[MASS_SCALE].why
    assert found[MASS_SCALE].sigma_share == pytest.approx(1.0, abs=0.05)


def test_without_probes_friction_is_not_identified() -> None:
    x = truth(**{SURFACE_FRICTION: 0.4, FINGER_FRICTION: 0.6, "bias_x_m": -0.004})
    found = fit(synthetic.observe(("trial",) * 6, ALL, x, seed=2), ALL, QUICK)
    for name in (SURFACE_FRICTION, FINGER_FRICTION):
        item = by_name(found)[name]
        assert not item.identified
        assert item.value == item.parameter.nominal


def test_nothing_is_promoted_when_held_out_episodes_do_not_improve() -> None:
    # The training episodes tell one story, the held-out ones the nominal one.
    wrong = synthetic.observe(PROBES, ALL, truth(**{SURFACE_FRICTION: 0.3}), seed=3)
    right = synthetic.observe(PROBES, ALL, truth(), seed=3)
    split = split_cases(wrong.cases, QUICK.seed)
    mixed = [
        (right if index in split.held_out else wrong).cases[index]
        for index in range(len(wrong.cases))
    ]
    found = fit(synthetic.Formulas(mixed, ALL), ALL, QUICK)
    assert not found.promoted
    assert "not promoted" in found.why


def test_whole_episodes_are_held_out_of_every_kind_and_a_single_one_never() -> None:
    kinds = ("slide",) * 5 + ("push",) * 2 + ("drop",)
    cases = [synthetic.make_case(kind, number) for number, kind in enumerate(kinds)]
    split = split_cases(cases, seed=4)
    assert sorted((*split.training, *split.held_out)) == list(range(len(cases)))
    held = [cases[index].kind for index in split.held_out]
    assert sorted(held) == ["push", "slide", "slide"]
    assert split == split_cases(cases, seed=4)


def test_the_same_seed_gives_the_same_bits(fitted: Fit) -> None:
    x = truth(**{SURFACE_FRICTION: 0.42, FINGER_FRICTION: 0.6, "bias_x_m": 0.004})
    again = fit(synthetic.observe(PROBES, ALL, x, seed=1), ALL, QUICK)
    assert [item.value for item in again.estimates] == [item.value for item in fitted.estimates]


def test_a_search_that_ran_out_of_time_says_so(fitted: Fit) -> None:
    assert fitted.cut_short == ""
    some = tuple(item for item in ALL if item.name == SURFACE_FRICTION)
    cases = synthetic.observe(("push", "slide") * 4, some, np.zeros(1), seed=1)
    found = fit(cases, some, CalibrateConfig(evaluations=20, budget_s=0.0))
    assert found.cut_short == "the time limit of 0 s struck after 1 of 20 points"


def test_found_values_go_into_the_configuration_of_replays() -> None:
    config = apply_values(
        {SURFACE_FRICTION: 0.4, FINGER_FRICTION: 0.6, MASS_SCALE: 2.0}, PhysicsConfig()
    )
    assert config.surface_friction * config.object_friction == pytest.approx(0.4)
    assert config.finger_friction * config.object_friction == pytest.approx(0.6)
    assert config.grip_force_N == PhysicsConfig().grip_force_N


def test_parameters_go_to_units_of_the_prior_and_back() -> None:
    for item in EVERY:
        low, high = item.bounds
        assert low < 0 < high
        for x in (low, -0.3, 0.0, 0.7, high):
            assert item.units(item.value(x)) == pytest.approx(x, abs=1e-9)
        assert item.value(0.0) == pytest.approx(item.nominal)


@pytest.mark.slow
def test_intervals_cover_the_truth_as_often_as_they_say() -> None:
    some = tuple(item for item in EVERY if item.name in (SURFACE_FRICTION, "bias_x_m", "bias_y_m"))
    rng = np.random.default_rng(5)
    inside, total = 0, 0
    for seed in range(8):
        x = 0.7 * rng.standard_normal(len(some))
        found = fit(
            synthetic.observe(("push", "slide") * 4, some, x, seed=100 + seed),
            some,
            CalibrateConfig(evaluations=20, seed=seed),
        )
        for item, u in zip(found.estimates, x, strict=True):
            inside += item.low <= item.parameter.value(u) <= item.high
            total += 1
    # 24 intervals: 23 expected; with 19 or fewer they would be too short (p = 0.006).
    assert 20 <= inside <= total


def test_an_object_that_was_not_found_again_counts_nothing() -> None:
    x = truth(**{SURFACE_FRICTION: 0.42})
    cases = synthetic.observe(PROBES, ALL, x, seed=6).cases
    lost = [
        Case(**{**vars(case), "settled": np.full((1, 3), np.nan)}) if index == 1 else case
        for index, case in enumerate(cases)
    ]
    found = fit(synthetic.Formulas(lost, ALL), ALL, QUICK)
    item = by_name(found)[SURFACE_FRICTION]
    assert item.low <= 0.42 <= item.high
