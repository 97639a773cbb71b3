"""Words for things: which mean the same, what they look like, what parts they have."""

import re
from collections.abc import Iterable

from twin.scene.semantics.colour import COLOUR_NAMES

FORMS = {
    "open container": (
        "container", "basket", "box", "bin", "tray", "bowl", "bucket", "crate", "cup", "mug",
        "pot",
    ),
    "cube": ("cube", "block", "brick", "box", "dice"),
    "box": ("box", "block", "brick", "carton", "package", "case"),
    "flat box": ("box", "book", "card", "plate", "board", "tablet"),
    "cylinder": ("cylinder", "can", "cup", "mug", "bottle", "tube", "jar"),
    "ball": ("ball", "sphere", "orange", "apple"),
    "toy": ("toy", "animal", "plush", "figure", "duck", "sloth", "teddy", "bear", "doll"),
}  # fmt: skip
"""What a form may be called."""
ANY_THING = ("object", "thing", "item", "stuff")
ANIMALS = ("toy", "animal", "plush", "figure", "duck", "sloth", "teddy", "bear", "doll")
KIND_NAMES = {"container": ("container",), "animal": ("toy", "animal"), "other": ()}
"""What every thing of a kind may be called, see ``kind_of``."""
TYPICAL_COLOURS = {
    "duck": ("yellow", "orange"),
    "sloth": ("brown", "beige", "grey"),
    "teddy": ("brown", "beige"),
    "orange": ("orange",),
    "apple": ("red", "green"),
}
"""A form alone does not tell a duck from a sloth; its colour may."""
PART_WORDS = {
    "rim": ("rim", "edge", "lip"),
    "floor": ("floor", "bottom", "inside", "cavity"),
    "walls": ("wall", "side"),
    "handle": ("handle", "grip", "ear"),
    "body": ("body", "torso", "belly", "trunk"),
    "head": ("head", "face", "beak"),
    "limbs": ("limb", "leg", "arm", "foot", "hand", "paw", "wing"),
}
SAME_COLOURS = {"gray": "grey", "violet": "purple", "tan": "beige", "turquoise": "cyan"}
SMALL_WORDS = ("the", "a", "an", "all", "of", "on", "in", "any", "every", "my", "this", "that")
SIZES = ("small", "little", "tiny", "large", "big", "open", "flat", "tall")


def words_of(text: str) -> list[str]:
    """Lower-case words, plurals made singular, possessives cut, articles left out."""
    cleaned = "".join(c if c.isalnum() else " " for c in text.lower().replace("'s", " "))
    return [singular(word) for word in cleaned.split() if word not in SMALL_WORDS]


def singular(word: str) -> str:
    """Cut a plural ending: ducks, boxes, berries; glass stays."""
    irregular = {"feet": "foot", "dice": "dice", "teddies": "teddy"}
    if word in irregular:
        return irregular[word]
    if word.endswith("ies") and len(word) > 4:
        return word[:-3] + "y"
    if word.endswith(("xes", "ches", "shes", "sses")):
        return word[:-2]
    if word.endswith("s") and not word.endswith(("ss", "us")) and len(word) > 3:
        return word[:-1]
    return word


def colour_of(word: str) -> str | None:
    """The colour a word names, or None."""
    word = SAME_COLOURS.get(word, word)
    return word if word in COLOUR_NAMES else None


def part_of(word: str) -> str | None:
    """The part a word names, or None."""
    return next((part for part, names in PART_WORDS.items() if word in names), None)


def spoken_name(key: str) -> str:
    """An id of a task file as a person would say it: ``duck_1`` is a duck."""
    return re.sub(r"[_\d]+", " ", key).strip()


def form_in(label: str) -> str | None:
    """The longest form whose name ends a label of the default segmenter, or None.

    What is called open, and may be a container, is one.
    """
    words = words_of(label)
    if "open" in words and words[-1] in FORMS["open container"]:
        return "open container"
    ends = [form for form in FORMS if label == form or label.endswith(" " + form)]
    return max(ends, key=len, default=None)


def names_of(label: str) -> set[str]:
    """Nouns that a label answers to: its own words, its kind, what its form may be called."""
    names = set(words_of(label)) | set(ANY_THING) | set(KIND_NAMES[kind_of(label)])
    form = form_in(label)
    if form is not None:
        colours = {colour_of(word) for word in words_of(label)} - {None}
        names |= {
            name
            for name in FORMS[form]
            if name not in TYPICAL_COLOURS or not colours or colours & set(TYPICAL_COLOURS[name])
        }
    return names


def known_words() -> set[str]:
    """Every noun the lexicon has."""
    nouns: Iterable[tuple[str, ...]] = (*FORMS.values(), ANY_THING, ANIMALS)
    return {name for group in nouns for name in group}


def kind_of(label: str) -> str:
    """Which parts to look for: "container", "animal" or "other"."""
    form, words = form_in(label), words_of(label)
    if form == "open container" or (form is None and _any_of(words, FORMS["open container"])):
        return "container"
    if form == "toy" or (form is None and _any_of(words, ANIMALS)):
        return "animal"
    return "other"


def _any_of(words: list[str], names: tuple[str, ...]) -> bool:
    return any(word in names for word in words)
