"""Noun phrases: how they are read, and which things of the vocabulary they mean."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from bridge.task.check import TABLE
from twin.plan.ground.vocabulary import GroundingError, Thing, Vocabulary
from twin.plan.ground.words import (
    ADVERBS,
    ALTERNATIVES,
    BELONGS,
    CONJUNCTIONS,
    EVERYTHING,
    EXTRA_COLOURS,
    NEGATIONS,
    NUMBER,
    NUMBERS,
    PRONOUNS,
    QUANTIFIERS,
    RELATIONS,
    SELECTORS,
    VIEWS,
    WAYS,
    WORD,
    Phrases,
    Token,
    word_set,
)
from twin.scene.semantics.language import (
    ANY_THING,
    KIND_NAMES,
    SAME_NOUNS,
    SIZES,
    colour_of,
    part_of,
    singular,
)

BREAKS = word_set(
    "of with out while without keeping keep staying stay until till avoiding avoid but then "
    "before after afterwards finally remain remaining never not do does to than where which that "
    "so such as making holding during both once when if unless or except using"
)
"""Words that no noun phrase goes on with."""
TABLE_NAMES = frozenset({"table", "tabletop", "desk", "surface", "workbench", "worktop", "ground"})
GENERIC = frozenset(ANY_THING) | {name for names in KIND_NAMES.values() for name in names}
"""Nouns that say what kind of thing is meant, and are nobody's own name."""
MATCHING = Phrases(
    dict.fromkeys(
        [
            f"{before} {own}{colour}".replace("  ", " ")
            for before in ("of", "with", "of the", "with the", "of its", "of their", "of a")
            for own in ("same ", "own ", "matching ", "corresponding ", "respective ", "")
            for colour in ("colour", "color", "colours", "colors")
        ]
        + [
            f"that {verb} {of}{colour}"
            for verb in ("matches", "has", "is of", "fits", "shares")
            for of in ("its ", "the same ", "their ")
            for colour in ("colour", "color")
        ],
        "matching",
    )
)
SAME_COLOURED = word_set(
    "matching same-coloured same-colored like-coloured corresponding respective own "
    "colour-matched same-colour same-color"
)
SLOTS = ("theme", "container", "support", "reference")
"""What a phrase is asked for: what moves, what it goes into, onto, or what is named beside it."""


@dataclass(frozen=True, kw_only=True)
class NounPhrase:
    """A noun phrase as it was said."""

    text: str
    words: tuple[str, ...] = ()
    """Adjectives and nouns, singular, the head last."""
    quantifier: str = ""
    count: int | None = None
    plural: bool = False
    pronoun: str = ""
    is_one: bool = False
    """Its noun is "one": the last noun is meant."""
    part: str = ""
    """Which part of the thing."""
    number: int | None = None
    """As in "duck 2"."""
    matching: bool = False
    """The one of the same colour."""
    excluded: "NounPhrase | None" = None

    @property
    def has_noun(self) -> bool:
        """Whether more than colours and sizes are said."""
        return any(colour_of(word) is None and word not in SIZES for word in self.words)


@dataclass(frozen=True, kw_only=True)
class Choice:
    """Any of several were asked for, and these were taken: the planner's choice."""

    count: int
    among: tuple[str, ...]
    chosen: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Resolved:
    """What a noun phrase means."""

    ids: tuple[str, ...]
    part: str = ""
    choice: Choice | None = None


@dataclass
class Memory:
    """What has been spoken of before."""

    themes: tuple[str, ...] = ()
    """What the last clause moves."""
    mentioned: list[str] = field(default_factory=list)
    nouns: dict[str, tuple[str, ...]] = field(default_factory=dict)
    """Nouns of the last phrase that had one, by its slot."""
    words: tuple[str, ...] = ()
    """All words of the last phrase that named what moves."""
    placed: list[str] = field(default_factory=list)
    """What has got a goal."""
    remarks: list[str] = field(default_factory=list)
    explanation: list[str] = field(default_factory=list)
    choices: list[Choice] = field(default_factory=list)


def begins_other(tokens: Sequence[Token], at: int, *, inside: bool) -> bool:
    """Whether something begins here that belongs to no noun phrase.

    Args:
        tokens: The instruction.
        at: Where.
        inside: Some words of the phrase have been read; adjectives like "left" may come first.
    """
    if at >= len(tokens) or tokens[at].kind != WORD:
        return True
    word = tokens[at].text
    if inside and word in ("the", "a", "an", "this", "these", "those", "my", "your", "it", "them"):
        return True
    if word in BREAKS or word in ALTERNATIVES or word in NEGATIONS or word == "'s":
        return True
    if RELATIONS.match(tokens, at) or CONJUNCTIONS.match(tokens, at) or VIEWS.match(tokens, at):
        return not (not inside and word in SELECTORS)
    if WAYS.match(tokens, at) or ADVERBS.match(tokens, at) or BELONGS.match(tokens, at):
        return inside or not (at + 1 < len(tokens) and tokens[at + 1].kind == WORD)
    return False


