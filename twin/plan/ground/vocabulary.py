"""What an instruction can be about: the things of a scene, what they are called, the cameras."""

import difflib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.task.relations import SIDES, WAYS
from bridge.task.task_file import BASKET, ObjectModel, Task
from twin.errors import TwinError
from twin.scene.semantics.colour import COLOUR_NAMES, colour_name
from twin.scene.semantics.language import (
    ANY_THING,
    colour_of,
    kind_of,
    known_words,
    label_of,
    names_of,
    spoken_name,
    words_of,
)

KINDS = (
    "alternative",
    "ambiguous_object",
    "ambiguous_relation",
    "contradiction",
    "cyclic",
    "empty",
    "fixed_object",
    "impossible",
    "negated",
    "no_such_part",
    "too_few_objects",
    "too_long",
    "unknown_camera",
    "unknown_clause",
    "unknown_object",
    "unsupported_relation",
    "unsupported_verb",
)
"""Why an instruction is not planned."""
AT_FAULT = ("contradiction", "cyclic", "fixed_object")
"""Kinds whose candidates are at fault, and named by the message: there is nothing to choose."""
PARTS_OF_KIND = {
    "container": ("rim", "floor", "walls"),
    "animal": ("body", "head", "limbs"),
    "other": (),
}
"""Parts that a thing of a kind has where nobody has looked."""


class GroundingError(TwinError):
    """An instruction that cannot be planned: what kind of trouble, and what there is instead."""

    exit_code = 2

    def __init__(self, kind: str, message: str, *, candidates: Iterable[str] = ()) -> None:
        """Remember the kind, one of ``KINDS``, and ids of what could be meant, or is at fault."""
        self.kind = kind
        self.candidates = tuple(candidates)
        self.found = message
        choices = () if kind in AT_FAULT else self.candidates
        listed = f" There is: {', '.join(choices)}." if choices else ""
        super().__init__(f"{message}{listed}")


@dataclass(frozen=True, kw_only=True)
class Thing:
    """One object as an instruction may call it."""

    id: str
    label: str
    """What the segmenter, or the task, calls it."""
    colour: str
    """One of the names of ``twin.scene.semantics.colour``, or empty."""
    movable: bool
    container: bool
    soft: bool = False
    parts: tuple[str, ...] = ()
    """Empty: nobody has looked; then those of its kind."""
    size_m: tuple[float, float, float] | None = None
    """Outer extents, where known: small and large compare them."""
    own_names: frozenset[str] = field(init=False)
    """Words of its id and of its label."""
    names: frozenset[str] = field(init=False)
    """Whatever else the lexicon lets it be called."""

    def __post_init__(self) -> None:
        """Work out its names once."""
        words = set(words_of(spoken_name(self.id))) | set(words_of(self.label))
        nouns = {word for word in words if colour_of(word) is None or word in known_words()}
        object.__setattr__(self, "own_names", frozenset(nouns))
        names = set(names_of(self.label)) | nouns
        if self.container:
            names |= set(names_of("open container"))
        object.__setattr__(self, "names", frozenset(names))

    @property
    def known_parts(self) -> tuple[str, ...]:
        """Parts that can be spoken of."""
        kind = "container" if self.container else kind_of(self.label)
        return self.parts or PARTS_OF_KIND[kind]

    def describe(self) -> str:
        """Its id and what it is."""
        words = [self.colour] if self.colour and self.colour not in self.label else []
        return f"{self.id} ({' '.join([*words, self.label])})"


