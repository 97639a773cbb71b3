"""What an instruction asks for, whether it can be, and in which order it is done."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from bridge.task.check import REFERENCES, TABLE
from bridge.task.summary import describe_predicate
from twin.plan.ground.nouns import Choice
from twin.plan.ground.vocabulary import Vocabulary, refuse

PLACES = {"inside": "container", "on": "support"}
"""Relations of which an object can have only one, with the key of what it is in or on."""


@dataclass(frozen=True, kw_only=True)
class Grounding:
    """An instruction that was understood."""

    text: str
    goals: tuple[Mapping[str, Any], ...]
    """Success predicates of a task file, in the order they were said."""
    order: tuple[str, ...]
    is_order_given: bool
    """The instruction asks for that order, or its relations do; else another one is as good."""
    choices: tuple[Choice, ...] = ()
    explanation: tuple[str, ...] = ()

    def lines(self) -> list[str]:
        """The goals, the order and what they were made of, in words."""
        order = ", then ".join(self.order)
        told = "" if self.is_order_given or len(self.order) < 2 else " (any order will do)"
        return [
            "goals, when at the end",
            *(f"  {describe_predicate(goal)}" for goal in self.goals),
            f"moved: {order}{told}",
            "understood",
            *(f"  {line}" for line in self.explanation),
        ]


@dataclass
class Goals:
    """Collects goals clause by clause, and refuses what cannot be."""

    vocabulary: Vocabulary
    found: list[dict[str, Any]] = field(default_factory=list)
    steps: list[tuple[str, ...]] = field(default_factory=list)
    """Objects of each clause."""
    edges: list[tuple[int, int]] = field(default_factory=list)
    """Clauses that come before others."""
    is_order_given: bool = False

    def add_clause(self, goals: Sequence[dict[str, Any]]) -> None:
        """Take the goals of one clause."""
        for goal in goals:
            self._refuse(goal)
            if goal not in self.found:
                self.found.append(goal)
        self.steps.append(tuple(dict.fromkeys(goal["object"] for goal in goals)))

    def _refuse(self, goal: Mapping[str, Any]) -> None:
        things, object_id = self.vocabulary.things, goal["object"]
        told = self.vocabulary.describe([object_id])
        others = [goal[key] for key in REFERENCES[1:] if key in goal]
        if object_id in others or len(set(others)) < len(others):
            refuse("impossible", f"{told} cannot stand in a relation to itself.", [object_id])
        container = goal.get("container")
        if container is not None and not things[container].container:
            open_ones = self.vocabulary.containers()
            message = (
                f"{self.vocabulary.describe([container])} has no inside: nothing can be put in it "
                "or taken out of it."
            )
            refuse("impossible", message, open_ones or [container])
        support = goal.get("support", TABLE)
        if support != TABLE and things[support].container:
            message = (
                f"{self.vocabulary.describe([support])} is open above; what is put there is "
                "inside it, not on it. Say 'into'."
            )
            refuse("impossible", message, [support])
        self.refuse_fixed([object_id])

    def refuse_fixed(self, ids: Iterable[str]) -> None:
        """Refuse to move what cannot be."""
        for key in ids:
            if not self.vocabulary.things[key].movable:
                movable = ", ".join(self.vocabulary.movable()) or "nothing here"
                told = f"{self.vocabulary.describe([key])} is fixed: nothing can move it."
                refuse("fixed_object", f"{told} What can be moved: {movable}.", [key])

    def checked(self) -> list[dict[str, Any]]:
        """All goals, none of which rules out another."""
        by_object: dict[str, list[dict[str, Any]]] = {}
        for goal in self.found:
            by_object.setdefault(goal["object"], []).append(goal)
        for key, goals in by_object.items():
            self._refuse_contradiction(key, goals)
        return self.found

    def grounding(
        self, text: str, explanation: Iterable[str], choices: Iterable[Choice] = ()
    ) -> Grounding:
        """What an instruction asks for whose clauses were all taken."""
        found = self.checked()
        if not found:
            refuse("empty", "the instruction asks for nothing.")
        return Grounding(
            text=text,
            goals=tuple(found),
            order=ordered(self, found),
            is_order_given=self.is_order_given,
            choices=tuple(choices),
            explanation=tuple(dict.fromkeys(explanation)),
        )

    def _refuse_contradiction(self, key: str, goals: Sequence[Mapping[str, Any]]) -> None:
        kinds = {goal["kind"] for goal in goals}
        places = {(g["kind"], g[PLACES[g["kind"]]]) for g in goals if g["kind"] in PLACES}
        held_by = {name for _, name in places}
        outside = {goal["container"] for goal in goals if goal["kind"] == "outside"}
        sides: dict[str, set[str]] = {}
        for goal in goals:
            if goal["kind"] == "beside":
                sides.setdefault(goal["reference"], set()).add(str(goal.get("direction", "")))
        if (
            len(places) > 1
            or held_by & outside
            or ("moved" in kinds and places - {("on", TABLE)})
            or held_by & set(sides)
            or any(len(found - {""}) > 1 for found in sides.values())
            or sum(goal["kind"] == "moved" for goal in goals) > 1
        ):
            told = "; ".join(describe_predicate(goal) for goal in goals)
            message = f"{key} cannot end as asked, all at once: {told}. Leave one of them out."
            refuse("contradiction", message, [key])


def ordered(goals: Goals, found: Iterable[Mapping[str, Any]]) -> tuple[str, ...]:
    """Put the objects into the order in which they are moved.

    What something is put on or beside is moved first; then what the instruction says; then the
    order in which the objects were named.
    """
    names = list(dict.fromkeys(key for step in goals.steps for key in step))
    before: dict[str, set[str]] = {key: set() for key in names}
    for goal in found:
        for other in (goal[key] for key in REFERENCES[1:] if key in goal):
            if other in before:
                before[goal["object"]].add(other)
    relations = {key: set(values) for key, values in before.items()}
    if circle := _sorted(names, relations)[1]:
        message = (
            f"{', '.join(circle)} each wait for another to be in place first. Let one of them stay "
            "where it is."
        )
        refuse("cyclic", message, circle)
    for first, second in goals.edges:
        for later in goals.steps[second]:
            before[later] |= set(goals.steps[first]) - {later}
    order, circle = _sorted(names, before)
    if circle:
        message = (
            f"the order asked for cannot be: one of {', '.join(circle)} would be moved after "
            "something was put on it or beside it. Say it the other way round."
        )
        refuse("contradiction", message, circle)
    return tuple(order)


def _sorted(names: Sequence[str], before: Mapping[str, set[str]]) -> tuple[list[str], list[str]]:
    """An order, and those that wait for each other, for which there is none."""
    left, order = list(names), []
    while ready := next((key for key in left if not before[key] & set(left)), None):
        order.append(ready)
        left.remove(ready)
    return order, left