def read(tokens: Sequence[Token], at: int) -> tuple[NounPhrase, int] | None:
    """Read the noun phrase that begins here; None: there is none."""
    start = at
    if at >= len(tokens):
        return None
    word = tokens[at].text
    if word in PRONOUNS or (word in ("this", "that", "these", "those") and _ends(tokens, at + 1)):
        return NounPhrase(text=word, pronoun=word), at + 1
    if word in EVERYTHING:
        phrase = NounPhrase(text=word, words=("object",), quantifier="all", plural=True)
        return _excepting(phrase, tokens, at + 1)
    quantifier, count, at = _determiners(tokens, at)
    words: list[str] = []
    while not begins_other(tokens, at, inside=bool(words)) and len(words) < 12:
        words.append(tokens[at].text)
        at += 1
    plural = bool(words) and _is_plural(words[-1])
    spoken = {token.text for token in tokens[start:at]}
    plural = plural or (quantifier == "other" and bool(spoken & {"others", "rest", "remaining"}))
    is_one = bool(words) and words[-1] in ("one", "ones")
    if is_one:
        plural = words.pop() == "ones" or plural
        quantifier = quantifier or ("a" if not words and not plural else "")
    phrase = NounPhrase(
        text=_text(tokens, start, at),
        words=tuple(_plain(word) for word in words if word not in ("coloured", "colored")),
        quantifier=quantifier,
        count=count,
        plural=plural,
        is_one=is_one,
    )
    if not words and not is_one and count is None and quantifier not in ("all", "both", "other"):
        return None
    return _after(phrase, tokens, start, at)


def _determiners(tokens: Sequence[Token], at: int) -> tuple[str, int | None, int]:
    """Quantifier, number, and where the words begin."""
    quantifier, count = "", None
    while (found := QUANTIFIERS.match(tokens, at)) is not None:
        meaning, behind = found
        if meaning.isdigit():
            count = int(meaning)
        elif not quantifier or quantifier == "a" or meaning not in ("the", "a"):
            quantifier = meaning
        at = behind
    for skipped in ("exactly", "only", "just"):
        at += at < len(tokens) and tokens[at].text == skipped
    if count is None and at < len(tokens):
        token = tokens[at]
        follows = at + 1 < len(tokens) and (
            tokens[at + 1].text == "of" or not begins_other(tokens, at + 1, inside=False)
        )
        if token.kind == NUMBER:
            count = int(token.value[0]) if token.value[0].is_integer() else -1
        elif token.text in NUMBERS and (follows or token.text != "one"):
            count = NUMBERS[token.text]
        if count is not None:
            at += 1
            if at < len(tokens) and tokens[at].text == "of":
                quantifier = "any"
                found = QUANTIFIERS.match(tokens, at + 1)
                at = found[1] if found else at + 1
    return quantifier, count, at


def _after(
    phrase: NounPhrase, tokens: Sequence[Token], start: int, at: int
) -> tuple[NounPhrase, int]:
    """What may follow the words: a number, an owner or its part, the colour, exceptions."""
    number_at = at + (at < len(tokens) and tokens[at].text in ("number", "no"))
    if number_at < len(tokens) and tokens[number_at].kind == NUMBER and phrase.words:
        phrase = replace(phrase, number=int(tokens[number_at].value[0]), plural=False)
        at = number_at + 1
    if phrase.words and phrase.words[-1] == "number":  # "duck number two"
        number = NUMBERS.get(tokens[at].text) if at < len(tokens) else None
        if number is not None:
            phrase = replace(phrase, number=number, words=phrase.words[:-1], plural=False)
            at += 1
    if at < len(tokens) and tokens[at].text in ("'s", "'"):
        owned = read(tokens, at + 1)
        if owned is not None and owned[0].words and part_of(owned[0].words[-1]):
            named = part_of(owned[0].words[-1]) or ""
            phrase = replace(phrase, part=named, text=_text(tokens, start, owned[1]))
            return phrase, owned[1]
    if (found := MATCHING.match(tokens, at)) is not None:
        phrase = replace(phrase, matching=True, text=_text(tokens, start, found[1]))
        at = found[1]
    part = part_of(phrase.words[-1]) if phrase.words else None
    if part and at < len(tokens) and tokens[at].text == "of":
        owner = read(tokens, at + 1)
        if owner is not None:
            return replace(owner[0], part=part, text=_text(tokens, start, owner[1])), owner[1]
    return _excepting(phrase, tokens, at)


