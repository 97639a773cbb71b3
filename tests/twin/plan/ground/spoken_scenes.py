"""Scenes to speak about, and how the outcome of an instruction is compared."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from twin.naming.words import kind_of
from twin.plan.ground.goals import Grounding
from twin.plan.ground.grammar import ground
from twin.plan.ground.vocabulary import GroundingError, Thing, Vocabulary

KEYS = ("object", "container", "support", "reference", "first", "second")


def vocabulary_from_labels(scene: Mapping[str, Mapping[str, str]]) -> Vocabulary:
    """A vocabulary of ids with ``label``, ``colour`` and ``role``, as the given file has them."""
    things = {}
    for key, about in scene.items():
        roles = {word.strip() for word in about.get("role", "").split(",")}
        things[key] = Thing(
            id=key,
            label=about["label"],
            colour=about.get("colour", ""),
            movable="movable" in roles and "fixed" not in roles,
            container="container" in roles or kind_of(about["label"]) == "container",
        )
    return Vocabulary(things=things)


SCENES: dict[str, Vocabulary] = {
    name: vocabulary_from_labels(things)
    for name, things in json.loads(Path(__file__).with_name("scenes.json").read_text()).items()
}


def chosen_of(found: Grounding) -> dict[str, str]:
    """What stands for objects of which any would have done."""
    return {key: f"any{item.count}" for item in found.choices for key in item.chosen}


def brief(goal: Mapping[str, Any], chosen: Mapping[str, str]) -> str:
    """A goal in one line: its kind, its objects, how far, in which direction."""
    words = [goal["kind"]]
    for key in KEYS:
        if key in goal:
            words.append(chosen.get(goal[key], goal[key]) if key == "object" else goal[key])
    if "by_m" in goal:
        words.append(f"{goal['by_m']:g}")
    if isinstance(goal.get("direction"), str):
        words.append(goal["direction"])
    return " ".join(words)


def asked(scene: Vocabulary, text: str) -> Grounding | GroundingError:
    """What comes of an instruction; anything but these two is a bug."""
    try:
        return ground(text, scene)
    except GroundingError as error:
        return error


def outcome(scene: Vocabulary, text: str) -> tuple[str, tuple[str, ...]]:
    """Goals or the kind of error in one line, with the order or the candidates."""
    found = asked(scene, text)
    if isinstance(found, GroundingError):
        return f"!{found.kind}", found.candidates
    goals = {brief(goal, chosen_of(found)) for goal in found.goals}
    return " ; ".join(sorted(goals)), found.order


def as_meant(scene: str, text: str, wanted: str, order: str = "") -> bool:
    """Whether an instruction of ``paraphrases.txt`` is understood as it says."""
    said, also = outcome(SCENES[scene], text)
    if wanted.startswith("!"):
        kind, *named = wanted.split()
        return said == kind and set(named) <= set(also)
    goals = " ; ".join(sorted(part.strip() for part in wanted.split(";")))
    return said == goals and order in ("", " ".join(also))
