"""What a phrase means among the things of a scene: nouns, colours, sizes, parts and relations."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float

from bridge.geometry import se3
from twin.naming.colours import near_colours
from twin.naming.things import NAMED, Instance, SemanticScene, SemanticsError
from twin.naming.words import (
    ALONE,
    ANY_THING,
    PURPOSES,
    SHAPE_WORDS,
    SIZES,
    THINGS_TOO,
    colour_of,
    known_words,
    names_of,
    part_of,
    singular,
    words_of,
)

APART = 1.25
"""A thing is large beside one that it is so many times larger than, by volume."""
TOUCH_M = 0.02
"""What stands on something is this near to its top, and what is inside this far within it."""
BESIDE_M = 0.1
"""What is next to something is no farther from it."""
NEARLY = 0.7
"""Score of a thing whose colour only nearly has that name."""
SAYS_YES = 0.5
"""Activation from which a model means a thing."""
CUPS = ("mug", "cup")
CUP_M, BOX_M, CARRIED_M = (0.07, 0.17), (0.1, 0.8), 0.2
"""Longest extents of what may be a cup, or a box, where noisy depth hides its shape; a box shorter
than the last is half as thick as it is long."""
PLACES = {"left": (0, 1), "leftmost": (0, 1), "right": (0, -1), "rightmost": (0, -1),
          "front": (2, 1), "nearest": (2, 1), "back": (2, -1), "rear": (2, -1)}  # fmt: skip
"""Words for the first along an axis of the camera."""
_WAYS = {
    "left": r"(?:(?:to|on) the )?left(?: side)? of",
    "right": r"(?:(?:to|on) the )?right(?: side)? of",
    "front": r"in front of",
    "behind": r"behind",
    "on": r"on top of|on",
    "under": r"under(?:neath)?|below|beneath",
    "inside": r"in|inside(?: of)?|within",
    "beside": r"beside|next to|near",
}
_RELATION = re.compile("|".join(rf"(?P<{name}>\b(?:{form})\b)" for name, form in _WAYS.items()))

Meaning = Callable[[str], Sequence[float]]
"""A model's activation of each instance for a text, 0..1."""


@dataclass(frozen=True, kw_only=True)
class Found:
    """One thing, or a part of it, that a phrase means."""

    item: Instance
    part: str = ""
    """Empty: all of it."""
    score: float
    """0..1."""

    @property
    def mask(self) -> Bool[np.ndarray, " num_splats"]:
        """Its Gaussians."""
        return self.item.parts[self.part] if self.part else self.item.mask


@dataclass(frozen=True, kw_only=True)
class Answer:
    """What a phrase means; nothing, and why, where nothing fits."""

    found: tuple[Found, ...] = ()
    why: str = ""


