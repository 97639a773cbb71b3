"""Where objects lay at the starts with a robot trial, and at those only the twin has."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float64

from evaluator.compare.measure import measured
from evaluator.compare.rows import TrialRow
from evaluator.compare.success import names_of
from evaluator.errors import UndefinedStatisticError
from evaluator.result import Measurement
from evaluator.statistics.overlap import starts_alike, starts_covered

NOWHERE = (
    "not computed: no object was localised before the execution in most of these trials; record "
    "or make localisations at the start"
)


@dataclass(frozen=True, kw_only=True)
class StartPlaces:
    """Coordinates of the same objects, in one order, at every start that can be compared."""

    objects: tuple[str, ...]
    tried: Float64[np.ndarray, "num_tried num_coordinates"]
    others: Float64[np.ndarray, "num_others num_coordinates"]
    num_left_out: int
    """Starts at which one of the objects was not localised."""

    @property
    def words(self) -> str:
        """What was compared, for a definition."""
        out = f", {self.num_left_out} starts without all of them left out"
        return (
            f"positions of {', '.join(self.objects)} as localised before the execution "
            f"({len(self.tried)} and {len(self.others)} starts{out if self.num_left_out else ''}); "
            "turns are not compared"
        )


def start_places(tried: Sequence[TrialRow], others: Sequence[TrialRow]) -> StartPlaces:
    """Gather where objects lay; those localised in most starts count.

    Raises:
        UndefinedStatisticError: When no object was localised in most of them.
    """
    rows = [*tried, *others]
    seen = Counter(name for row in rows for name in row.start_positions_m)
    objects = tuple(sorted(name for name, count in seen.items() if 2 * count > len(rows)))
    if not objects:
        raise UndefinedStatisticError(statistic="overlap of starts", reason=NOWHERE)
    sides = [_coordinates(side, objects) for side in (tried, others)]
    return StartPlaces(
        objects=objects,
        tried=sides[0],
        others=sides[1],
        num_left_out=len(rows) - len(sides[0]) - len(sides[1]),
    )


def _coordinates(rows: Sequence[TrialRow], objects: Sequence[str]) -> np.ndarray:
    known = [row.start_positions_m for row in rows if set(objects) <= row.start_positions_m.keys()]
    found = [[c for name in objects for c in places[name]] for places in known]
    return np.array(found, dtype=np.float64).reshape(len(found), 3 * len(objects))


class StartOverlap:
    """Whether the twin's other starts lie where those with a robot trial do."""

    def __init__(self, tried: Sequence[TrialRow], others: Sequence[TrialRow]) -> None:
        """Take the trials of one cell; nothing is computed before somebody asks."""
        self._tried = tried
        self._others = others

    @cached_property
    def _places(self) -> StartPlaces:
        return start_places(self._tried, self._others)

    @cached_property
    def _p_alike(self) -> float:
        return starts_alike(self._places.tried, self._places.others)

    def p_alike(self) -> float:
        """Return the p-value that both were drawn alike.

        Raises:
            UndefinedStatisticError: When too few starts were localised.
        """
        return self._p_alike

    def _covered(self) -> float:
        covered, total = starts_covered(self._places.tried, self._places.others)
        return covered / total

    def measurements(self, id_of: Callable[[str], str]) -> list[Measurement]:
        """Measure the overlap, or say why it is not computed.

        Args:
            id_of: Makes the id of a measurement from its name.
        """
        try:
            compared, num_others = f"; {self._places.words}", len(self._places.others)
        except UndefinedStatisticError:  # each measurement gives the reason
            compared, num_others = "", 0
        return [
            measured(
                id_of(name),
                compute,
                unit="1",
                definition=f"{words}{compared}",
                n=num_others,
                counted="start",
                reason_without_interval=why,
                episodes=names_of([*self._tried, *self._others]),
            )
            for name, compute, words, why in (
                (
                    "starts_alike_p",
                    self.p_alike,
                    "p of the permutation test on the energy distance that the starts with a robot "
                    "trial and those only the twin has were drawn alike: small forbids the "
                    "estimates",
                    "a p-value",
                ),
                (
                    "starts_covered",
                    self._covered,
                    "share of the starts only the twin has that lie no further from a tried start "
                    "than tried starts lie from their neighbours; alike, n tried ones cover about "
                    "n / (n + 1)",
                    "it describes these starts",
                ),
            )
        ]
