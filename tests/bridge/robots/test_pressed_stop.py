"""An arm stops by itself where it is pressed for longer than a knock."""

import numpy as np
import pytest

from bridge.robots.stop import PressedStop


@pytest.mark.parametrize("period_ms", [4, 8, 20])
def test_an_arm_pressed_for_40_ms_stops_and_a_knock_is_passed_over(period_ms: int) -> None:
    stop = PressedStop(150.0)
    forces = np.repeat([151.0, 150.0, 200.0], [40 // period_ms - 1, 1, 40 // period_ms])
    found = [stop.found(force, period_ms * 1_000_000) for force in forces.tolist()]
    assert found[:-1] == [""] * (len(forces) - 1)
    assert found[-1] == "the arm is pressed with 200 N, the limit is 150 N"


def test_a_force_that_is_no_number_counts_and_without_a_limit_nothing_does() -> None:
    assert PressedStop(150.0).found(float("nan"), 40_000_000)
    assert PressedStop(None).found(1e9, 1_000_000_000) == ""
