"""A small grammar of English: from the words of an instruction to goals, in order.

Words become parts (a verb, a noun phrase, a relation, a length), each a letter, and the letters of
a clause have to fit one pattern. Every word has to be used; nothing is guessed.
"""

import re
from dataclasses import dataclass
from typing import Any

from bridge.task.relations import SIDES
from twin.plan.ground.goals import PLACES, Goals, Grounding
from twin.plan.ground.nouns import NounPhrase, Nouns, with_shared_noun
from twin.plan.ground.vocabulary import GroundingError, Ids, Vocabulary, refuse
from twin.plan.ground.words import CARRIED, NEGATIONS, PHRASES, RELATIONS, VERBS, WAYS, tokens_of

GAP_TOLERANCE_M = 0.005
"""Of a gap that is given by one number."""
MOST_M = 1.5
DIRECTIONS = "directions are as the robot sees them: forwards is away from its base"
NOT_WHICH_WAY = "says how far, and not from what or which way"
_SLOTS = {"inside": "container", "outside": "container", "on": "support"}
_PLACE = r"(?:B?L)?RN(?:GL)?|B?LW|WB?L|U"
_CLAUSE = re.compile(
    rf"(?P<between>[ASTFP]*)(?P<verb>V?)(?P<themes>N(?:S?A?N)*)?(?P<ends>E?)"
    rf"(?P<places>(?:P*(?:S?A?P*(?:{_PLACE}))*P*))"
)
_PLACES = re.compile(_PLACE)


@dataclass(frozen=True)
class _Part:
    """Some words that belong together."""

    letter: str
    begin: int
    words: str
    phrase: NounPhrase | None
    length_m: tuple[float, float] | None


def ground(text: str, vocabulary: Vocabulary) -> Grounding:
    """Turn an instruction into goals and their order."""
    try:
        return _Reader(text, vocabulary).read()
    except GroundingError as error:
        error.examples = tuple(vocabulary.examples())
        raise


