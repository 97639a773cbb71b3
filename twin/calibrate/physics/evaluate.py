"""Live many cases through at many points, in one process or several; the order changes nothing."""

import multiprocessing
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from types import TracebackType

import numpy as np
from jaxtyping import Float

from twin.calibrate.physics.case import Case, Prediction
from twin.calibrate.physics.drive import predict
from twin.calibrate.physics.parameters import PhysicsParameter, values_of
from twin.errors import TwinError
from twin.physics.config import PhysicsConfig

_State = tuple[Sequence[Case], Sequence[PhysicsParameter], PhysicsConfig, int]
_state: list[_State] = []
"""What this process of the pool works on; set once, because cases are large."""


class LostProcessError(TwinError):
    """A process of the pool is gone, and with it what it was doing."""


class Evaluator:
    """Predictions of cases at points in units of the prior. A context manager: it owns a pool."""

    def __init__(
        self,
        cases: Sequence[Case],
        parameters: Sequence[PhysicsParameter],
        config: PhysicsConfig,
        *,
        num_samples: int,
        workers: int = 1,
    ) -> None:
        """Start the processes, where there is more than one.

        Args:
            cases: Everything that will be asked for.
            parameters: What the numbers of a point mean.
            config: Everything that is not a parameter.
            num_samples: Noisy starts of each judged trial.
            workers: Processes.
        """
        self.cases = list(cases)
        self._args: _State = (self.cases, list(parameters), config, num_samples)
        self.num_samples = num_samples
        self._pool: ProcessPoolExecutor | None = None
        if workers > 1:
            # spawn: PyBullet and pinocchio hold memory that must not be forked.
            self._pool = ProcessPoolExecutor(
                max_workers=workers,
                mp_context=multiprocessing.get_context("spawn"),
                initializer=_begin,
                initargs=(self._args,),
            )

    def predict(
        self, points: Float[np.ndarray, "num_points num_parameters"], chosen: Sequence[int]
    ) -> list[list[Prediction]]:
        """Predict the chosen cases, by their numbers, at every point.

        Raises:
            LostProcessError: When a process was killed.
        """
        jobs = [(index, points[k]) for k in range(len(points)) for index in chosen]
        if self._pool is None:
            flat = [_predict(self._args, index, x) for index, x in jobs]
        else:
            flat = _mapped(self._pool, jobs)
        size = len(chosen)
        return [flat[k * size : (k + 1) * size] for k in range(len(points))]

    def __enter__(self) -> "Evaluator":
        """Use as a context manager."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """End the processes; what waits is not begun."""
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)


def _mapped(
    pool: ProcessPoolExecutor, jobs: Sequence[tuple[int, Float[np.ndarray, " num_parameters"]]]
) -> list[Prediction]:
    if not jobs:
        return []
    try:
        return list(pool.map(_work, *zip(*jobs, strict=True)))
    except BrokenProcessPool as error:
        raise LostProcessError(
            "a process that simulated was ended from outside, perhaps by a machine short of "
            "memory, and nothing was written. Try again, with fewer --workers."
        ) from error


def _begin(state: _State) -> None:
    _state[:] = [state]


def _work(index: int, x: Float[np.ndarray, " num_parameters"]) -> Prediction:
    return _predict(_state[0], index, x)


def _predict(state: _State, index: int, x: Float[np.ndarray, " num_parameters"]) -> Prediction:
    cases, parameters, config, num_samples = state
    return predict(cases[index], values_of(parameters, x), config, num_samples)