@dataclass(frozen=True, kw_only=True)
class Asker:
    """Who asks: from where, of which scene, and with which model."""

    scene: SemanticScene
    T_base_camera: Float[np.ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))
    """From where left and right are said."""
    meaning: Meaning | None = None
    """None: the lexicon answers."""

    def find(self, text: str) -> Answer:
        """Say which things, or which parts of them, a phrase means.

        Every word has to be understood. Of several things that fit a relation the nearest is meant,
        unless the noun is a plural.
        """
        plain = text.lower().replace("’", "'")
        if not words_of(plain):
            message = f"{text!r} names nothing to look for."
            raise SemanticsError(message)
        relation = _RELATION.search(plain)
        if relation is None:
            return self._phrase(plain)
        head, anchor = plain[: relation.start()], plain[relation.end() :]
        what, beside = self._phrase(head), self.find(anchor) if words_of(anchor) else Answer()
        if not what.found or not beside.found:
            return Answer(why=what.why or beside.why or f"{anchor!r} names nothing")
        way = str(relation.lastgroup)
        pairs = [
            (self._gap_m(one.item, other.item), index)
            for index, one in enumerate(what.found)
            for other in beside.found
            if one.item.id != other.item.id and self._holds(way, one.item, other.item)
        ]
        if not pairs:
            return Answer(why=f"none of {len(what.found)} is {relation[0]} that")
        meant = {index for _, index in pairs} if _is_plural(head) else {min(pairs)[1]}
        return Answer(found=tuple(what.found[index] for index in sorted(meant)))

    def _phrase(self, text: str) -> Answer:
        """A phrase without a relation."""
        own = {word for item in self.scene.instances for word in words_of(item.label)}
        words = words_of(text)
        parts = [word for word in words if part_of(word) is not None and word not in own]
        places = [word for word in words if word in PLACES and word not in own]
        about = [word for word in words if word not in (*parts, *places)]
        if parts and not about and not set(parts) <= set(ALONE):
            return Answer(why=f"say whose {' '.join(parts)}")
        found, why = self._things(about or [ANY_THING[0]], own)
        if found and parts:
            wanted = {part_of(word) for word in parts}
            found = [
                Found(item=each.item, part=part, score=each.score)
                for each in found
                for part in each.item.parts
                if part in wanted
            ]
            why = "" if found else f"nothing like that has a {' '.join(parts)}"
        for axis, sign in (PLACES[word] for word in places) if found else ():
            found = [min(found, key=lambda each: sign * self._seen_m(each.item)[axis])]
        return Answer(found=tuple(found), why=why)

    def _things(self, words: Sequence[str], own: set[str]) -> tuple[list[Found], str]:
        """The things that all words fit, and why there are none."""
        items = self.scene.instances
        if self.meaning is not None:
            scores = self.meaning(" ".join(words))
            told = [
                Found(item=item, score=float(score))
                for item, score in zip(items, scores, strict=True)
                if score > SAYS_YES
            ]
            return sorted(told, key=lambda each: -each.score), "" if told else "the model sees none"
        own_head = words[-1:] if words[-1] in THINGS_TOO else []
        colours = [word for word in words if colour_of(word) and word not in own_head]
        wanted, sizes = set(map(colour_of, colours)), [word for word in words if word in SIZES]
        nouns = [word for word in words[:-1] if word not in PURPOSES] + [words[-1]]
        nouns = [word for word in nouns if word not in (*sizes, *colours)]
        unknown = [word for word in nouns if word not in known_words() | own]
        labels = ", ".join(sorted({item.label for item in items})) or "nothing"
        if unknown:
            return [], f"not known here: {', '.join(unknown)}; there is {labels}"
        for pool in self._called({word for word in nouns if word not in ANY_THING}):
            sized = [item for item in pool if all(self._has_size(item, w, pool) for w in sizes)]
            fit = [[item for item in sized if wanted <= set(map(colour_of, words_of(item.label)))]]
            seen = [replace(o, score=NEARLY * o.score) for o in sized if o.source != NAMED]
            near = [(o, near_colours(o.color_srgb)) for o in seen]
            fit += [[o for o, names in near if wanted <= names[k]] for k in (0, 1)]
            for best in filter(None, fit):
                return [Found(item=item, score=item.score) for item in best], ""
        return [], f"there is {labels}"

    def _called(self, nouns: set[str]) -> list[list[Instance]]:
        """What answers to all nouns: by the task's word before its own word before its shape's."""
        items = self.scene.instances
        own = [item for item in items if nouns <= set(words_of(item.label))]
        named = [item for item in own if item.source == NAMED]
        shaped = [item for item in items if nouns <= names_of(item.label, max(item.size_m))]
        sure = [item for item in shaped if _names_by_size(item) != CUPS]
        unsure = [item for item in items if nouns <= set(_names_by_size(item))]
        return [named, own, sure, unsure, shaped] if nouns else [shaped]

    def _has_size(self, item: Instance, word: str, pool: Sequence[Instance]) -> bool:
        """Sizes compare with others of that name, or else with all; "open" and "flat" with it."""
        if word in ("open", "flat"):
            return word in words_of(item.label)
        if word == "tall":
            return item.size_m[2] > 1.2 * max(item.size_m[:2])
        others = pool if len(pool) > 1 else self.scene.instances
        volumes = [float(np.prod(each.size_m)) for each in others if each.id != item.id]
        mine = float(np.prod(item.size_m))
        if word in ("small", "little", "tiny"):
            return any(APART * mine < volume for volume in volumes)
        return any(mine > APART * volume for volume in volumes)

    def _seen_m(self, item: Instance) -> Float[np.ndarray, "3"]:
        """Its centre in the camera's frame: right, down, forward."""
        center = item.T_base_instance[None, :3, 3]
        return np.asarray(se3.apply(se3.invert(self.T_base_camera), center)[0])

    def _gap_m(self, a: Instance, b: Instance) -> float:
        """How far their boxes are apart, about."""
        gap = np.abs(_in_box(a, b)) - (np.array(a.size_m) + np.array(b.size_m)) / 2
        return float(np.linalg.norm(np.maximum(gap, 0.0)))

    def _holds(self, way: str, a: Instance, b: Instance) -> bool:
        """Whether one is there, as seen from the other."""
        if way == "under":
            return self._holds("on", b, a)
        if way == "beside":
            return self._gap_m(a, b) < BESIDE_M
        if way in ("left", "right", "front", "behind"):
            axis, sign = {"left": (0, -1), "right": (0, 1), "front": (2, -1), "behind": (2, 1)}[way]
            offset = self._seen_m(a) - self._seen_m(b)
            return bool(sign * offset[axis] > TOUCH_M)
        offset, half = _in_box(a, b), np.array(b.size_m) / 2
        over = bool((np.abs(offset[:2]) < half[:2] + TOUCH_M).all())
        bottom_m = offset[2] - a.size_m[2] / 2
        if way == "on":
            return over and bool(abs(bottom_m - half[2]) < TOUCH_M)
        return over and bool(-half[2] - TOUCH_M < bottom_m < half[2] - TOUCH_M)


def _names_by_size(item: Instance) -> tuple[str, ...]:
    """What a box or less, as noisy depth shows it, may be besides."""
    short, long = min(item.size_m), max(item.size_m)
    if item.source == NAMED or words_of(item.label)[-1] not in ("box", "block", "thing"):
        return ()
    if CUP_M[0] < long < CUP_M[1] and short > 0.6 * long:
        return CUPS
    thickness = 0.25 if long > CARRIED_M else 0.5
    is_box = BOX_M[0] < long < BOX_M[1] and short > thickness * long
    return SHAPE_WORDS["block"] if is_box else ()


def _is_plural(text: str) -> bool:
    return any(singular(word) != word for word in re.findall(r"[a-z]+", text.replace("'s", "")))


def _in_box(a: Instance, b: Instance) -> Float[np.ndarray, "3"]:
    """Where the centre of one is in the frame of the other's box."""
    center = a.T_base_instance[None, :3, 3]
    return np.asarray(se3.apply(se3.invert(b.T_base_instance), center)[0])
