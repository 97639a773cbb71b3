"""Names of tasks, conditions and policies that are spelled in several ways."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any, TypeVar

from evaluator.errors import AlikeNamesError

Named = TypeVar("Named", bound=Any)
KINDS = ("task", "condition", "policy")


def settle_names(items: Iterable[Named], choice: str) -> tuple[list[Named], list[str]]:
    """Settle names that differ only by case or blanks: ask, merge, or leave them apart.

    Args:
        choice: ``ask`` refuses them, ``merge`` takes the spelling that came first, ``apart``
            leaves them.

    Returns:
        The items, and what was merged in words.

    Raises:
        AlikeNamesError: When there are such names and nobody said what they are.
    """
    found = list(items)
    if choice == "apart":
        return found, []
    merged = []
    for kind in KINDS:
        spellings: dict[str, dict[str, str]] = {}
        for number, item in enumerate(found, start=1):
            name = getattr(item, kind)
            where = getattr(item, "episode", "") or f"row {getattr(item, 'row', number)}"
            spellings.setdefault(_folded(name), {}).setdefault(name, where)
        alike = {key: names for key, names in spellings.items() if len(names) > 1}
        if alike and choice == "ask":
            raise AlikeNamesError.of(kind, [*alike.values()])
        for names in alike.values():
            first, *others = names
            merged.append(f"{kind} {', '.join(map(repr, others))} counted as {first!r}")
        first_of = {name: next(iter(names)) for names in alike.values() for name in names}
        if first_of:
            found = [
                replace(item, **{kind: first_of[name]})
                if (name := getattr(item, kind)) in first_of
                else item
                for item in found
            ]
    return found, merged


def _folded(name: str) -> str:
    return " ".join(name.casefold().split())