_EXCEPT = Phrases(dict.fromkeys(("except", "except for", "but not", "other than", "excluding"), ""))


def _excepting(phrase: NounPhrase, tokens: Sequence[Token], at: int) -> tuple[NounPhrase, int]:
    found = _EXCEPT.match(tokens, at)
    left_out = read(tokens, found[1]) if found else None
    if left_out is None:
        return phrase, at
    return replace(phrase, excluded=left_out[0]), left_out[1]


def _ends(tokens: Sequence[Token], at: int) -> bool:
    return begins_other(tokens, at, inside=True)


def _text(tokens: Sequence[Token], start: int, end: int) -> str:
    return " ".join(token.text for token in tokens[start:end]).replace(" 's", "'s")


def _plain(word: str) -> str:
    for ending in ("-coloured", "-colored"):
        if word.endswith(ending) and colour_of(word.removesuffix(ending)):
            return word.removesuffix(ending)
    single = singular(word)
    return SAME_NOUNS.get(single, single)


def _is_plural(word: str) -> bool:
    return singular(word) != word


def with_shared_noun(phrases: Sequence[NounPhrase]) -> list[NounPhrase]:
    """The red and the green cubes: the noun at the end belongs to all."""
    shared = list(phrases)
    for index in range(len(shared) - 2, -1, -1):
        phrase, after = shared[index], shared[index + 1]
        lacks = bool(phrase.words) and not phrase.has_noun
        if lacks and not phrase.is_one and not phrase.pronoun and after.has_noun:
            nouns = tuple(word for word in after.words if colour_of(word) is None)
            plural = phrase.plural or after.plural
            shared[index] = replace(phrase, words=(*phrase.words, *nouns), plural=plural)
    if shared and shared[0].quantifier == "all":
        shared = [p if p.quantifier else replace(p, quantifier="all") for p in shared]
    return shared


