"""What happens between the steps of a fit, each at its share of the budget and within its time.

Gains and colours are solved in closed form (``appearance``), Gaussians are split where the error is
large (``densify``). Each of these looks at many images at once, so with many images it could take
longer than the fit itself: none may take more than its share of the budget.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from twin.scene.fit.allowance import Allowance
from twin.scene.fit.appearance import Observation, solve_appearance, solve_gains
from twin.scene.fit.densify import densify, score
from twin.scene.fit.state import FitState
from twin.scene.frames.training_view import TrainingView
from twin.scene.raster.rasteriser import Rasteriser
from twin.scene.settings import FitConfig

SOLVE_AT = (0.9,)
"""Shares of the budget at which colours are solved. Not at the start: a sharp solution for blurred
Gaussians leads Adam astray (0.4 dB of 34 on the clean tabletop); near the end it adds 0.2 dB."""
GAINS_AT = (0.1, 0.3, 0.6)
"""Shares of the budget at which gains are solved, besides with the colours."""
SPLIT_AT = (0.1, 0.2, 0.3)
"""Shares of the budget at which Gaussians are split and dropped."""
SOLVE_SHARE, GAINS_SHARE, SPLIT_SHARE = 0.08, 0.02, 0.04
"""At most this much of the budget for each of them."""


@dataclass(frozen=True, kw_only=True)
class Progress:
    """How far along the fit is, 0..1 by time or by images."""

    fraction: float
    seconds: float
    clock: Callable[[], float]
    """What the budget is counted in."""
    end_s: float
    """When the budget is used up, on that clock; infinite when images are counted."""

    def allowance(self, share: float) -> Allowance:
        """Time for a stage that may take this share of the budget, and no more than is left."""
        if math.isinf(self.end_s):
            return Allowance(clock=self.clock)
        now_s = self.clock()
        budget_s = self.seconds / self.fraction if self.fraction > 0 else self.end_s - now_s
        return Allowance(clock=self.clock, until_s=min(now_s + share * budget_s, self.end_s))


@dataclass(frozen=True, kw_only=True)
class Event:
    """One entry of the schedule."""

    at: float
    share: float
    act: Callable[[FitState, bool, Allowance], None]


class Events:
    """The schedule of a fit, and what it says to do."""

    def __init__(
        self,
        views: list[TrainingView],
        config: FitConfig,
        max_splats: int,
        rasteriser: Rasteriser,
    ) -> None:
        """Plan; nothing is done yet."""
        self._views = views
        self._config = config
        self._max_splats = max_splats
        self._rasteriser = rasteriser

    @cached_property
    def _schedule(self) -> list[Event]:
        config, events = self._config, []
        if config.densify:
            events += [Event(at=at, share=SPLIT_SHARE, act=self._densify) for at in SPLIT_AT]
        if config.gain:
            events += [Event(at=at, share=GAINS_SHARE, act=self._solve_gains) for at in GAINS_AT]
        if config.appearance_steps:
            events += [Event(at=at, share=SOLVE_SHARE, act=self._solve_colours) for at in SOLVE_AT]
        return sorted(events, key=lambda event: event.at)

    def keep(self, state: FitState, at: Progress) -> None:
        """Do what is due; what is already behind is not done again."""
        coarse = at.fraction < self._config.coarse_fraction
        while (
            state.events_done < len(self._schedule)
            and self._schedule[state.events_done].at <= at.fraction
        ):
            due = self._schedule[state.events_done]
            due.act(state, coarse, at.allowance(due.share))
            state.events_done += 1

    def _observations(self, state: FitState, coarse: bool) -> list[Observation]:
        return [
            Observation(
                target=view.half if coarse else view.full,
                T_base_camera=state.cameras.pose(index, view.T_base_color),
                gain=state.gains[index],
            )
            for index, view in enumerate(self._views)
        ]

    def _solve_gains(self, state: FitState, coarse: bool, allowance: Allowance) -> None:
        observations = self._observations(state, coarse)
        state.gains = solve_gains(state.session.cloud, observations, self._rasteriser, allowance)

    def _solve_colours(self, state: FitState, coarse: bool, allowance: Allowance) -> None:
        if self._config.gain:
            self._solve_gains(state, coarse, allowance)
        solved = solve_appearance(
            state.session.cloud,
            self._observations(state, coarse),
            self._rasteriser,
            steps=self._config.appearance_steps,
            allowance=allowance,
        )
        state.colour_steps += solved.steps
        state.session.cloud.colors[:] = solved.cloud.colors
        state.session.cloud.harmonics[:] = solved.cloud.harmonics

    def _densify(self, state: FitState, coarse: bool, allowance: Allowance) -> None:
        cloud = state.session.cloud
        scores = score(cloud, self._observations(state, coarse), self._rasteriser, allowance)
        left = sum(event.act == self._densify for event in self._schedule[state.events_done :])
        room = max(self._max_splats - len(cloud), 0)
        done = densify(cloud, scores, max_splats=self._max_splats, most=-(-room // left))
        state.session.rearrange(done.cloud, done.parents)
        state.surface = state.surface.take(done.parents)
        state.num_split += done.num_split
        state.num_pruned += done.num_pruned


def order_of_views(seed: int, epoch: int, num_views: int) -> np.ndarray:
    """The order in which one pass shows the views; the same whenever it is asked for."""
    return np.random.default_rng([seed, epoch]).permutation(num_views)
