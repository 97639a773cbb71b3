"""The time budget of a fit, by a clock that only drawing moves."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import textured_room

from twin.scene.fit.initialise import fuse
from twin.scene.fit.optimise import FitResult, fit
from twin.scene.frames.rgbd import DepthLimits, FrameSurface, TrainingView, training_view
from twin.scene.gaussians import GaussianCloud
from twin.scene.raster.rasteriser import FitSession, Rasteriser
from twin.scene.settings import FitConfig

LIMITS = DepthLimits(max_depth_m=5.0, flying_fraction=0.1)
BUDGET = FitConfig(budget_s=10.0, threads=1)
STEP_S = 0.2


class DrawingClock:
    """Stands still except while something is drawn."""

    def __init__(self) -> None:
        """Begin anywhere."""
        self.now_s = 1000.0
        self.draw_s = 0.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> DrawingClock:
    clock = DrawingClock()

    def slowed(method: Callable[..., Any], seconds: Callable[[], float]) -> Callable[..., Any]:
        def run(*given: Any, **named: Any) -> Any:
            clock.now_s += seconds()
            return method(*given, **named)

        return run

    monkeypatch.setattr(
        Rasteriser, "draw_planes", slowed(Rasteriser.draw_planes, lambda: clock.draw_s)
    )
    monkeypatch.setattr(FitSession, "step", slowed(FitSession.step, lambda: STEP_S))
    return clock


@pytest.fixture(scope="module")
def room() -> tuple[GaussianCloud, list[TrainingView]]:
    surfaces = [FrameSurface(textured_room.frame(i, 4), LIMITS) for i in range(4)]
    start = fuse([surface.points() for surface in surfaces], 100)
    return start, [training_view(surface) for surface in surfaces]


def fitted(
    room: tuple[GaussianCloud, list[TrainingView]], clock: DrawingClock, **named: Any
) -> FitResult:
    start, views = room
    config = named.pop("config", BUDGET)
    return fit(start, views * 20, config, lambda *_: None, clock=clock, **named)


@pytest.mark.parametrize("draw_s", [0.0, 0.005, 0.02, 0.3, 3.0])
def test_a_budget_is_exceeded_by_one_image_however_long_all_images_take(
    room: tuple[GaussianCloud, list[TrainingView]], clock: DrawingClock, draw_s: float
) -> None:
    clock.draw_s = draw_s
    found = fitted(room, clock)
    assert BUDGET.budget_s <= found.seconds <= BUDGET.budget_s + STEP_S + draw_s + 1e-6
    assert clock.now_s - 1000.0 == pytest.approx(found.seconds)


def test_an_unfinished_look_at_the_images_drops_no_gaussian_as_unseen(
    room: tuple[GaussianCloud, list[TrainingView]], clock: DrawingClock
) -> None:
    clock.draw_s = 0.5  # a single image of the eighty fits into the share for a split
    found = fitted(room, clock)
    assert len(found.cloud) >= 0.9 * len(room[0])


def test_initialisation_counts_but_always_leaves_half(
    room: tuple[GaussianCloud, list[TrainingView]], clock: DrawingClock
) -> None:
    whole, less, least = (fitted(room, clock, spent_s=spent) for spent in (0.0, 3.0, 1e6))
    assert less.iterations == pytest.approx(0.7 * whole.iterations, abs=1)
    assert least.iterations == pytest.approx(0.5 * whole.iterations, abs=1)
    assert less.seconds == pytest.approx(whole.seconds, abs=STEP_S)


def test_a_limit_that_does_not_strike_changes_nothing_and_one_that_does_is_reported(
    room: tuple[GaussianCloud, list[TrainingView]], clock: DrawingClock
) -> None:
    counted = replace(BUDGET, iterations=20, budget_s=None)
    free, roomy, cut = (
        fitted(room, clock, config=replace(counted, budget_s=limit_s))
        for limit_s in (None, 1000.0, 7.5 * STEP_S)
    )
    assert (free.iterations, roomy.iterations, cut.iterations) == (20, 20, 8)
    assert [found.underfitted for found in (free, roomy, cut)] == [False, False, True]
    np.testing.assert_array_equal(free.cloud.means_m, roomy.cloud.means_m)
    np.testing.assert_array_equal(free.cloud.colors, roomy.cloud.colors)
