"""Noun phrases: how they are read, and which things of the vocabulary they mean."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from bridge.task.check import TABLE, nearest
from twin.naming.colours import COLOUR_NAMES
from twin.naming.words import SAME_COLOURS, SAME_NOUNS, colour_of, singular
from twin.plan.ground.vocabulary import GroundingError, Thing, Vocabulary
from twin.plan.ground.words import (
    ALL,
    ARTICLES,
    CLOSED,
    NUMBERS,
    PRONOUNS,
    SIZES,
    TABLES,
    Token,
    printable,
)

APART = 1.25
"""A thing is large beside one that it is so many times larger than, by volume."""


@dataclass(frozen=True, kw_only=True)
class NounPhrase:
    """A noun phrase as it was said."""

    text: str
    colours: tuple[str, ...] = ()
    sizes: tuple[str, ...] = ()
    nouns: tuple[str, ...] = ()
    """Singular, or the id of a thing."""
    every: bool = False
    """All that fit: "all", or a plural."""
    count: int | None = None
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
    chosen: list[str] = field(default_factory=list)
    choices: list[Choice] = field(default_factory=list)
    explanation: list[str] = field(default_factory=list)


class Nouns:
    """Reads noun phrases and finds what they mean."""

    def __init__(self, vocabulary: Vocabulary, memory: Memory) -> None:
        """Collect the words that mean something here; the memory is written to."""
        self.vocabulary, self.memory = vocabulary, memory
        things = vocabulary.things.values()
        self._ids = {key.lower(): key for key in vocabulary.things}
        self._nouns = {noun for thing in things for noun in (*thing.names, thing.shape)} - {""}

    def is_one(self, word: str) -> bool:
        """Whether a word may begin a noun phrase, and no other part of a clause."""
        determiners = (*ARTICLES, *ALL, *PRONOUNS, *NUMBERS, *TABLES, "both", "any")
        return word in determiners or bool(self._meaning(word))

    def _meaning(self, word: str) -> str:
        """``id``, ``colour``, ``size``, ``noun``, or empty: the word means nothing here."""
        if colour_of(word) is not None and word not in self._nouns:
            return "colour"
        if word in self._ids:
            return "id"
        if word in SIZES:
            return "size"
        is_noun = word in ("one", "ones", *TABLES) or _plain(word) in self._nouns
        return "noun" if is_noun else ""

    def read(self, tokens: Sequence[Token], at: int, slot: str) -> tuple[NounPhrase, int]:
        """Read the noun phrase that begins here, and say where it ends."""
        start = at
        if at < len(tokens) and tokens[at].text in PRONOUNS:
            return NounPhrase(text=tokens[at].text, pronoun=tokens[at].text), at + 1
        phrase, at = self._determiner(tokens, at)
        is_headed = False
        while at < len(tokens) and not is_headed:
            token = tokens[at]
            ends = token.text in CLOSED and _plain(token.text) not in self._nouns
            if token.is_sign or ends or token.length_m is not None:
                break
            phrase, is_headed = self._with_word(phrase, tokens, at, slot)
            at += 1
        if phrase.nouns and at < len(tokens) and tokens[at].number is not None:
            numbered = f"{phrase.nouns[-1]}_{tokens[at].number}"  # duck 2
            phrase = replace(phrase, nouns=(*phrase.nouns[:-1], numbered))
            at += 1
        text = " ".join(token.text for token in tokens[start:at])
        if not (phrase.colours or phrase.nouns or phrase.every):
            there = " ".join(token.text for token in tokens[max(start - 1, 0) : at + 1])
            message = f"'{printable(there)}' names no object."
            raise GroundingError("unknown_clause", message, candidates=self._of(slot))
        if phrase.nouns == ("everything",) or not (phrase.colours or phrase.nouns):
            phrase = replace(phrase, nouns=("object",))
        return replace(phrase, text=text), at

    def _determiner(self, tokens: Sequence[Token], at: int) -> tuple[NounPhrase, int]:
        """All, any two of the, the five: how many are meant; each of these words comes once."""
        words = [token.text for token in tokens[at : at + 5]] + [""] * 5
        used = 0
        quantifier = words[0] if words[0] in (*ALL, "both", "any", "a", "an") else ""
        used += bool(quantifier)
        if quantifier in ("everything", "a", "an"):
            return NounPhrase(text="", every=quantifier in ALL, loose=quantifier not in ALL), at + 1
        count = self._number(tokens, at + used) if quantifier != "both" else None
        loose = quantifier == "any" or (count is not None and not quantifier)
        used += count is not None
        used += bool(used) and words[used] == "of"
        used += words[used] == "the"
        if count is None and quantifier != "both":
            count = self._number(tokens, at + used)
            used += count is not None
        count = 2 if quantifier == "both" else count
        return NounPhrase(text="", every=quantifier in ALL, count=count, loose=loose), at + used

    def _number(self, tokens: Sequence[Token], at: int) -> int | None:
        """A number of things; "one" may also stand for a noun."""
        if at >= len(tokens):
            return None
        word = tokens[at].text
        following = tokens[at + 1].text if at + 1 < len(tokens) else ""
        if word == "one" and following != "of" and not self._meaning(following):
            return None
        return tokens[at].number if tokens[at].number is not None else NUMBERS.get(word)

    def _with_word(
        self, phrase: NounPhrase, tokens: Sequence[Token], at: int, slot: str
    ) -> tuple[NounPhrase, bool]:
        """One more word, and whether it was the head."""
        word = tokens[at].text
        meaning = self._meaning(word)
        if not meaning:
            known = sorted(self._nouns | set(COLOUR_NAMES) | set(SAME_COLOURS) | set(SIZES))
            message = f"'{printable(word)}' is not known here.{nearest(word, known)}"
            raise GroundingError("unknown_object", message, candidates=self._of(slot))
        if meaning == "colour":
            return replace(phrase, colours=(*phrase.colours, colour_of(word) or word)), False
        if meaning == "size":
            return replace(phrase, sizes=(*phrase.sizes, word)), False
        if meaning == "id":
            return replace(phrase, nouns=(*phrase.nouns, word)), True
        plural = singular(word) != word
        nouns: tuple[str, ...] = (_plain(word),)
        if word in ("one", "ones"):
            nouns = self.memory.nouns.get(slot) or self.memory.nouns.get("theme", ())
        following = tokens[at + 1].text if at + 1 < len(tokens) else ""
        is_headed = self._meaning(following) not in ("noun", "id") or following in TABLES
        return replace(
            phrase,
            nouns=(*phrase.nouns, *nouns),
            every=phrase.every or (plural and phrase.count is None),
        ), is_headed

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
        """Say which things a phrase means.

        Args:
            slot: ``theme``, ``container``, ``support`` or ``reference``: what moves, what it goes
                into or onto, or what is named beside it.
            besides: What moves, where the phrase says where to: meant only if nothing else is.
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
        for names in (_own, _own_or_shape, _any):
            pool = [key for key in things if set(phrase.nouns) <= names(things[key])]
            fitting = [key for key in pool if set(phrase.colours) <= {things[key].colour}]
            fitting = [key for key in fitting if self._has_sizes(key, phrase, pool)]
            if fitting or (pool and names is _own_or_shape):
                return tuple(fitting)
        return ()

    def _has_sizes(self, key: str, phrase: NounPhrase, pool: Sequence[str]) -> bool:
        """Whether a thing is the larger, or the smaller, beside others of its name."""
        sizes = {name: self.vocabulary.things[name].size_m for name in pool}
        volumes = {name: float(np.prod(size)) for name, size in sizes.items() if size is not None}
        if not phrase.sizes:
            return True
        others = [volume for name, volume in volumes.items() if name != key]
        if key not in volumes or not others:
            return False
        mine = volumes[key]
        return all(
            mine > APART * min(others) if SIZES[word] > 0 else APART * mine < max(others)
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
        fresh = [key for key in fitting if key not in self.memory.chosen]
        chosen = tuple((fresh if len(fresh) >= wanted else fitting)[:wanted])
        self.memory.chosen += chosen
        self.memory.choices.append(Choice(count=wanted, among=fitting, chosen=chosen))
        return chosen


def _plain(word: str) -> str:
    single = singular(word)
    return SAME_NOUNS.get(single, single)


def _own(thing: Thing) -> frozenset[str]:
    return thing.own_names | {thing.id.lower()}


def _own_or_shape(thing: Thing) -> frozenset[str]:
    return _own(thing) | {thing.shape}


def _any(thing: Thing) -> frozenset[str]:
    return _own_or_shape(thing) | thing.names


def with_shared_noun(phrases: Sequence[NounPhrase]) -> Iterator[NounPhrase]:
    """The red and the green cubes: the noun at the end belongs to all."""
    last = phrases[-1]
    for phrase in phrases:
        if phrase.nouns or phrase.pronoun or not last.nouns:
            yield phrase
        else:
            yield replace(phrase, nouns=last.nouns, every=phrase.every or last.every)
