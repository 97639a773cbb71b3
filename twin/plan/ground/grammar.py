"""A small grammar of English: from the words of an instruction to goals, in order.

An instruction is cut into words, read from left to right once, clause by clause, and every word has
to be used: one that is not is an error that names it. Nothing is guessed.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from bridge.task.relations import SIDES
from twin.plan.ground.goals import PLACES, Goals, Grounding, ordered
from twin.plan.ground.nouns import Memory, NounPhrase, Nouns, with_shared_noun
from twin.plan.ground.vocabulary import GroundingError, Vocabulary
from twin.plan.ground.words import (
    CARRIED,
    ENDS_THERE,
    GAP,
    KNOWN,
    NEGATIONS,
    POLITE,
    RELATIONS,
    SIGNS,
    THEN,
    UNSUPPORTED_RELATIONS,
    UNSUPPORTED_VERBS,
    VERBS,
    WAYS,
    printable,
    tokens_of,
)

GAP_TOLERANCE_M = 0.005
"""Of a gap that is given by one number."""
MOST_M = 1.5
_SLOTS = {"inside": "container", "outside": "container", "on": "support"}


def ground(text: str, vocabulary: Vocabulary) -> Grounding:
    """Turn an instruction into goals and their order."""
    return _Reader(text, vocabulary).read()


@dataclass(kw_only=True)
class _Clause:
    """One verb with what it moves, and where to."""

    verb: str
    themes: tuple[str, ...]
    goals: list[dict[str, Any]] = field(default_factory=list)

    def add(self, kind: str, **about: Any) -> None:
        """Ask for one relation of everything that is moved."""
        self.goals += [{"kind": kind, "object": key, **about} for key in self.themes]


class _Reader:
    """Reads one instruction."""

    def __init__(self, text: str, vocabulary: Vocabulary) -> None:
        self.tokens, self.at = tokens_of(text), 0
        self.vocabulary, self.memory = vocabulary, Memory()
        self.nouns, self.goals = Nouns(vocabulary, self.memory), Goals(vocabulary)
        self.text, self.verb = text, ""
        self.held: dict[str, str] = {}
        """What was taken and has not been put anywhere, with the words that said so."""

    def read(self) -> Grounding:
        """Read all clauses."""
        self._refuse_words()
        while True:
            is_then = self._between()
            if self.at == len(self.tokens):
                break
            known = len(self.goals.steps)
            self._clause()
            if is_then and 0 < known < len(self.goals.steps):
                self.goals.edges.append((known - 1, known))
                self.goals.is_order_given = True
        for key, words in self.held.items():
            message = f"'{words}': say where {key} is to go; holding it is no end."
            raise GroundingError("unsupported_verb", message)
        found = self.goals.checked()
        if not found:
            raise GroundingError("empty", f"the instruction asks for nothing. {KNOWN}")
        return Grounding(
            text=self.text,
            goals=tuple(found),
            order=ordered(self.goals, found),
            is_order_given=self.goals.is_order_given,
            choices=tuple(self.memory.choices),
            explanation=tuple(dict.fromkeys(self.memory.explanation)),
        )

    def _refuse_words(self) -> None:
        """Words that turn what is said round; whatever they stand beside, it is not read."""
        words = [token.text for token in self.tokens]
        if "or" in words:
            raise GroundingError("alternative", "'or' leaves open what is wanted. Say which.")
        no = [w for w in words if w in NEGATIONS or w.startswith("non-") or w.endswith("n't")]
        if no:
            message = f"'{printable(no[0])}' says what is not wanted. Say what is."
            raise GroundingError("negated", message)

    def _match(self, phrases: Iterable[str]) -> str:
        """The longest of these phrases that begins here, and go on behind it; empty: none."""
        for length in (5, 4, 3, 2, 1):
            words = self.tokens[self.at : self.at + length]
            phrase = " ".join(token.text for token in words)
            if len(words) == length and phrase in phrases:
                self.at += length
                return phrase
        return ""

    def _rest(self, start: int, count: int = 6) -> str:
        return printable(" ".join(token.text for token in self.tokens[start : start + count]))

    def _unknown(self, start: int, what: str = "is not understood") -> GroundingError:
        message = f"'{self._rest(start)}' {what}. {KNOWN}"
        return GroundingError("unknown_clause", message)

    def _word(self) -> str:
        """The word that comes next; empty at the end."""
        return self.tokens[self.at].text if self.at < len(self.tokens) else ""

    def _between(self) -> bool:
        """Skip what divides clauses; say whether one is to come after the other."""
        is_then, start = False, -1
        while self.at != start:
            start = self.at
            if self._word() in SIGNS:
                self.at += 1
            is_then |= bool(self._match(THEN))
            self._match(("and", "first", *POLITE))
        return is_then

    def _clause(self) -> None:
        start = self.at
        word = self._match(VERBS)
        verb = VERBS.get(word, "")
        if word in CARRIED:
            self.memory.explanation.append(f"'{word}': it is carried there and let go")
        if not verb:
            self._refuse_verb()
            verb = self.verb
        clause = _Clause(verb=verb, themes=self._themes())
        self.memory.themes = clause.themes
        if self._match(ENDS_THERE):
            clause.verb = "put"
        if not clause.verb:
            raise self._unknown(start)
        self._places(clause, start)
        self._close(clause, start)
        self.verb = verb or clause.verb

    def _refuse_verb(self) -> None:
        """Raise unless a clause without a verb may begin here."""
        here = self.tokens[self.at]
        behind = self.tokens[self.at + 1 :]
        is_unknown = not self.nouns.is_one(here.text)
        if here.text in UNSUPPORTED_VERBS or (
            is_unknown and behind and behind[0].text == "the" and self._names_thing(self.at + 1)
        ):
            message = f"nobody here can '{printable(here.text)}'. {KNOWN}"
            raise GroundingError("unsupported_verb", message)
        if is_unknown:
            raise self._unknown(self.at)

    def _names_thing(self, at: int) -> bool:
        try:
            phrase, _ = self.nouns.read(self.tokens, at, "theme")
        except GroundingError:
            return False
        return bool(self.nouns.fitting(phrase))

    def _themes(self) -> tuple[str, ...]:
        """What is moved: one phrase, or several with "and" between."""
        phrase, self.at = self.nouns.read(self.tokens, self.at, "theme")
        phrases = [phrase]
        while self._joins_noun():
            phrase, self.at = self.nouns.read(self.tokens, self.at, "theme")
            phrases.append(phrase)
        meant = [self.nouns.resolve(each, "theme") for each in with_shared_noun(phrases)]
        return tuple(dict.fromkeys(key for ids in meant for key in ids))

    def _joins_noun(self) -> bool:
        """Whether a comma or "and", and then another noun phrase, come next; skips the former."""
        start = self.at
        if self._word() == ",":
            self.at += 1
        self._match(("and",))
        if self.at > start and self.nouns.is_one(self._word()):
            return True
        self.at = start
        return False

    def _places(self, clause: _Clause, start: int) -> None:
        """Read where everything goes, until the clause ends."""
        while self._word() and not self._ends():
            before = self.at
            self._place(clause)
            self._match(POLITE)
            if self.at == before:
                raise self._unknown(start, f"is not understood from '{self._rest(before, 1)}' on")
            joined = self.at
            self.at += self._word() == ","
            self._match(("and",))
            if not self._begins_place():
                self.at = joined

    def _ends(self) -> bool:
        here = self.at
        ended = self.tokens[here].is_sign or bool(self._match(("and", *THEN)))
        self.at = here
        return ended

    def _begins_place(self) -> bool:
        here = self.at
        begins = bool(self._match((*RELATIONS, *WAYS, "upright")))
        self.at = here
        return begins

    def _place(self, clause: _Clause) -> None:
        """One relation, movement or remark about the end."""
        length = self._length()
        relation = RELATIONS.get(self._match(RELATIONS), "")
        if relation in SIDES or relation == "beside":
            return self._beside(clause, relation, length)
        way = "" if relation else WAYS.get(self._match(WAYS), "")
        if way:
            return self._moved(clause, way, length or self._length())
        if length is not None:
            raise self._unknown(self.at - 1, "says how far, and not from what or which way")
        if relation:
            return self._relation(clause, relation)
        if self._match(("upright",)):
            return clause.add("upright")
        here = self.tokens[self.at].text
        if here == "to" and self.at + 1 < len(self.tokens):
            message = f"'{self._rest(self.at, 4)}': into, onto or next to it?"
            candidates = ("into", "onto", "next to")
            raise GroundingError("ambiguous_relation", message, candidates=candidates)
        if here in UNSUPPORTED_RELATIONS:
            message = f"the relation '{here}' is not known. {KNOWN}"
            raise GroundingError("unsupported_relation", message)
        return None

    def _length(self) -> tuple[float, float] | None:
        """A length, with or without "by" before it."""
        at = self.at + (self._word() == "by")
        found = self.tokens[at].length_m if at < len(self.tokens) else None
        self.at = self.at if found is None else at + 1
        return found

    def _one(self, clause: _Clause, slot: str) -> str:
        """The one thing that a relation is to."""
        phrase, self.at = self.nouns.read(self.tokens, self.at, slot)
        return self._single(phrase, clause, slot)

    def _single(self, phrase: NounPhrase, clause: _Clause, slot: str) -> str:
        ids = self.nouns.resolve(phrase, slot, besides=clause.themes)
        if len(ids) != 1:
            told = self.vocabulary.describe(ids)
            message = f"'{phrase.text}' is more than one thing: {told}. Name one."
            raise GroundingError("ambiguous_object", message, candidates=ids)
        return ids[0]

    def _relation(self, clause: _Clause, relation: str) -> None:
        slot = _SLOTS[relation]
        source = self.tokens[self.at - 1].text
        phrase, self.at = self.nouns.read(self.tokens, self.at, slot)
        if source == "from" and self.nouns.is_table(phrase):
            return  # where it lies now
        clause.add(relation, **{slot: self._single(phrase, clause, slot)})

    def _beside(self, clause: _Clause, relation: str, length: tuple[float, float] | None) -> None:
        about: dict[str, Any] = {"reference": self._one(clause, "reference")}
        if relation in SIDES:
            about["direction"] = relation
            self._say_directions()
        if self._match(GAP):
            length = self._length()
            if length is None:
                raise self._unknown(self.at - 1, "does not say how large the gap is")
        if length is not None:
            low, high = length
            slack = GAP_TOLERANCE_M if low == high else 0.0
            about["gap_m"] = [round(max(0.0, low - slack), 6), round(high + slack, 6)]
        clause.add("beside", **about)

    def _moved(self, clause: _Clause, way: str, length: tuple[float, float] | None) -> None:
        self._say_directions()
        if length is None:
            self.goals.refuse_fixed(clause.themes)
            raise self._unknown(
                self.at - 1, "does not say how far: for example '10 cm to the left'"
            )
        low, high = (round(each, 6) for each in length)
        if high > MOST_M:
            message = f"{high:g} m is no distance that the arm can move something."
            raise GroundingError("impossible", message, candidates=clause.themes)
        about = {"by_m": low} if low == high else {"at_least_m": low, "at_most_m": high}
        clause.add("moved", **about, direction=way)

    def _say_directions(self) -> None:
        told = "directions are as the robot sees them: forwards is away from its base"
        self.memory.explanation.append(told)

    def _close(self, clause: _Clause, start: int) -> None:
        """Take over the goals of a clause that is read to its end."""
        if not clause.goals and clause.verb == "pack":
            clause.add("inside", container=self._only_container(start))
        elif not clause.goals and clause.verb == "take":
            self.held |= dict.fromkeys(clause.themes, self._rest(start))
            return
        elif not clause.goals:
            self.goals.refuse_fixed(clause.themes)
            raise self._unknown(start, "does not say where")
        if clause.verb == "stack" and len(clause.themes) > 1:
            message = f"which of {', '.join(clause.themes)} is to be below? Say one by one."
            raise GroundingError("ambiguous_relation", message, candidates=clause.themes)
        self.goals.add_clause(clause.goals)
        for key in clause.themes:
            if any(goal["kind"] in (*PLACES, "outside", "beside") for goal in clause.goals):
                self.held.pop(key, None)

    def _only_container(self, start: int) -> str:
        where = self.vocabulary.containers()
        if len(where) != 1:
            message = f"'{self._rest(start)}': into what?"
            kind = "ambiguous_object" if where else "unknown_object"
            raise GroundingError(kind, message, candidates=where)
        told = (
            f"packed into {self.vocabulary.describe(where)}: nothing else here can be packed into"
        )
        self.memory.explanation.append(told)
        return where[0]
