"""Errors of evaluation that a user can act on."""

from collections.abc import Mapping, Sequence

from bridge.errors import GstError
from bridge.errors import UndefinedStatisticError as UndefinedStatisticError


class EvaluatorError(GstError):
    """The data does not support what was asked of it."""


class AlikeNamesError(EvaluatorError):
    """Two names differ only in what the ids of measurements do not keep, or by case."""

    def __init__(
        self, *, kind: str, names: tuple[str, str], places: tuple[str, str], hint: str = ""
    ) -> None:
        """Remember both names and where they stand."""
        self.kind = kind
        self.names = names
        self.places = places
        why = "cannot be told apart in the ids of results. Spell them alike if they are one, else "
        why += "further apart."
        super().__init__(
            f"{kind} {names[0]!r} ({places[0]}) and {names[1]!r} ({places[1]}) {hint or why}"
        )

    @classmethod
    def of(cls, kind: str, alike: Sequence[Mapping[str, str]]) -> "AlikeNamesError":
        """Build the question about names that differ only by case or blanks."""
        (first, place), (second, other), *_ = alike[0].items()
        further = [" and ".join(map(repr, names)) for names in alike[1:]]
        listed = f" So do {'; '.join(further)}." if further else ""
        hint = f"differ only by case or blanks.{listed} --names merge counts them as one, "
        hint += "--names apart as several."
        return cls(kind=kind, names=(first, second), places=(place, other), hint=hint)
