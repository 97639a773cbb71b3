"""Noun phrases: how they are read, and which things of the vocabulary they mean."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from bridge.task.check import TABLE, nearest
from twin.naming.colours import COLOUR_NAMES
from twin.naming.words import SAME_COLOURS, SAME_NOUNS, colour_of, singular
from twin.plan.ground.vocabulary import GroundingError, Vocabulary
from twin.plan.ground.words import CLOSED, NUMBERS, PRONOUNS, SIZES, TABLES, Token

APART = 1.25
"""A thing is large beside one that it is so many times larger than, by volume."""
_LETTERS = {
    "the": "t", "of": "o", "both": "b", "any": "y", "everything": "e", "ones": "w",
    **dict.fromkeys(("a", "an"), "i"), **dict.fromkeys(("all", "every", "each"), "q"),
    **dict.fromkeys(SIZES, "s"), **dict.fromkeys(TABLES, "d"), **dict.fromkeys(PRONOUNS, "p"),
}  # fmt: skip
"""What a word may be in a noun phrase; a number is n, a colour c, a noun h, an unknown word x."""
_PHRASE = re.compile(
    r"(?P<pronoun>p)"
    r"|(?P<lead>e|i|bo?t?|(?P<quantifier>[qy])?(?:(?P<count>n)o?t?|(?:(?<=[qy])o)?t?(?P<more>n)?))"
    r"(?P<adjectives>[cs]*)(?P<head>h+|d|w)?(?:(?<=h)(?P<number>n))?"
)


@dataclass(frozen=True, kw_only=True)
class NounPhrase:
    """A noun phrase as it was said."""

    text: str
    colours: tuple[str, ...] = ()
    sizes: tuple[str, ...] = ()
    nouns: tuple[str, ...] = ()
    count: int | None = None
    every: bool = False
    loose: bool = False
    """Any of those that fit will do: "a cube", "two cubes"; not "the cube"."""
    pronoun: str = ""


@dataclass(frozen=True, kw_only=True)
class Choice:
    """Any of several were asked for, and these were taken: the planner's choice."""

    count: int
    among: tuple[str, ...]
    chosen: tuple[str, ...]


@dataclass
class Memory:
    """What has been spoken of before."""

    themes: tuple[str, ...] = ()
    nouns: dict[str, tuple[str, ...]] = field(default_factory=dict)
    """Of the last phrase that had one, by its slot: what "one" stands for."""
    choices: list[Choice] = field(default_factory=list)
    explanation: list[str] = field(default_factory=list)


