"""Friction of pairs by the incline test: how MuJoCo combines coefficients."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from standin_incline import mujoco_friction

PAIRS = [(0.8, 0.8), (0.9, 0.5), (0.5, 0.9)]


@pytest.mark.parametrize(("first", "second"), PAIRS)
def test_mujoco_takes_the_larger_one(first: float, second: float) -> None:
    assert mujoco_friction(first, second) == pytest.approx(max(first, second), rel=0.03)


@pytest.mark.parametrize("pad", [False, True])
def test_in_the_cell_the_pads_and_then_the_objects_decide_alone(pad: bool) -> None:
    assert mujoco_friction(0.5, 1.0, slab_priority=1, pad=pad) == pytest.approx(0.5, rel=0.03)
