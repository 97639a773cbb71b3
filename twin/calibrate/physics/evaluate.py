"""Live many cases through at many points, in one process or several; the order changes nothing."""

from collections.abc import Mapping, Sequence
from types import TracebackType

import numpy as np
from jaxtyping import Float

from twin.calibrate.physics.case import Case, Prediction
from twin.calibrate.physics.drive import predict
from twin.calibrate.physics.parameters import PhysicsParameter, values_of
from twin.crew.pool import Crew
from twin.crew.worker import Failed
from twin.errors import TwinError
from twin.physics.config import PhysicsConfig

Piece = tuple[int, Case, Mapping[str, float], PhysicsConfig, int]
"""Its number, and what ``predict`` takes."""


class LostPieceError(TwinError):
    """A case could not be lived through, although it was tried again."""


class Evaluator:
    """Predictions of cases at points in units of the prior. A context manager: it owns a crew."""

    def __init__(
        self,
        cases: Sequence[Case],
        parameters: Sequence[PhysicsParameter],
        config: PhysicsConfig,
        *,
        num_samples: int,
        workers: int = 1,
    ) -> None:
        """Have processes ready, where there is more than one.

        Args:
            cases: Everything that will be asked for.
            parameters: What the numbers of a point mean.
            config: Everything that is not a parameter.
            num_samples: Noisy starts of each judged trial.
            workers: Processes.
        """
        self.cases = list(cases)
        self._parameters = list(parameters)
        self._config = config
        self.num_samples = num_samples
        self._crew = Crew(workers) if workers > 1 else None

    def predict(
        self, points: Float[np.ndarray, "num_points num_parameters"], chosen: Sequence[int]
    ) -> list[list[Prediction]]:
        """Predict the chosen cases, by their numbers, at every point.

        Raises:
            LostPieceError: When a case was begun again and its process died again.
        """
        pairs = [(x, index) for x in points for index in chosen]
        pieces = [self._piece(number, *pair) for number, pair in enumerate(pairs)]
        if self._crew is None:
            flat = [_predict(piece) for piece in pieces]
        else:
            flat = _side_by_side(self._crew, pieces)
        size = len(chosen)
        return [flat[k * size : (k + 1) * size] for k in range(len(points))]

    def _piece(self, number: int, x: Float[np.ndarray, " num_parameters"], index: int) -> Piece:
        values = values_of(self._parameters, x)
        return number, self.cases[index], values, self._config, self.num_samples

    def __enter__(self) -> "Evaluator":
        """Use as a context manager."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """End the processes; what is being done is lost."""
        if self._crew is not None:
            self._crew.__exit__()


def _side_by_side(crew: Crew, pieces: Sequence[Piece]) -> list[Prediction]:
    """Predict, and put the answers back into order."""
    answers: dict[int, Prediction] = {}
    for (number, case, *_), answer in crew.run(_predict, pieces, _cost):
        if isinstance(answer, Failed):
            raise _error_of(case, answer)
        answers[number] = answer
    return [answers[number] for number in range(len(pieces))]


def _error_of(case: Case, failed: Failed) -> Exception:
    """What to raise, as one process alone would have done; a bug keeps its trace."""
    if not failed.known:
        return RuntimeError(failed.trace)
    return LostPieceError(
        f"{case.episode} could not be simulated: {failed.message}. Nothing was written. Try again, "
        "with fewer --workers."
    )


def _cost(piece: Piece) -> float:
    """Count the living-throughs."""
    _, case, _, _, num_samples = piece
    return 1.0 if case.success is None else 1.0 + num_samples


def _predict(piece: Piece) -> Prediction:
    _, case, values, config, num_samples = piece
    return predict(case, values, config, num_samples)