class Nouns:
    """Reads noun phrases and finds what they mean."""

    def __init__(self, vocabulary: Vocabulary, memory: Memory) -> None:
        """Collect the words that mean something here; the memory is written to."""
        self.vocabulary, self.memory = vocabulary, memory
        things = vocabulary.things.values()
        self._ids = {key.lower(): key for key in vocabulary.things}
        self._nouns = {noun for thing in things for noun in thing.names[2]}

    def letters(self, tokens: Sequence[Token]) -> str:
        """What each word may be in a noun phrase; a full stop ends one."""
        return "".join(self._letter(tokens, at) for at in range(len(tokens)))

    def _letter(self, tokens: Sequence[Token], at: int) -> str:
        token, word = tokens[at], tokens[at].text
        if word == "one":  # a number, or what stands for a noun
            behind = self._letter(tokens, at + 1) if at + 1 < len(tokens) else "."
            return "n" if behind in "ocsh" else "w"
        if colour_of(word) is not None and word not in self._nouns:
            return "c"
        if _plain(word) in self._nouns or word in self._ids:
            return "h"
        if word in _LETTERS:
            return _LETTERS[word]
        if token.number is not None or word in NUMBERS:
            return "n"
        is_end = token.length_m is not None or word in CLOSED
        return "." if is_end else "x"

    def read(self, tokens: Sequence[Token], at: int, slot: str) -> tuple[NounPhrase, int]:
        """Read the noun phrase that begins here, and say where it ends."""
        letters = self.letters(tokens[at:])
        found = next(_PHRASE.finditer(letters))  # it may be empty
        words = [token.text for token in tokens[at : at + found.end()]]
        text = " ".join(words)
        if found["pronoun"]:
            return NounPhrase(text=text, pronoun=text), at + 1
        if not found["head"] and letters[found.end() : found.end() + 1] == "x":
            self._refuse_unknown(tokens[at + found.end()].text, slot)

        def part(name: str) -> list[str]:
            return words[slice(*found.span(name))] if found[name] else []

        def number(name: str) -> int | None:
            (word,) = part(name) or [""]
            return int(word) if word.isdigit() else NUMBERS.get(word)

        head, quantifier = part("head"), found["quantifier"]
        nouns = tuple(w if w in self._ids else _plain(w) for w in head)
        if found["head"] == "w":
            nouns = self.memory.nouns.get(slot) or self.memory.nouns.get("theme", ())
        if found["number"] and nouns:
            nouns = (*nouns[:-1], f"{nouns[-1]}_{number('number')}")  # duck 2
        colours = tuple(c for w in part("adjectives") if (c := colour_of(w)) is not None)
        every = found["lead"] == "e" or quantifier == "q"
        if not (colours or nouns or every):
            there = " ".join(token.text for token in tokens[max(at - 1, 0) : at + found.end() + 1])
            message = f"'{there}' names no object."
            raise GroundingError("unknown_clause", message, candidates=self._of(slot))
        first = 2 if found["lead"][:1] == "b" else number("count")
        count = first if first is not None else number("more")
        is_plural = any(singular(word) != word for word in head if word not in self._ids)
        phrase = NounPhrase(
            text=text,
            colours=colours,
            sizes=tuple(word for word in part("adjectives") if word in SIZES),
            nouns=nouns if nouns or colours else ("object",),
            count=count,
            every=every or (is_plural and count is None),
            loose=found["lead"] == "i"
            or quantifier == "y"
            or (not quantifier and number("count") is not None),
        )
        return phrase, at + found.end()

    def _refuse_unknown(self, word: str, slot: str) -> None:
        known = sorted(self._nouns | set(COLOUR_NAMES) | set(SAME_COLOURS) | set(SIZES))
        message = f"'{word}' is not known here.{nearest(word, known)}"
        raise GroundingError("unknown_object", message, candidates=self._of(slot))

    def is_table(self, phrase: NounPhrase) -> bool:
        """Whether a phrase means the table."""
        return phrase in [NounPhrase(text=phrase.text, nouns=(name,)) for name in TABLES]

    def _of(self, slot: str) -> tuple[str, ...]:
        if slot == "theme":
            return self.vocabulary.movable()
        if slot == "container":
            return self.vocabulary.containers()
        return tuple(self.vocabulary.things)

    def resolve(
        self, phrase: NounPhrase, slot: str, *, besides: Sequence[str] = ()
    ) -> tuple[str, ...]:
        """Say which things a phrase means in a slot; those besides only if nothing else is meant.

        What moves is the ``theme``, what it goes into, onto or beside a ``container``, ``support``
        or ``reference``.
        """
        if phrase.pronoun:
            return self._pronoun(phrase, slot)
        if slot == "support" and self.is_table(phrase):
            return (TABLE,)
        fitting = self.fitting(phrase)
        if not fitting:
            message = f"there is no '{phrase.text}' here."
            raise GroundingError("unknown_object", message, candidates=self._of(slot))
        if phrase.nouns and phrase.nouns != ("object",):
            self.memory.nouns[slot] = phrase.nouns
        fitting = self._suited(fitting, slot, besides)
        chosen = self._counted(phrase, fitting, slot)
        why = "the only one that fits" if len(chosen) == 1 else "all that fit"
        if len(chosen) < len(fitting):
            why = f"any {len(chosen)} of {', '.join(fitting)}: the first ones, the planner's choice"
        told = self.vocabulary.describe(chosen)
        self.memory.explanation.append(f"'{phrase.text}' is {told}: {why}")
        return chosen

    def _pronoun(self, phrase: NounPhrase, slot: str) -> tuple[str, ...]:
        meant = self.memory.themes if slot == "theme" else ()
        if not meant or (phrase.pronoun == "it" and len(meant) > 1):
            message = f"it is not clear what '{phrase.text}' stands for. Name the object."
            raise GroundingError("ambiguous_object", message, candidates=meant or self._of(slot))
        told = f"'{phrase.text}' is {', '.join(meant)}, named before"
        self.memory.explanation.append(told)
        return meant

    def fitting(self, phrase: NounPhrase) -> tuple[str, ...]:
        """What all words fit; a thing's own name comes before what else it may be called."""
        things = self.vocabulary.things
        for rank in range(3):  # its own name, its shape, what else it may be called
            pool = [
                key
                for key in things
                if set(phrase.nouns) <= things[key].names[rank] | {key.lower()}
            ]
            fitting = [key for key in pool if set(phrase.colours) <= {things[key].colour}]
            fitting = [key for key in fitting if self._has_sizes(key, phrase, pool)]
            if fitting or (pool and rank == 1):
                return tuple(fitting)
        return ()

    def _has_sizes(self, key: str, phrase: NounPhrase, pool: Sequence[str]) -> bool:
        """Whether a thing is the larger, or the smaller, beside others of its name."""
        sizes = {name: self.vocabulary.things[name].size_m for name in pool}
        volumes = {name: float(np.prod(size)) for name, size in sizes.items() if size is not None}
        mine = volumes.pop(key, 0.0)
        others = list(volumes.values()) if mine else []
        return all(
            others
            and (mine > APART * min(others) if SIZES[word] > 0 else APART * mine < max(others))
            for word in phrase.sizes
        )

    def _suited(
        self, fitting: tuple[str, ...], slot: str, besides: Sequence[str]
    ) -> tuple[str, ...]:
        """Leave out what cannot be meant, as long as something is left."""
        things = self.vocabulary.things
        suited = {
            "theme": {key for key in fitting if things[key].movable},
            "container": {key for key in fitting if things[key].container},
            "support": {key for key in fitting if not things[key].container},
        }.get(slot, set(fitting))
        for good in (set(fitting) - set(besides), suited):
            fitting = tuple(key for key in fitting if key in good) or fitting
        return fitting

    def _counted(self, phrase: NounPhrase, fitting: tuple[str, ...], slot: str) -> tuple[str, ...]:
        """How many of those that fit are meant, and which."""
        told, many = self.vocabulary.describe(fitting), len(fitting)
        wanted = phrase.count if phrase.count is not None else many if phrase.every else 1
        if wanted > many or wanted < 1:
            message = f"'{phrase.text}': there are only {many}: {told}."
            raise GroundingError("too_few_objects", message, candidates=fitting)
        if wanted == many:
            return fitting
        if not phrase.loose or slot != "theme":
            message = f"'{phrase.text}' fits {many} objects: {told}. Say which is meant."
            raise GroundingError("ambiguous_object", message, candidates=fitting)
        taken = [key for choice in self.memory.choices for key in choice.chosen]
        fresh = [key for key in fitting if key not in taken]
        chosen = tuple((fresh if len(fresh) >= wanted else fitting)[:wanted])
        self.memory.choices.append(Choice(count=wanted, among=fitting, chosen=chosen))
        return chosen


def _plain(word: str) -> str:
    single = singular(word)
    return SAME_NOUNS.get(single, single)


def with_shared_noun(phrases: Sequence[NounPhrase]) -> Iterator[NounPhrase]:
    """The red and the green cubes: the noun at the end belongs to all."""
    last = phrases[-1]
    for phrase in phrases:
        if phrase.nouns or phrase.pronoun or not last.nouns:
            yield phrase
        else:
            yield replace(phrase, nouns=last.nouns, every=phrase.every or last.every)
