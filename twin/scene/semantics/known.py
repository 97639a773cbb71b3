"""Things that a task names: their Gaussians were taken out already, so nobody has to guess them."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, UInt16

from twin.scene.semantics.lexicon import FORMS, colour_of, spoken_name, words_of

NAMED = "task"
"""Source of an instance that is an object of the task."""
MIN_SPLATS = 20


@dataclass(frozen=True, kw_only=True)
class Numbered:
    """Things in their final numbers."""

    labels: UInt16[np.ndarray, " num_splats"]
    """Known objects first, then what the segmenter found besides; 0 is the background."""
    keys: tuple[str, ...]
    """Of the known objects, in order: the first has the label 1."""
    others: tuple[int, ...]
    """Numbers that the segmenter gave the rest, in order."""


def numbered(
    labels: UInt16[np.ndarray, " num_splats"],
    known: Mapping[str, Bool[np.ndarray, " num_splats"]],
) -> Numbered:
    """Let the known objects have their Gaussians, and what the segmenter joined with them.

    A thing of which at least half belongs to one known object is that object: its rest is what
    was left in the background when the object was cut out. Objects with next to no Gaussians get
    no number: nothing can be said of them.

    Args:
        labels: From the segmenter; 0 is the background.
        known: The Gaussians of each object; no two share one.
    """
    keys = tuple(key for key, mask in known.items() if int(mask.sum()) >= MIN_SPLATS)
    num_things = int(labels.max(initial=0))
    sizes = np.bincount(labels, minlength=num_things + 1)
    new_number = np.zeros(num_things + 1, dtype=np.uint16)
    most = np.zeros(num_things + 1, dtype=np.int64)
    for number, key in enumerate(keys, start=1):
        held = np.bincount(labels[known[key]], minlength=num_things + 1)
        mine = (2 * held >= sizes) & (held > most)
        new_number[mine], most[mine] = number, held[mine]
    new_number[0] = 0
    others = tuple(n for n in range(1, num_things + 1) if not new_number[n] and sizes[n])
    for number, other in enumerate(others, start=len(keys) + 1):
        new_number[other] = number
    joined = new_number[labels]
    for number, key in enumerate(keys, start=1):
        joined[known[key]] = number
    return Numbered(labels=joined, keys=keys, others=others)


def label_of(key: str, colour: str, *, is_open: bool) -> str:
    """What a known object is called: its name in the task, with its colour.

    A box that is open says so, because "box" alone may be either.

    Args:
        key: Its id in the task file.
        colour: Name of its colour.
        is_open: Whether it has a cavity that opens upwards.
    """
    name = spoken_name(key)
    words = words_of(name)
    either = bool(words) and words[-1] in FORMS["box"] and words[-1] in FORMS["open container"]
    if is_open and either and "open" not in words:
        name = f"open {name}"
    if any(colour_of(word) is not None for word in words):
        return name
    return f"{colour} {name}"
