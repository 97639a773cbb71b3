"""Noun phrases: how they are read, and which things of the vocabulary they mean."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bridge.task.check import TABLE, nearest
from twin.naming.colours import COLOUR_NAMES
from twin.naming.words import SAME_COLOURS, SAME_NOUNS, colour_of, singular
from twin.plan.ground.vocabulary import Ids, Vocabulary, refuse
from twin.plan.ground.words import CLOSED, PRONOUNS, SIZES, TABLES, Token

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
    colours: Ids = ()
    sizes: Ids = ()
    nouns: Ids = ()
    count: int | None = None
    every: bool = False
    loose: bool = False
    """Any of those that fit will do: "a cube", "two cubes"; not "the cube"."""
    pronoun: str = ""


@dataclass(frozen=True, kw_only=True)
class Choice:
    """Any of several were asked for, and these were taken: the planner's choice."""

    count: int
    among: Ids
    chosen: Ids


class Nouns:
    """Reads noun phrases, finds what they mean, and remembers it."""

    def __init__(self, vocabulary: Vocabulary) -> None:
        """Collect the words that mean something here."""
        self.vocabulary = vocabulary
        self._ids = {key.lower() for key in vocabulary.things}
        self._nouns = {noun for each in vocabulary.things.values() for noun in each.names[2]}
        self.themes: Ids = ()
        self.last: dict[str, Ids] = {}
        """Nouns of the last phrase that had one, by its slot: what "one" stands for."""
        self.choices: list[Choice] = []
        self.explanation: list[str] = []

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
        is_end = token.length_m is not None or word in CLOSED
        return _LETTERS.get(word, "n" if token.number is not None else "." if is_end else "x")

    def read(self, tokens: Sequence[Token], at: int, slot: str) -> tuple[NounPhrase, int]:
        """Read the noun phrase that begins here, and say where it ends."""
        letters = self.letters(tokens[at:])
        found = next(_PHRASE.finditer(letters))  # it may be empty
        words = [token.text for token in tokens[at : at + found.end()]]
        text = " ".join(words)
        if found["pronoun"]:
            return NounPhrase(text=text, pronoun=text), at + 1
        if not found["head"] and letters[found.end() : found.end() + 1] == "x":
            word = tokens[at + found.end()].text
            known = sorted(self._nouns | set(COLOUR_NAMES) | set(SAME_COLOURS) | set(SIZES))
            message = f"'{word}' is not known here.{nearest(word, known)}"
            refuse("unknown_object", message, self._of(slot))

        def part(name: str) -> list[str]:
            return words[slice(*found.span(name))] if found[name] else []

        def number(name: str) -> int | None:
            return tokens[at + found.start(name)].number if found[name] else None

        head, quantifier = part("head"), found["quantifier"]
        nouns = tuple(w if w in self._ids else _plain(w) for w in head)
        if found["head"] == "w":
            nouns = self.last.get(slot) or self.last.get("theme", ())
        if found["number"] and nouns:
            nouns = (*nouns[:-1], f"{nouns[-1]}_{number('number')}")  # duck 2
        colours = tuple(filter(None, map(colour_of, part("adjectives"))))
        every = found["lead"] == "e" or quantifier == "q"
        if not (colours or nouns or every):
            there = " ".join(each.text for each in tokens[max(at - 1, 0) : at + found.end() + 1])
            refuse("unknown_clause", f"'{there}' names no object.", self._of(slot))
        counts = (2 if found["lead"][:1] == "b" else None, number("count"), number("more"))
        count = next((each for each in counts if each is not None), None)
        is_plural = any(singular(word) != word for word in head if word not in self._ids)
        loose = "i" in found["lead"] or quantifier == "y" or (found["count"] and not quantifier)
        phrase = NounPhrase(
            text=text,
            colours=colours,
            sizes=tuple(word for word in part("adjectives") if word in SIZES),
            nouns=nouns if nouns or colours else ("object",),
            count=count,
            every=every or (is_plural and count is None),
            loose=bool(loose),
        )
        return phrase, at + found.end()

    def is_table(self, phrase: NounPhrase) -> bool:
        """Whether a phrase means the table."""
        return phrase in [NounPhrase(text=phrase.text, nouns=(name,)) for name in TABLES]

    def _of(self, slot: str) -> Ids:
        of = {"theme": self.vocabulary.movable(), "container": self.vocabulary.containers()}
        return of.get(slot, tuple(self.vocabulary.things))

    def resolve(self, phrase: NounPhrase, slot: str, *, besides: Sequence[str] = ()) -> Ids:
        """Say which things a phrase means in a slot; those besides only if nothing else is meant.

        What moves is the ``theme``, what it goes into, onto or beside a ``container``, ``support``
        or ``reference``.
        """
        if phrase.pronoun:
            meant = self.themes if slot == "theme" else ()
            if not meant or (phrase.pronoun == "it" and len(meant) > 1):
                message = f"it is not clear what '{phrase.text}' stands for. Name the object."
                refuse("ambiguous_object", message, meant or self._of(slot))
            self.explanation.append(f"'{phrase.text}' is {', '.join(meant)}, named before")
            return meant
        if slot == "support" and self.is_table(phrase):
            return (TABLE,)
        fitting = self.fitting(phrase)
        if not fitting:
            refuse("unknown_object", f"there is no '{phrase.text}' here.", self._of(slot))
        if phrase.nouns and phrase.nouns != ("object",):
            self.last[slot] = phrase.nouns
        boxes = self.vocabulary.containers() if slot == "support" else ()
        for good in (set(fitting) - set(besides), set(self._of(slot)) - set(boxes)):
            fitting = tuple(key for key in fitting if key in good) or fitting
        chosen = self._counted(phrase, fitting, slot)
        why = "the only one that fits" if len(chosen) == 1 else "all that fit"
        if len(chosen) < len(fitting):
            why = f"any {len(chosen)} of {', '.join(fitting)}: the first ones, the planner's choice"
        self.explanation.append(f"'{phrase.text}' is {self.vocabulary.describe(chosen)}: {why}")
        return chosen

    def fitting(self, phrase: NounPhrase) -> Ids:
        """What all words fit; a thing's own name comes before what else it may be called."""
        things = self.vocabulary.things
        for rank in range(3):  # its own name, its shape, what else it may be called
            called = {key: things[key].names[rank] | {key.lower()} for key in things}
            pool = [key for key in things if set(phrase.nouns) <= called[key]]
            coloured = [key for key in pool if set(phrase.colours) <= {things[key].colour}]
            fitting = tuple(key for key in coloured if self._has_sizes(key, phrase, pool))
            if fitting or (pool and rank == 1):
                return fitting
        return ()

    def _has_sizes(self, key: str, phrase: NounPhrase, pool: Sequence[str]) -> bool:
        """Whether a thing is the larger, or the smaller, beside others of its name."""
        things = self.vocabulary.things
        volumes = {name: float(np.prod(things[name].size_m or 0.0)) for name in pool}
        mine = volumes.pop(key, 0.0)
        others = [each for each in volumes.values() if mine and each]
        return all(
            others
            and (mine > APART * min(others) if SIZES[word] > 0 else APART * mine < max(others))
            for word in phrase.sizes
        )

    def _counted(self, phrase: NounPhrase, fitting: Ids, slot: str) -> Ids:
        """How many of those that fit are meant, and which."""
        told, many = self.vocabulary.describe(fitting), len(fitting)
        wanted = phrase.count if phrase.count is not None else many if phrase.every else 1
        if wanted > many or wanted < 1:
            refuse("too_few_objects", f"'{phrase.text}': there are only {many}: {told}.", fitting)
        if wanted == many:
            return fitting
        if not phrase.loose or slot != "theme":
            message = f"'{phrase.text}' fits {many} objects: {told}. Say which is meant."
            refuse("ambiguous_object", message, fitting)
        taken = [key for choice in self.choices for key in choice.chosen]
        fresh = [key for key in fitting if key not in taken]
        chosen = tuple((fresh if len(fresh) >= wanted else fitting)[:wanted])
        self.choices.append(Choice(count=wanted, among=fitting, chosen=chosen))
        return chosen


def _plain(word: str) -> str:
    return SAME_NOUNS.get(singular(word), singular(word))


def with_shared_noun(phrases: Sequence[NounPhrase]) -> Iterator[NounPhrase]:
    """The red and the green cubes: the noun at the end belongs to all."""
    last = phrases[-1]
    for each in phrases:
        shared = replace(each, nouns=last.nouns, every=each.every or last.every)
        yield each if each.nouns or each.pronoun or not last.nouns else shared