class Resolver:
    """Finds what noun phrases mean among the things of a vocabulary."""

    def __init__(self, vocabulary: Vocabulary, memory: Memory) -> None:
        """Read the nouns of the vocabulary once.

        Args:
            vocabulary: What there is.
            memory: What has been spoken of; it is written to.
        """
        self.vocabulary = vocabulary
        self.memory = memory
        self._nouns = vocabulary.nouns() | TABLE_NAMES

    def resolve(self, phrase: NounPhrase, slot: str, *, besides: Sequence[str] = ()) -> Resolved:
        """Say which things a phrase means.

        Args:
            phrase: As it was read.
            slot: One of ``SLOTS``.
            besides: Ids that it cannot mean: what is to be put beside it.

        Raises:
            GroundingError: When nothing fits, too little, or more than one thing.
        """
        if phrase.pronoun:
            return self._pronoun(phrase, slot, besides)
        if (phrase.is_one or phrase.quantifier == "other") and not phrase.has_noun:
            phrase = self._with_noun(phrase, slot)
        if slot == "support" and phrase.words and phrase.words[-1] in TABLE_NAMES:
            return Resolved(ids=(TABLE,))
        self._refuse_unknown(phrase, slot)
        fitting = self._fitting(phrase)
        if not fitting:
            self._refuse_unfitting(phrase, slot)
        if slot == "theme" and phrase.quantifier == "all" and phrase.words == ("object",):
            fitting = tuple(key for key in fitting if self.vocabulary.things[key].movable)
            if not fitting:
                message = f"'{phrase.text}': nothing is left that can be moved."
                raise GroundingError("too_few_objects", message, candidates=self._of(slot))
        fitting = self._suited(fitting, slot, besides)
        if phrase.has_noun:
            self.memory.nouns[slot] = tuple(
                word for word in phrase.words if colour_of(word) is None and word in self._nouns
            )
            self.memory.words = phrase.words if slot == "theme" else self.memory.words
        chosen = self._counted(phrase, fitting, slot)
        part = self._part(phrase, chosen.ids)
        self._explain(phrase, chosen)
        self.memory.mentioned += [key for key in chosen.ids if key not in self.memory.mentioned]
        return replace(chosen, part=part)

    def _with_noun(self, phrase: NounPhrase, slot: str) -> NounPhrase:
        """Give "the green one" the noun that was said before."""
        nouns = self.memory.nouns
        if phrase.quantifier == "other" and not phrase.words and slot == "theme":
            same = replace(phrase, words=self.memory.words or ("object",))
            return same if self._fitting(same) else replace(same, words=nouns.get(slot, ()))
        slots = (slot,) if slot == "theme" else (slot, "theme") if slot == "container" else SLOTS
        tried = [replace(phrase, words=(*phrase.words, *nouns[s])) for s in slots if s in nouns]
        if not tried and phrase.words:
            return replace(phrase, words=(*phrase.words, "object"))
        if not tried:
            message = f"'{phrase.text}' stands for no noun that was said before."
            raise GroundingError("ambiguous_object", message, candidates=self._of(slot))
        return next((one for one in tried if self._fitting(one)), tried[0])

    def _of(self, slot: str) -> tuple[str, ...]:
        if slot == "theme":
            return self.vocabulary.movable()
        if slot == "container":
            return self.vocabulary.containers()
        return tuple(self.vocabulary.things)

    def _pronoun(self, phrase: NounPhrase, slot: str, besides: Sequence[str]) -> Resolved:
        memory = self.memory
        single = phrase.pronoun in ("it", "itself")
        if phrase.pronoun in ("itself", "themselves") and besides:
            message = f"{self.vocabulary.describe(besides)} cannot stand in a relation to itself."
            raise GroundingError("impossible", message, candidates=besides)
        known = phrase.pronoun in PRONOUNS
        if slot == "theme":
            meant = memory.themes if known else ()
        else:
            meant = tuple(key for key in memory.mentioned if key not in besides) if known else ()
        if not meant or (single and len(meant) > 1):
            among = meant or self._of(slot)
            message = f"it is not clear what '{phrase.text}' stands for. Name the object."
            raise GroundingError("ambiguous_object", message, candidates=among)
        if not single and len(meant) == 1 and slot == "theme":
            memory.remarks.append(f"'{phrase.text}' is {meant[0]} alone")
        memory.explanation.append(f"'{phrase.text}' is {', '.join(meant)}, named before")
        return Resolved(ids=meant)

    def _refuse_unknown(self, phrase: NounPhrase, slot: str) -> None:
        """Raise where the head is no known noun; pass adjectives over with a remark."""
        *modifiers, head = phrase.words or ("object",)
        if any(word.startswith("non-") for word in phrase.words):
            message = f"'{phrase.text}' says what is not meant. Say what is."
            raise GroundingError("negated", message)
        is_id = any(key.lower() == head for key in self.vocabulary.things)
        known = head in self._nouns or head in SIZES or colour_of(head) is not None
        if (not known and not is_id) or head in EXTRA_COLOURS or head in TABLE_NAMES:
            near = self.vocabulary.nearest(head)
            message = f"'{phrase.text}': there is no {head} here.{near}"
            raise GroundingError("unknown_object", message, candidates=self._of(slot))
        odd = [word for word in modifiers if not self._is_known(word)]
        if any(word in EXTRA_COLOURS for word in odd):
            message = f"'{phrase.text}': nothing here is of that colour."
            raise GroundingError("unknown_object", message, candidates=self._of(slot))
        if odd:
            self.memory.remarks.append(f"not understood, and passed over: {', '.join(odd)}")

    def _is_known(self, word: str) -> bool:
        return (
            word in self._nouns
            or word in SIZES
            or word in SELECTORS
            or word in SAME_COLOURED
            or colour_of(word) is not None
        )

    def _fitting(self, phrase: NounPhrase) -> tuple[str, ...]:
        things = self.vocabulary.things
        exact = [key for key in things if phrase.words and key.lower() == phrase.words[-1]]
        if exact and len(phrase.words) == 1 and "_" in exact[0]:
            return tuple(exact)
        words = phrase.words or ("object",)
        nouns = {
            word
            for word in words
            if word in self._nouns and (colour_of(word) is None or self._names(word))
        }
        pool = tuple(key for key, thing in things.items() if nouns <= thing.own_names)
        if not pool or not nouns or nouns <= GENERIC:
            pool = tuple(key for key, thing in things.items() if nouns <= thing.names)
        fitting = [
            key for key in pool if all(self._has(things[key], word, nouns) for word in words)
        ]
        if phrase.number is not None:
            fitting = [key for key in fitting if key.rpartition("_")[2] == str(phrase.number)]
        if phrase.excluded is not None:
            out = self._excluded(phrase.excluded)
            fitting = [key for key in fitting if key not in out]
        if phrase.quantifier == "other":
            fitting = [key for key in fitting if key not in self.memory.placed]
        return tuple(fitting)

    def _names(self, word: str) -> bool:
        return any(word in thing.names for thing in self.vocabulary.things.values())

    def _excluded(self, phrase: NounPhrase) -> tuple[str, ...]:
        if phrase.is_one and not phrase.has_noun:
            phrase = self._with_noun(phrase, "theme")
        self._refuse_unknown(phrase, "theme")
        out = self._fitting(phrase)
        if not out:
            self._refuse_unfitting(phrase, "theme")
        if len(out) > 1 and not phrase.plural:
            message = f"'{phrase.text}' fits several objects."
            raise GroundingError("ambiguous_object", message, candidates=out)
        return out

    def _has(self, thing: Thing, word: str, nouns: set[str]) -> bool:
        colour = colour_of(word)
        if word in nouns:
            return True
        if colour is not None:
            return thing.colour == colour
        return word not in SIZES or self._has_size(thing, word)

    def _has_size(self, thing: Thing, word: str) -> bool:
        """Sizes compare a thing with the median of those whose size is known."""
        if word in ("open", "flat"):
            return word in thing.own_names or word in thing.label or thing.container
        if thing.size_m is None:
            return True
        if word == "tall":
            return thing.size_m[2] > 1.2 * max(thing.size_m[:2])
        kind = [other for other in self.vocabulary.things.values() if other.size_m is not None]
        alike = [other for other in kind if other.own_names & thing.own_names] or kind
        among = alike if len(alike) > 1 else kind
        middle = float(np.median([np.prod(other.size_m) for other in among if other.size_m]))
        volume = float(np.prod(thing.size_m))
        return volume < 0.8 * middle if word in ("small", "little", "tiny") else volume > middle

    def _refuse_unfitting(self, phrase: NounPhrase, slot: str) -> None:
        there = self._of(slot)
        what = " ".join(phrase.words) or phrase.text
        if phrase.number is not None:
            what += f" {phrase.number}"
        if phrase.quantifier == "other":
            message = f"'{phrase.text}': nothing else of that kind is left."
            raise GroundingError("too_few_objects", message, candidates=there)
        message = f"'{phrase.text}': there is no {what} here."
        raise GroundingError("unknown_object", message, candidates=there)

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

    def _counted(self, phrase: NounPhrase, fitting: tuple[str, ...], slot: str) -> Resolved:
        """How many of those that fit are meant, and which."""
        told, many = self.vocabulary.describe(fitting), len(fitting)
        count = phrase.count
        if phrase.quantifier == "vague" or (count is not None and count < 1):
            message = f"'{phrase.text}': say how many are meant."
            raise GroundingError("ambiguous_object", message, candidates=fitting)
        count = 2 if phrase.quantifier == "both" and count is None else count
        if count is not None and count > many:
            message = f"'{phrase.text}': there are only {many}: {told}."
            raise GroundingError("too_few_objects", message, candidates=fitting)
        every = phrase.quantifier == "all" or phrase.plural
        if phrase.matching or (count is None and every) or many == (count or 1):
            return Resolved(ids=fitting)
        picks = set(phrase.words) & SELECTORS
        loose = phrase.quantifier in ("any", "a") or (count is not None and not phrase.quantifier)
        if not loose or picks or slot != "theme":
            message = f"'{phrase.text}' fits {many} objects: {told}. Say which is meant."
            raise GroundingError("ambiguous_object", message, candidates=fitting)
        fresh = tuple(key for key in fitting if key not in self.memory.placed)
        chosen = (fresh if len(fresh) >= (count or 1) else fitting)[: count or 1]
        choice = Choice(count=len(chosen), among=fitting, chosen=chosen)
        self.memory.choices.append(choice)
        return Resolved(ids=chosen, choice=choice)

    def _part(self, phrase: NounPhrase, ids: tuple[str, ...]) -> str:
        if not phrase.part:
            return ""
        for key in ids:
            known = self.vocabulary.things[key].known_parts
            if phrase.part not in known:
                listed = ", ".join(known) or "none"
                message = f"'{phrase.text}': {key} has no part {phrase.part}; it has {listed}."
                raise GroundingError("no_such_part", message, candidates=ids)
        return phrase.part

    def _explain(self, phrase: NounPhrase, chosen: Resolved) -> None:
        told = self.vocabulary.describe(chosen.ids)
        if chosen.choice is not None:
            among = ", ".join(chosen.choice.among)
            why = f"any {chosen.choice.count} of {among}: the first ones, the planner's choice"
        elif len(chosen.ids) > 1:
            why = "all that fit"
        else:
            why = "the only one that fits"
        self.memory.explanation.append(f"'{phrase.text}' is {told}: {why}")
