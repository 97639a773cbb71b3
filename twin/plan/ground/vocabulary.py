"""What an instruction can be about: the things of a scene, and what they are called."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NoReturn

import numpy as np

from bridge.task.task_file import BASKET, Task
from twin.errors import TwinError
from twin.naming.colours import colour_name
from twin.naming.words import KIND_NAMES, colour_of, kind_of, label_of, spoken_name, words_of
from twin.plan.constrain.schema import printable

AT_FAULT = ("contradiction", "cyclic", "fixed_object")
"""Kinds whose candidates are at fault, and named by the message: there is nothing to choose."""
UNREAD = ("empty", "unknown_clause", "unknown_object", "unsupported_relation", "unsupported_verb")
"""Kinds that are answered with examples of what is understood."""
ALIKE = 1.15
"""A box whose sides differ by less is a cube."""
MOST_TOLD = 400
"""Characters of a message with words of the instruction in it."""
Ids = tuple[str, ...]
ANY_THING = ("object", "thing", "item")
ALSO_CALLED = {"cube": ("block", "brick"), "block": ("cube", "brick"), "brick": ("block", "cube")}
"""Other nouns for the same, where nothing in the scene has that noun as its own. A bin is no mug:
whatever is not here is an unknown object."""


class GroundingError(TwinError):
    """An instruction that cannot be planned: what kind of trouble, and what there is instead."""

    exit_code = 2

    def __init__(self, kind: str, message: str, *, candidates: Iterable[str] = ()) -> None:
        """Remember the kind, one of ``KINDS``, and ids of what could be meant, or is at fault."""
        self.kind, self.candidates, self.examples = kind, tuple(candidates), tuple[str, ...]()
        choices = () if kind in AT_FAULT else self.candidates
        listed = f" There is: {', '.join(choices)}." if choices else ""
        super().__init__(f"{printable(message)[:MOST_TOLD]}{listed}")

    def __str__(self) -> str:
        """With what would be understood, where that helps."""
        told = ", ".join(f"'{text}'" for text in self.examples if self.kind in UNREAD)
        return super().__str__() + (f" Understood is, for example: {told}." if told else "")


def refuse(kind: str, message: str, candidates: Iterable[str] = ()) -> NoReturn:
    """Raise what is wrong with an instruction."""
    raise GroundingError(kind, message, candidates=candidates)


@dataclass(frozen=True, kw_only=True)
class Thing:
    """One object as an instruction may call it."""

    id: str
    label: str
    colour: str
    """One of the names of ``twin.naming.colours``, or empty."""
    movable: bool
    container: bool
    size_m: tuple[float, float, float] | None = None
    """Outer extents, where known: small and large compare them."""
    shape: str = ""
    """``cube`` where it is one, whatever it is called."""

    @cached_property
    def names(self) -> tuple[frozenset[str], frozenset[str], frozenset[str]]:
        """Its own; with that of its shape; with all that it may be called besides."""
        words = words_of(spoken_name(self.id)) + words_of(self.label)
        own = frozenset(word for word in words if colour_of(word) is None)
        other = {name for word in own for name in ALSO_CALLED.get(word, ())}
        other |= {*ANY_THING, *KIND_NAMES[kind_of(self.label)], *["container"] * self.container}
        shaped = own | ({self.shape} - {""})
        return own, shaped, shaped | other

    @property
    def called(self) -> str:
        """Its label with its colour."""
        is_named = not self.colour or self.colour in self.label
        return self.label if is_named else f"{self.colour} {self.label}"

    def describe(self) -> str:
        """Its id and what it is."""
        return f"{self.id} ({self.called})"


@dataclass(frozen=True, kw_only=True)
class Vocabulary:
    """Everything an instruction can name."""

    things: Mapping[str, Thing]

    def movable(self) -> Ids:
        """Ids of what the robot can move."""
        return tuple(key for key, thing in self.things.items() if thing.movable)

    def containers(self) -> Ids:
        """Ids of what things can be put into."""
        return tuple(key for key, thing in self.things.items() if thing.container)

    def examples(self) -> list[str]:
        """Three instructions about what is here."""
        if not self.movable():
            return []
        names = [each.called for each in self.things.values()]
        the = {
            key: f"the {key if names.count(each.called) > 1 else each.called}"
            for key, each in self.things.items()
        }
        first, *others = (the[key] for key in self.movable())
        boxes = [the[key] for key in self.containers()]
        found = [f"put {first} into {box}" for box in boxes[:1]]
        found += [f"stack {first} on {other}" for other in others[:1]]
        found += [f"put {first} left of {other}" for other in (others + boxes)[:1]]
        return [*found, f"move {first} 10 cm to the left", f"push {first} forwards by 5 cm"][:3]

    def describe(self, ids: Sequence[str]) -> str:
        """Name things with what they are."""
        return ", ".join(self.things[key].describe() if key in self.things else key for key in ids)


def vocabulary_of(task: Task, instances: Sequence[Mapping[str, Any]] = ()) -> Vocabulary:
    """Make a vocabulary of a task's objects, called as the rebuilt scene calls its instances.

    An object that is not among them keeps its name and the colour of the task file.
    """
    seen = {str(item["object"]): item for item in instances if item.get("object")}
    things = {}
    for key, model in task.objects.items():
        is_container = model.shape == "open_box" or model.mesh == BASKET
        colour = colour_name(np.array(model.color_srgb) / 255)
        shape = ""
        if model.shape == "box" and model.size_m is not None:
            shape = "cube" if max(model.size_m) < ALIKE * min(model.size_m) else "box"
        by_task = label_of(key, colour, is_open=is_container, shape=shape)
        label = str(seen.get(key, {}).get("label") or by_task)
        spoken = next(filter(None, map(colour_of, words_of(label))), None)
        things[key] = Thing(
            id=key,
            label=label,
            colour=spoken or colour,  # what it is called, whatever its colour looks like
            movable=not model.fixed,
            container=is_container,
            size_m=model.size_m,
            shape=shape if shape == "cube" else "",
        )
    return Vocabulary(things=things)
