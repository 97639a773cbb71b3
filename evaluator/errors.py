"""Errors of evaluation that a user can act on."""

from bridge.errors import GstError
from bridge.errors import UndefinedStatisticError as UndefinedStatisticError


class EvaluatorError(GstError):
    """The data does not support what was asked of it."""


class AlikeNamesError(EvaluatorError):
    """Two names differ only in what the ids of measurements do not keep, or by case."""

    def __init__(self, *, kind: str, names: tuple[str, str], places: tuple[str, str]) -> None:
        """Remember both names and where they stand."""
        self.kind, self.names, self.places = kind, names, places
        super().__init__(
            f"{kind} {names[0]!r} ({places[0]}) and {names[1]!r} ({places[1]}) cannot be told "
            "apart in the ids of results. Spell them alike if they are one, else further apart."
        )