class _Reader:
    """Reads one instruction."""

    def __init__(self, text: str, vocabulary: Vocabulary) -> None:
        self.text, self.tokens, self.vocabulary = text, tokens_of(text), vocabulary
        self.nouns, self.goals = Nouns(vocabulary), Goals(vocabulary)
        self.held: dict[str, str] = {}
        """What was taken and has not been put anywhere, with the words that said so."""

    def read(self) -> Grounding:
        """Read all clauses."""
        self._refuse_words()
        parts = self._parts()
        letters, at, verb = "".join(part.letter for part in parts), 0, ""
        while at < len(parts):
            found = next(_CLAUSE.finditer(letters, at))
            if found.end() == at:
                raise self._unknown(parts[at].begin)
            known = len(self.goals.steps)
            if found.end() > found.end("between"):
                verb = self._clause(found, parts, verb)
            if "T" in found["between"] and 0 < known < len(self.goals.steps):
                self.goals.edges.append((known - 1, known))
                self.goals.is_order_given = True
            at = found.end()
        for key, words in self.held.items():
            message = f"'{words}': say where {key} is to go; holding it is no end."
            refuse("unsupported_verb", message)
        return self.goals.grounding(self.text, self.nouns.explanation, self.nouns.choices)

    def _refuse_words(self) -> None:
        """Words that turn what is said round; whatever they stand beside, it is not read."""
        words = [token.text for token in self.tokens]
        if "or" in words:
            refuse("alternative", "'or' leaves open what is wanted. Say which.")
        no = [w for w in words if w in NEGATIONS or w.startswith("non-") or w.endswith("n't")]
        if no:
            refuse("negated", f"'{no[0]}' says what is not wanted. Say what is.")

    def _parts(self) -> list[_Part]:
        """Cut the words into parts; one that is in none is an error that names it."""
        parts: list[_Part] = []
        at, slot = 0, "theme"
        while at < len(self.tokens):
            begin, token, phrase = at, self.tokens[at], None
            lengths = range(min(5, len(self.tokens) - at), 0, -1)
            fixed = next((n for n in lengths if self._rest(at, n) in PHRASES), 0)
            if fixed or token.length_m is not None:
                letter, at = PHRASES.get(self._rest(at, fixed), "L"), at + (fixed or 1)
            else:
                self._refuse_unread(at, parts)
                phrase, at = self.nouns.read(self.tokens, at, slot)
                letter = "N"
            words = self._rest(begin, at - begin)
            slot = _SLOTS.get(RELATIONS[words], "reference") if letter == "R" else "theme"
            parts.append(_Part(letter, begin, words, phrase, token.length_m))
        return parts

    def _refuse_unread(self, at: int, parts: list[_Part]) -> None:
        """Raise unless a noun phrase may begin here."""
        word, letters = self.tokens[at].text, self.nouns.letters(self.tokens[at:])
        if letters[0] not in "x." or (parts and parts[-1].letter in "VR"):
            return  # a noun, or one that nobody knows
        first = not parts or parts[-1].letter in "ASTFP"
        if re.match(r".[tqbyincs]*[hc]", letters):
            if first:
                refuse("unsupported_verb", f"nobody here can '{word}'.")
            refuse("unsupported_relation", f"the relation '{word}' is not known.")
        if first:
            raise self._unknown(at)
        raise self._unknown(max(0, at - 5), f"is not understood from '{word}' on")

    def _rest(self, start: int, count: int = 6) -> str:
        return " ".join(t.text for t in self.tokens[start : start + count])

    def _unknown(self, start: int, what: str = "is not understood") -> GroundingError:
        return GroundingError("unknown_clause", f"'{self._rest(start)}' {what}.")

    def _clause(self, found: re.Match[str], parts: list[_Part], last_verb: str) -> str:
        """One verb with what it moves, and where to; return the verb."""

        def of(name: str) -> list[_Part]:
            return parts[slice(*found.span(name))]

        start = parts[found.end("between")].begin
        by = "".join(part.words for part in of("verb"))
        verb = "put" if found["ends"] else VERBS.get(by, last_verb)
        if by in CARRIED:
            self.nouns.explanation.append(f"'{by}': it is carried there and let go")
        phrases = [part.phrase for part in of("themes") if part.phrase is not None]
        if not verb or not phrases:
            raise self._unknown(start)
        meant = [self.nouns.resolve(each, "theme") for each in with_shared_noun(phrases)]
        themes = self.nouns.themes = tuple(dict.fromkeys(key for ids in meant for key in ids))
        goals: list[dict[str, Any]] = []
        for place in _PLACES.finditer("".join(part.letter for part in of("places"))):
            goals += self._place(of("places")[slice(*place.span())], themes)
            if goals and goals[-1].get("direction"):
                self.nouns.explanation.append(DIRECTIONS)
        behind = parts[found.end() : found.end() + 1]
        if behind and behind[0].letter not in "ASTFP":
            self._refuse_place(behind[0], parts[found.end() + 1 :], start, themes)
        elif not goals:
            goals = self._without_place(verb, themes, start)
        if verb == "stack" and len(themes) > 1:
            message = f"which of {', '.join(themes)} is to be below? Say one by one."
            refuse("ambiguous_relation", message, themes)
        if goals:
            goals = [{"kind": goal["kind"], "object": k, **goal} for goal in goals for k in themes]
            self.goals.add_clause(goals)
        if any(goal["kind"] in (*PLACES, "outside", "beside") for goal in goals):
            self.held = {key: words for key, words in self.held.items() if key not in themes}
        return verb

    def _refuse_place(self, part: _Part, behind: list[_Part], start: int, themes: Ids) -> None:
        """Say what is wrong where a clause does not go on as any does."""
        if part.letter == "O" and behind:
            message = f"'{self._rest(part.begin, 4)}': into, onto or next to it?"
            refuse("ambiguous_relation", message, ("into", "onto", "next to"))
        if part.letter == "W":
            self.goals.refuse_fixed(themes)
            raise self._unknown(part.begin, "does not say how far: for example '10 cm to the left'")
        if part.letter in "BL":
            raise self._unknown(part.begin, NOT_WHICH_WAY)
        raise self._unknown(start, f"is not understood from '{part.words}' on")

    def _place(self, parts: list[_Part], themes: Ids) -> list[dict[str, Any]]:
        """One relation, movement or remark about the end, without what it is about."""
        of = {part.letter: part for part in parts}
        if "U" in of:
            return [{"kind": "upright"}]
        length_m = of["L"].length_m if "L" in of else None
        if "W" in of and length_m is not None:
            low, high = (round(each, 6) for each in length_m)
            if high > MOST_M:
                message = f"{high:g} m is no distance that the arm can move something."
                refuse("impossible", message, themes)
            far = {"by_m": low} if low == high else {"at_least_m": low, "at_most_m": high}
            return [{"kind": "moved", **far, "direction": WAYS[of["W"].words]}]
        relation, phrase = RELATIONS[of["R"].words], of["N"].phrase
        assert phrase is not None  # noqa: S101  # every N has one
        slot = _SLOTS.get(relation, "reference")
        if slot != "reference" and length_m is not None:
            raise self._unknown(parts[0].begin, NOT_WHICH_WAY)
        if of["R"].words == "from" and self.nouns.is_table(phrase):
            return []  # where it lies now
        ids = self.nouns.resolve(phrase, slot, besides=themes)
        if len(ids) != 1:
            told = self.vocabulary.describe(ids)
            message = f"'{phrase.text}' is more than one thing: {told}. Name one."
            refuse("ambiguous_object", message, ids)
        if slot != "reference":
            return [{"kind": relation, slot: ids[0]}]
        about: dict[str, Any] = {"kind": "beside", "reference": ids[0]}
        if relation in SIDES:
            about["direction"] = relation
        if length_m is not None:
            low, high = length_m
            slack = GAP_TOLERANCE_M if low == high else 0.0
            about["gap_m"] = [round(max(0.0, low - slack), 6), round(high + slack, 6)]
        return [about]

    def _without_place(self, verb: str, themes: Ids, start: int) -> list[dict[str, Any]]:
        """What a clause asks for that says no place."""
        if verb == "take":
            self.held |= dict.fromkeys(themes, self._rest(start))
            return []
        if verb != "pack":
            self.goals.refuse_fixed(themes)
            raise self._unknown(start, "does not say where")
        where = self.vocabulary.containers()
        if len(where) != 1:
            kind = "ambiguous_object" if where else "unknown_object"
            refuse(kind, f"'{self._rest(start)}': into what?", where)
        told = self.vocabulary.describe(where)
        self.nouns.explanation.append(f"packed into {told}: nothing else here can be packed into")
        return [{"kind": "inside", "container": where[0]}]
