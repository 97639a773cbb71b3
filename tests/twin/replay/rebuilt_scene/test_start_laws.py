"""Which quiet phase a plan started from."""

import numpy as np
import pytest

from bridge.task.task_file import load_task
from twin.replay.scene import StartState, StartStates
from twin.scene.localise.episode import Phase

PHASES = [
    Phase(name="start", plan_id=None, after_ns=None, before_ns=100),
    Phase(name="end", plan_id="a", after_ns=200, before_ns=300),
    Phase(name="end", plan_id="b", after_ns=400, before_ns=None),
]


def state(x_m: float) -> StartState:
    T = np.eye(4)
    T[0, 3] = x_m
    return StartState(Ts_base_object={"cube": T})


STARTS = StartStates(load_task("cube_into_box"), PHASES, [state(x) for x in (1.0, 2.0, 3.0)])


@pytest.mark.parametrize(
    ("stamp_ns", "x_m"), [(0, 1.0), (50, 1.0), (250, 2.0), (300, 2.0), (401, 3.0), (10**12, 3.0)]
)
def test_a_plan_starts_from_the_last_quiet_phase_that_had_begun(stamp_ns: int, x_m: float) -> None:
    assert STARTS.at(stamp_ns).Ts_base_object["cube"][0, 3] == x_m


@pytest.mark.parametrize("stamp_ns", [150, 350])
def test_a_plan_made_during_another_ones_execution_starts_from_nothing(stamp_ns: int) -> None:
    found = STARTS.at(stamp_ns)
    assert found.Ts_base_object == {}
    assert "another one was being executed" in found.reasons["cube"]


def test_what_an_execution_left_behind_is_the_phase_after_it() -> None:
    assert STARTS.after("a").Ts_base_object["cube"][0, 3] == 2.0
    assert STARTS.after("b").Ts_base_object["cube"][0, 3] == 3.0
    assert STARTS.after("c").Ts_base_object == {}
