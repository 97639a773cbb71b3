"""Which words mean the same, what things look like and what parts they have."""

import re

from twin.naming.colours import COLOUR_NAMES

SHAPE_WORDS = {
    "open container": (
        "container", "basket", "box", "bin", "tray", "bowl", "bucket", "crate", "cup", "mug",
        "pot",
    ),
    "cube": ("cube", "block", "brick", "box", "dice"),
    "box": ("box", "block", "brick", "carton", "package", "case"),
    "flat box": ("box", "book", "card", "plate", "board", "tablet"),
    "cylinder": ("cylinder", "can", "cup", "mug", "bottle", "tube", "jar"),
    "ball": ("ball", "sphere", "orange", "apple"),
    "slab": ("book", "board", "magazine", "plate", "card", "tablet", "picture"),
    "block": ("box", "bin", "package", "parcel", "case", "carton"),
    "seat": ("chair", "seat", "stool", "armchair"),
    "thing": (),
}  # fmt: skip
"""What a thing of a shape may be called."""
HELD, HAND_M = ("book", "magazine", "card", "plate", "tablet", "apple", "orange", "dice", "brick",
                "cup", "mug", "can", "bottle", "tube", "jar"), 0.45  # fmt: skip
"""What a hand holds, and is not longer."""
PURPOSES = ("recycling", "waste", "trash", "rubbish", "coffee", "tea", "office", "desk", "kitchen")
"""Before a noun: what a thing is for, which its looks do not tell."""
ROUND = ("bowl", "bucket", "cup", "mug", "pot")
"""Open containers that are called nothing else."""
ANY_THING = ("thing", "object", "item", "stuff", "everything", "anything")
ANIMALS = ("toy", "animal", "plush", "figure", "duck", "sloth", "teddy", "bear", "doll")
KIND_NAMES = {"container": ("container",), "animal": ("toy", "animal", "plush"), "other": ()}
"""What every thing of a kind may be called, see ``kind_of``."""
PART_WORDS = {
    "rim": ("rim", "edge", "lip"),
    "floor": ("floor", "bottom", "inside", "cavity"),
    "walls": ("wall", "side"),
    "handle": ("handle", "grip", "ear"),
}
ALONE = ("rim", "lip", "handle", "grip")
"""Parts that need no thing named with them; a wall or a floor alone is no part."""
SAME_COLOURS = {
    "gray": "grey", "silver": "grey", "charcoal": "grey",
    "violet": "purple", "lilac": "purple", "mauve": "purple",
    "tan": "beige", "cream": "beige", "ivory": "beige", "khaki": "beige",
    "turquoise": "cyan", "teal": "cyan", "aqua": "cyan",
    "crimson": "red", "scarlet": "red", "ruby": "red", "vermilion": "red",
    "navy": "blue", "azure": "blue", "cobalt": "blue",
    "emerald": "green", "olive": "green", "lime": "green", "jade": "green",
    "golden": "yellow", "gold": "yellow", "amber": "yellow",
    "chocolate": "brown", "magenta": "pink",
}  # fmt: skip
THINGS_TOO = ("orange", "lime", "olive", "chocolate", "cream", "ruby", "emerald", "gold")
"""Colours that are things where nothing follows."""
SAME_NOUNS = {
    "duckling": "duck", "ducky": "duck", "duckie": "duck", "plushie": "plush", "plushy": "plush",
    "hamper": "basket", "receptacle": "container", "vessel": "container", "pail": "bucket",
    "cuboid": "block", "die": "dice",
}  # fmt: skip
"""Nouns that are another word for one of the lexicon."""
SMALL_WORDS = ("the", "a", "an", "all", "of", "on", "in", "any", "every", "my", "this", "that")
SIZES = ("small", "little", "tiny", "large", "big", "open", "flat", "tall")


def words_of(text: str) -> list[str]:
    """Lower-case words, plurals made singular, possessives cut, articles left out."""
    cleaned = "".join(c if c.isalnum() else " " for c in text.lower().replace("'s", " "))
    words = (singular(word) for word in cleaned.split() if word not in SMALL_WORDS)
    return [SAME_NOUNS.get(word, word) for word in words]


def singular(word: str) -> str:
    """Cut a plural ending: ducks, boxes, berries; glass stays."""
    irregular = {"feet": "foot", "dice": "dice", "teddies": "teddy", "duckies": "ducky"}
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


def shape_in(label: str) -> str | None:
    """The longest shape whose name ends a label of the default segmenter, or None.

    What is called open, and may be a container, is one.
    """
    words = words_of(label)
    if "open" in words and words[-1] in SHAPE_WORDS["open container"]:
        return "open container"
    ends = [shape for shape in SHAPE_WORDS if label == shape or label.endswith(" " + shape)]
    return max(ends, key=len, default=None)


def names_of(label: str, longest_m: float = 0.0) -> set[str]:
    """Nouns that a label answers to: its own words, its kind, what its shape may be called.

    What somebody called a box is no mug, though both are open containers.
    """
    words = words_of(label)
    names = set(words) | set(ANY_THING) | set(KIND_NAMES[kind_of(label)])
    shape = shape_in(label)
    called = set(SHAPE_WORDS[shape] if shape is not None else ())
    called -= set(HELD if longest_m > HAND_M else ())
    if shape == "open container" and words[-1] != "container":
        called -= set(ROUND)
    return names | called


def known_words() -> set[str]:
    """Every noun the lexicon has."""
    return {name for group in (*SHAPE_WORDS.values(), ANY_THING, ANIMALS) for name in group}


def kind_of(label: str) -> str:
    """Which parts to look for: "container", "animal" or "other"."""
    shape, words = shape_in(label), set(words_of(label))
    if shape == "open container" or (shape is None and words & set(SHAPE_WORDS["open container"])):
        return "container"
    return "animal" if shape is None and words & set(ANIMALS) else "other"


def label_of(key: str, colour: str, *, is_open: bool, shape: str = "") -> str:
    """What a known object is called: its name in the task, with its colour.

    A box that is open says so, because "box" alone may be either. A name that is nothing but a
    colour gets its shape: "red" is a red cube.

    Args:
        is_open: Whether it has a cavity that opens upwards.
        shape: One of ``SHAPE_WORDS``; empty where nobody knows.
    """
    name = spoken_name(key)
    words = words_of(name)
    if shape and words and all(colour_of(word) is not None for word in words):
        name = f"{name} {shape}"
        words = words_of(name)
    either = (
        bool(words)
        and words[-1] in SHAPE_WORDS["box"]
        and words[-1] in SHAPE_WORDS["open container"]
    )
    if is_open and either and "open" not in words:
        name = f"open {name}"
    if any(colour_of(word) is not None for word in words):
        return name
    return f"{colour} {name}"