@dataclass(frozen=True, kw_only=True)
class Vocabulary:
    """Everything an instruction can name."""

    things: Mapping[str, Thing]
    cameras: Mapping[str, Float[np.ndarray, "4 4"]] = field(default_factory=dict)
    """``T_base_camera`` by id, where calibrated: directions may be as a camera sees them."""

    def as_seen(self, camera: str, direction: str) -> list[float]:
        """A named direction of a camera's view, along the table in the base frame.

        Args:
            camera: One of ``cameras``.
            direction: A side or a way, by its name.
        """
        R = self.cameras[camera][:3, :3]
        ahead = R[:, 2] if np.linalg.norm(R[:2, 2]) > 0.5 else -R[:, 1]  # looking down: image up
        right = np.array([ahead[1], -ahead[0], 0.0])
        if right @ R[:, 0] < 0:  # hung upside down
            right = -right
        forwards, left, _ = {**SIDES, **WAYS}[direction]
        way = forwards * np.array([ahead[0], ahead[1], 0.0]) - left * right
        return [round(float(part), 6) for part in way / np.linalg.norm(way)]

    def movable(self) -> tuple[str, ...]:
        """Ids of what the robot can move."""
        return tuple(key for key, thing in self.things.items() if thing.movable)

    def containers(self) -> tuple[str, ...]:
        """Ids of what things can be put into."""
        return tuple(key for key, thing in self.things.items() if thing.container)

    def nouns(self) -> set[str]:
        """Every noun that means something here or in the lexicon."""
        own = {name for thing in self.things.values() for name in thing.own_names}
        return known_words() | own | set(ANY_THING)

    def nearest(self, word: str) -> str:
        """A hint at the known word that was probably meant, or nothing."""
        known = sorted(self.nouns() | set(COLOUR_NAMES))
        found = difflib.get_close_matches(word, known, n=1, cutoff=0.75)
        return f" Did you mean {found[0]!r}?" if found else ""

    def describe(self, ids: Sequence[str]) -> str:
        """Name things with what they are."""
        return ", ".join(self.things[key].describe() if key in self.things else key for key in ids)


def vocabulary_from_labels(scene: Mapping[str, Mapping[str, str]]) -> Vocabulary:
    """Make a vocabulary of ids with ``label``, ``colour`` and ``role``.

    Args:
        scene: The role holds one or more of movable, fixed, soft, container. A label that ends in
            a container's name makes a container.
    """
    things = {}
    for key, about in scene.items():
        roles = {word.strip() for word in about.get("role", "").split(",")}
        label = about["label"]
        things[key] = Thing(
            id=key,
            label=label,
            colour=about.get("colour", ""),
            movable="movable" in roles and "fixed" not in roles,
            container="container" in roles or kind_of(label) == "container",
            soft="soft" in roles,
        )
    return Vocabulary(things=things)


def vocabulary_of(
    task: Task,
    instances: Sequence[Mapping[str, Any]] = (),
    cameras: Mapping[str, Float[np.ndarray, "4 4"]] | None = None,
) -> Vocabulary:
    """Make a vocabulary of a task's objects, called as the rebuilt scene calls them.

    Args:
        task: Says which objects there are, their colours, and what can be moved.
        instances: ``semantics.instances`` of ``scene.json``; an object that is not among them
            keeps its name and the colour of the task file.
        cameras: ``T_base_camera`` by id.
    """
    seen = {str(item["object"]): item for item in instances if item.get("object")}
    things = {}
    for key, model in task.objects.items():
        about = seen.get(key, {})
        is_container = model.shape == "open_box" or model.mesh == BASKET
        colour = colour_name(np.array(model.color_srgb) / 255)
        by_task = label_of(key, colour, is_open=is_container, shape=_shape_word(model))
        label = str(about.get("label") or by_task)
        spoken = next(filter(None, map(colour_of, words_of(label))), None)
        colour = spoken or colour  # what it is called, whatever its colour looks like
        things[key] = Thing(
            id=key,
            label=label,
            colour=colour,
            movable=not model.fixed,
            container=is_container,
            soft=model.soft is not None,
            parts=tuple(str(part) for part in about.get("parts", ())),
            size_m=model.size_m,
        )
    return Vocabulary(things=things, cameras=cameras or {})


ALIKE = 1.15
"""A box whose sides differ by less is a cube."""


def _shape_word(model: ObjectModel) -> str:
    """What the shape of a task's box is called; nothing for what has no such name."""
    if model.shape != "box" or model.size_m is None:
        return ""
    return "cube" if max(model.size_m) < ALIKE * min(model.size_m) else "box"
