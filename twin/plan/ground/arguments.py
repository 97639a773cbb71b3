"""What is said of the objects of a clause: relations, movements, gaps, views, manner.

A relation or a movement becomes success predicates of the clause's objects; a manner or a limit
holds on the way.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from bridge.task.check import TABLE
from bridge.task.relations import SIDES
from twin.plan.ground import noun_phrases
from twin.plan.ground.goals import Goals, PathLimit
from twin.plan.ground.noun_phrases import SAME_COLOURED, Memory, NounPhrase, Resolver
from twin.plan.ground.path_clauses import LIMITS, SLOW_M_S, PathReader
from twin.plan.ground.vocabulary import GroundingError, Vocabulary
from twin.plan.ground.words import (
    A_LITTLE,
    ABOUT,
    ADVERBS,
    ALTERNATIVES,
    COMMA,
    CONDITIONS,
    CONJUNCTIONS,
    GAP_WORDS,
    GAPS,
    LAYERS,
    LENGTH,
    NEGATIONS,
    RELATIONS,
    STOP,
    VERBS,
    VIEWS,
    WAYS,
    WORD,
    Phrases,
    printable,
    tokens_of,
)
from twin.scene.semantics.language import part_of

GAP_TOLERANCE_M = 0.01
"""Of a gap that is said as one number."""
LEAST_MOVE_M = 0.05
"""Of something that is to move in a direction, where nobody says how far."""
PARTICLES = frozenset({"up", "down", "over", "back", "out", "away", "off", "together"})
COLOURS = frozenset({"colour", "color", "colours", "colors"})
VIEWERS = frozenset({"camera", "cam", "view", "viewpoint", "perspective", "image", "side"})
ROBOTS = frozenset({"robot", "arm", "your", "base", "robot's", "yourself"})
ITS_SIDES = {"its left": "left", "its right": "right"}
ANY = "*"
"""Stands for objects that are named later."""


@dataclass
class Clause:
    """What one clause has said so far."""

    verb: str
    themes: tuple[str, ...]
    goals: list[dict[str, Any]] = field(default_factory=list)
    sources: list[str] = field(default_factory=list)
    """Containers that something is taken from, where it is not yet known to be a goal."""
    view: str = ""
    """A camera by which directions are said."""

    def add(self, kind: str, **about: Any) -> None:
        """Ask the same of each theme."""
        self.goals += [{"kind": kind, "object": key, **about} for key in self.themes]

    @property
    def destination(self) -> str:
        """What the themes are put into, onto or beside."""
        for goal in self.goals:
            for key in ("container", "support", "reference", "first"):
                if key in goal and goal["kind"] != "outside":
                    return str(goal[key])
        return ""


class ArgumentReader:
    """Reads what follows the objects of a clause; the whole state of one instruction is here."""

    def __init__(self, text: str, vocabulary: Vocabulary) -> None:
        """Cut it into words.

        Args:
            text: The instruction.
            vocabulary: What there is.
        """
        self.text = " ".join(text.split())
        self.tokens = tokens_of(text)
        self.vocabulary = vocabulary
        self.memory = Memory()
        self.resolver = Resolver(vocabulary, self.memory)
        self.paths = PathReader(self.tokens, self.resolver)
        self.goals = Goals(vocabulary)
        self.limits: list[PathLimit] = []
        self.parts: dict[str, str] = {}
        self.grasped: dict[str, str] = {}
        """Taken, and not yet put anywhere: by which word."""
        self.verb = ""
        self.destination = ""
        self.manner: list[str] = []
        """Adverbs before a verb, for the objects of its clause."""
        self.at = 0

    def _word(self, ahead: int = 0) -> str:
        at = self.at + ahead
        return self.tokens[at].text if at < len(self.tokens) else ""

    def _kind(self, ahead: int = 0) -> str:
        at = self.at + ahead
        return self.tokens[at].kind if at < len(self.tokens) else "end"

    def _take(self, phrases: Phrases) -> str | None:
        """Read a phrase of a table; its meaning, or None where none is here."""
        found = phrases.match(self.tokens, self.at)
        if found is None:
            return None
        self.at = found[1]
        return found[0]

    def _rest(self, start: int) -> str:
        end = start
        while end < len(self.tokens) and not (
            self.tokens[end].kind == STOP and end > start and self.tokens[end].text != ":"
        ):
            end += 1
        return printable(" ".join(token.text for token in self.tokens[start:end]))

    def _unknown(self, start: int, why: str = "is not understood") -> GroundingError:
        told = self._rest(start)
        return GroundingError("unknown_clause", f"'{told}' {why}.")

    def _refuse_word(self) -> None:
        """Raise where a word is here that the grammar knows and does not take."""
        word = self._word()
        if word in ALTERNATIVES:
            message = f"'{word}': only one thing can be done. Choose."
            raise GroundingError("alternative", message, candidates=self.memory.mentioned)
        if word in NEGATIONS or (
            word in ("do", "does", "must", "should") and self._word(1) == "not"
        ):
            message = (
                f"'{self._rest(self.at)}' says what is not wanted. Say what is to be done instead."
            )
            raise GroundingError("negated", message)
        if word in CONDITIONS:
            message = f"'{self._rest(self.at)}': conditions are not understood. Say what to do."
            raise GroundingError("unknown_clause", message)

    def _arguments(self, clause: Clause) -> None:
        while self.at < len(self.tokens):
            start = self.at
            readers: tuple[Callable[[Clause], bool], ...] = (
                self._view,
                self._part,
                self._length,
                self._gap,
                self._way_or_relation,
                self._adverb,
                self._limit,
            )
            for reader in readers:
                if reader(clause):
                    break
            if self.at == start:
                return

    def _view(self, clause: Clause) -> bool:
        """As seen from a camera, or from the robot."""
        start = self.at
        seen = self._take(VIEWS) is not None
        if not seen:
            if self._word() != "from":
                return False
            self.at += 1
        at = self.at
        words: list[str] = []
        while self._kind() == WORD and len(words) < 8 and self._word() not in ("and", "then"):
            words.append(self._word())
            self.at += 1
        if not seen and not set(words) & {"camera", "view", "perspective", "viewpoint"}:
            self.at = start
            return False
        named = [word for word in words if word not in ("the", "'s", "point", "of", "as", "seen")]
        if set(named) & ROBOTS:
            self.memory.explanation.append("directions are said as the robot sees them")
            return True
        wanted = {word for word in named if word not in VIEWERS or word == "side"}
        fitting = [
            key
            for key in self.vocabulary.cameras
            if wanted <= set(key.replace("-", "_").lower().split("_")) | {key.lower()}
        ]
        if len(fitting) != 1:
            told = " ".join(token.text for token in self.tokens[at : self.at])
            message = f"'{told}' is no camera whose place is known."
            known = self.vocabulary.cameras
            raise GroundingError("unknown_camera", message, candidates=known)
        clause.view = fitting[0]
        return True

    def _part(self, clause: Clause) -> bool:
        """By its arm: the part that the hand takes hold of."""
        if self._word() not in ("by", "at", "on") or self._kind(1) != WORD:
            return False
        found = noun_phrases.read(self.tokens, self.at + 1)
        its = self._word(1) in ("its", "their")
        if its:
            found = noun_phrases.read(self.tokens, self.at + 2)
        if found is None or (self._word() != "by" and not its):
            return False
        phrase = found[0]
        part = phrase.part or (part_of(phrase.words[-1]) if phrase.words else None)
        if part is None or (phrase.part == "" and phrase.words[-1] in ("box", "case")):
            if not its:
                return False
            message = f"'{phrase.text}' is no part that is known."
            raise GroundingError("no_such_part", message, candidates=clause.themes)
        for key in clause.themes:
            known = self.vocabulary.things[key].known_parts
            if part not in known:
                message = f"{key} has no part '{phrase.text}'; it has {', '.join(known) or 'none'}."
                raise GroundingError("no_such_part", message, candidates=clause.themes)
        self._by_part(clause.themes, part)
        self.at = found[1]
        return True

    def _by_part(self, themes: Sequence[str], part: str) -> None:
        self.parts |= dict.fromkeys(themes, part)
        self.memory.explanation.append(f"{', '.join(themes)} taken by: {part}")

    def _length(self, clause: Clause) -> bool:
        """So far in a direction, or so far from something."""
        start = self.at
        limit = LIMITS.match(self.tokens, self.at)
        about = ABOUT.match(self.tokens, self.at)
        for found in (limit, about):
            if found is not None and self._kind(found[1] - self.at) == LENGTH:
                self.at = found[1]
                break
        if self._kind() != LENGTH:
            self.at = start
            return False
        side = limit[0] if limit is not None and self.at == limit[1] else ""
        low, high = self.tokens[self.at].value
        self.at += 1
        while self._word() in ("straight", "further", "more") and self._kind() == WORD:
            self.at += 1
        way = WAYS.match(self.tokens, self.at)
        relation = RELATIONS.match(self.tokens, self.at)
        if way is not None and (relation is None or way[1] >= relation[1]):
            self.at = way[1]
            self._move(clause, way[0], (low, high), side)
            return True
        if self._word() == "away" and self._word(1) == "from":
            relation = ("away", self.at + 2)
        if relation is not None and relation[0] in (*SIDES, "beside", "away", "from", "outside"):
            self.at = relation[1]
            kind = relation[0] if relation[0] in SIDES else "beside"
            self._relate(clause, kind, gap=gap_limits(low, high, side))
            return True
        self.at = start
        return False

    def _gap(self, clause: Clause) -> bool:
        """With a gap of so much, said of the last relation."""
        last = [goal for goal in clause.goals if goal["kind"] == "beside"]
        if not last:
            return False
        start = self.at
        self.at += self._kind() == COMMA
        if self._take(GAPS) is None:
            self.at = start
            return False
        limit = LIMITS.match(self.tokens, self.at)
        self.at = limit[1] if limit else self.at
        about = ABOUT.match(self.tokens, self.at)
        self.at = about[1] if about else self.at
        if self._kind() != LENGTH:
            self.at = start
            return False
        low, high = self.tokens[self.at].value
        self.at += 1
        while self._word() in GAP_WORDS:
            self.at += 1
        for goal in last:
            goal["gap_m"] = gap_limits(low, high, limit[0] if limit else "")
        return True

    def _way_or_relation(self, clause: Clause) -> bool:
        little = A_LITTLE.match(self.tokens, self.at)
        start = self.at
        self.at = little[1] if little else self.at
        way = WAYS.match(self.tokens, self.at)
        relation = RELATIONS.match(self.tokens, self.at)
        if way is not None and (relation is None or way[1] >= relation[1]):
            particle = way[0] in ("vertical", "backwards") and self._word() in PARTICLES
            if particle and (clause.verb != "move" or self._relation_follows(way[1])):
                self.at = way[1]
                return True
            self.at = way[1]
            length, side = self._trailing_length()
            self._move(clause, way[0], length, side)
            return True
        if relation is None or little is not None:
            self.at = start
            return False
        if relation[0] == "beside" and self._word() == "by" and relation[1] == self.at + 1:
            if self._kind(1) == LENGTH:
                return False
            if self._word(1) in COLOURS:
                return False
        if self._word() in ("near", "close", "nearby") and clause.verb == "":
            return False
        return self._relation(clause, *relation)

    def _relation_follows(self, at: int) -> bool:
        return RELATIONS.match(self.tokens, at) is not None

    def _trailing_length(self) -> tuple[tuple[float, float] | None, str]:
        """To the right by 10 cm."""
        start = self.at
        about = ABOUT.match(self.tokens, self.at)
        self.at = about[1] if about else self.at
        limit = LIMITS.match(self.tokens, self.at)
        self.at = limit[1] if limit else self.at
        if self._kind() == LENGTH:
            self.at += 1
            return self.tokens[self.at - 1].value, limit[0] if limit else ""
        self.at = start
        return None, ""

    def _relation(self, clause: Clause, kind: str, at: int) -> bool:
        word = self._word()
        if kind in ("from", "to") and self._take(LAYERS) is not None:
            return True
        self.at = at
        if kind == "unsupported":
            told = " ".join(token.text for token in self.tokens[at - 1 : at + 3])
            message = f"'{told}': the relation '{word}' is not known here."
            raise GroundingError("unsupported_relation", message)
        self._relate(clause, kind)
        return True

    def _adverb(self, clause: Clause) -> bool:
        start = self.at
        self.at += self._kind() == COMMA
        meaning = self._take(ADVERBS)
        if meaning is None:
            self.at = start
            return False
        if meaning == "again":
            raise self._unknown(start, "does not say where")
        if meaning == "upright":
            clause.add("upright")
        elif meaning in ("slowly", "fast"):
            self._manner(clause, meaning)
        elif meaning == "singly":
            self.memory.remarks.append("one after the other, as always")
        elif meaning == "this order":
            self._in_this_order(clause)
        return True

    def _manner(self, clause: Clause, meaning: str) -> None:
        if meaning == "fast":
            self.memory.remarks.append("as fast as the robot's limits allow, as always")
        for key in clause.themes if meaning == "slowly" else ():
            constraint = {"kind": "speed", "max": SLOW_M_S}
            words = f"{key} at most {SLOW_M_S:g} m/s"
            limit = PathLimit(
                object_id=key, constraint=constraint, until_release=False, words=words
            )
            self.limits.append(limit)

    def _in_this_order(self, clause: Clause) -> None:
        first = len(self.goals.steps)
        for key in clause.themes[:-1]:
            self.goals.steps.append((key,))
        self.goals.edges += [(first + n, first + n + 1) for n in range(len(clause.themes) - 1)]
        self.goals.is_order_given = True

    def _limit(self, clause: Clause) -> bool:
        start = self.at
        self.at += self._kind() == COMMA
        found = self.paths.read(self.at, clause.themes, clause.destination)
        if found is None or (self.at > start and VERBS.match(self.tokens, self.at) is not None):
            self.at = start
            return False
        self.limits += found.limits
        self.at = found.at
        return True

    def _move(
        self, clause: Clause, way: str, length: tuple[float, float] | None, side: str
    ) -> None:
        if way in ITS_SIDES:
            return self._at_its_side(clause, ITS_SIDES[way])
        if way == "vertical":
            message = "an object cannot stay up in the air, or below the table: say on what."
            raise GroundingError("impossible", message, candidates=clause.themes)
        if way == "mine":
            message = "where you stand is not known here. Say it as the robot or a camera sees it."
            raise GroundingError("unknown_camera", message, candidates=self.vocabulary.cameras)
        if length is None:
            clause.add("moved", at_least_m=LEAST_MOVE_M, direction=way)
            told = f"how far is not said: at least {LEAST_MOVE_M * 100:g} cm"
            self.memory.explanation.append(told)
        elif side == "least":
            clause.add("moved", at_least_m=_m(length[0]), direction=way)
        elif side == "most":
            raise self._unknown(self.at - 1, "gives no least distance")
        elif length[0] <= 0 or length[1] > 1.5:
            message = f"{length[1]:g} m is no distance that the arm can move something."
            raise GroundingError("impossible", message, candidates=clause.themes)
        elif length[0] < length[1]:
            clause.add("moved", at_least_m=_m(length[0]), at_most_m=_m(length[1]), direction=way)
        else:
            clause.add("moved", by_m=_m(length[0]), direction=way)
        return None

    def _at_its_side(self, clause: Clause, side: str) -> None:
        """Next to the box, to its left."""
        last = [goal for goal in clause.goals if goal["kind"] == "beside"]
        if not last:
            message = "'its left', 'its right': of what? Name the object: left of the box."
            raise GroundingError("ambiguous_object", message, candidates=self.memory.mentioned)
        for goal in last:
            goal["direction"] = side

    def _relate(self, clause: Clause, kind: str, gap: list[float] | None = None) -> None:
        """Read what a relation is to, and ask for it."""
        start = self.at
        if kind == "between":
            return self._between(clause)
        found = noun_phrases.read(self.tokens, self.at)
        if found is None:
            self._refuse_word()
            raise self._unknown(start - 1 if start else 0, "does not say what it is relative to")
        phrase, self.at = found
        if self._word() in ALTERNATIVES:
            self._refuse_word()
        if kind == "inside":
            return self._inside(clause, phrase)
        if kind == "on":
            return self._on(clause, phrase)
        if kind in ("outside", "from", "off"):
            return self._out(clause, phrase, kind)
        if kind == "to":
            return self._to(clause, phrase)
        if kind == "away" and gap is None:
            message = f"'away from {phrase.text}': say how far, for example 10 cm."
            raise GroundingError("ambiguous_relation", message)
        reference = self._single(phrase, clause)
        if kind == "aligned":
            return clause.add("aligned", reference=reference)
        about: dict[str, Any] = {"reference": reference}
        if kind in SIDES:
            about["direction"] = kind
        if gap is not None:
            about["gap_m"] = gap
        clause.add("beside", **about)
        return None

    def _single(self, phrase: NounPhrase, clause: Clause, slot: str = "reference") -> str:
        """The one thing that a phrase beside a preposition means."""
        ids = self.resolver.resolve(phrase, slot, besides=clause.themes).ids
        if len(ids) != 1:
            told = self.vocabulary.describe(ids)
            message = f"'{phrase.text}' is more than one thing: {told}. Name one."
            raise GroundingError("ambiguous_object", message, candidates=ids)
        return ids[0]

    def _inside(self, clause: Clause, phrase: NounPhrase) -> None:
        if phrase.words[-1:] and phrase.words[-1] in noun_phrases.TABLE_NAMES:
            message = f"nothing can be put into the {phrase.words[-1]}. Say 'onto'."
            raise GroundingError("impossible", message, candidates=[TABLE])
        if phrase.matching or set(phrase.words) & SAME_COLOURED:
            return self._by_colour(clause, phrase)
        clause.add("inside", container=self._single(phrase, clause, "container"))
        return None

    def _on(self, clause: Clause, phrase: NounPhrase) -> None:
        support = self._single(phrase, clause, "support")
        if support != TABLE and phrase.part:
            if phrase.part == "floor" and self.vocabulary.things[support].container:
                return clause.add("inside", container=support)
            message = f"nothing stays on '{phrase.text}'. Say 'on' or 'into', and the object."
            raise GroundingError("impossible", message, candidates=[support])
        if clause.verb == "stack" and len(clause.themes) > 1:
            message = f"which of {', '.join(clause.themes)} is to touch {support}? Say one by one."
            raise GroundingError("ambiguous_relation", message, candidates=clause.themes)
        clause.add("on", support=support)
        again = RELATIONS.match(self.tokens, self.at)
        if clause.verb == "stack" and again is not None and again[0] == "on" and support != TABLE:
            self.at = again[1]
            found = noun_phrases.read(self.tokens, self.at)
            if found is None:
                raise self._unknown(self.at - 1)
            lower = Clause(verb="stack", themes=(support,))
            self.at = found[1]
            self._on(lower, found[0])
            clause.goals[:0] = lower.goals
            self.goals.is_order_given = True
        return None

    def _out(self, clause: Clause, phrase: NounPhrase, kind: str) -> None:
        if phrase.words[-1:] and phrase.words[-1] in noun_phrases.TABLE_NAMES:
            if kind == "from":
                return
            message = f"'{kind} the {phrase.words[-1]}' says no place. Say where it is to go."
            raise GroundingError("unsupported_relation", message)
        source = self._single(phrase, clause, "container" if kind == "outside" else "reference")
        if kind == "outside":
            clause.add("outside", container=source)
        elif self.vocabulary.things[source].container:
            clause.sources.append(source)
        else:
            self.memory.remarks.append(f"'{kind} {phrase.text}' is where it is now")
            if clause.verb == "take":
                self.grasped |= dict.fromkeys(clause.themes, f"take off {source}:")

    def _to(self, clause: Clause, phrase: NounPhrase) -> None:
        if phrase.words[-1:] and phrase.words[-1] in noun_phrases.TABLE_NAMES:
            return clause.add("on", support=TABLE)
        self._single(phrase, clause)
        message = f"'to {phrase.text}': into, onto or next to it?"
        candidates = ("into", "onto", "next to")
        raise GroundingError("ambiguous_relation", message, candidates=candidates)

    def _between(self, clause: Clause) -> None:
        start = self.at
        ids: list[str] = []
        for _ in range(2):
            found = noun_phrases.read(self.tokens, self.at)
            if found is None:
                raise self._unknown(start - 1, "does not say between what")
            self.at = found[1]
            joined = CONJUNCTIONS.match(self.tokens, self.at)
            phrase = found[0]
            if not ids and joined and not phrase.has_noun and not phrase.pronoun:
                following = noun_phrases.read(self.tokens, joined[1])
                if following is not None and not phrase.is_one:
                    phrase = noun_phrases.with_shared_noun([phrase, following[0]])[0]
                    phrase = replace(phrase, plural=False)
                    rest = replace(following[0], plural=False)
                    ids.append(self._single(phrase, clause))
                    self.at = following[1]
                    ids.append(self._single(rest, clause))
                    break
            besides = (*clause.themes, *ids)
            ids += self.resolver.resolve(phrase, "reference", besides=besides).ids
            if len(ids) > 1 or joined is None:
                break
            self.at = joined[1]
        if len(ids) != 2:
            told = self._rest(start - 1)
            message = f"'{told}': it takes two things to be between, not {len(ids)}."
            kind = "too_few_objects" if len(ids) < 2 else "ambiguous_object"
            raise GroundingError(kind, message, candidates=ids)
        clause.add("between", first=ids[0], second=ids[1])

    def _seen_by(self, clause: Clause) -> None:
        """Turn directions that a camera sees into the base frame, and say whose they are."""
        spoken = [goal for goal in clause.goals if isinstance(goal.get("direction"), str)]
        if not spoken:
            return
        if not clause.view:
            told = "directions are as the robot sees them: forwards is away from its base"
            self.memory.explanation.append(told)
            return
        for goal in spoken:
            goal["direction"] = self.vocabulary.as_seen(clause.view, goal["direction"])
        self.memory.explanation.append(f"directions are as camera {clause.view} sees them")

    def _by_colour(self, clause: Clause, phrase: NounPhrase | None) -> None:
        """Each theme goes into the container of its colour."""
        containers = self.vocabulary.containers()
        if phrase is not None:
            words = tuple(word for word in phrase.words if word not in SAME_COLOURED)
            several = replace(phrase, words=words, plural=True, quantifier="", count=None)
            containers = self.resolver.resolve(several, "container").ids
        for key in clause.themes:
            colour = self.vocabulary.things[key].colour
            fitting = [name for name in containers if self.vocabulary.things[name].colour == colour]
            if len(fitting) != 1:
                kind = "ambiguous_object" if fitting else "unknown_object"
                many = "more than one" if fitting else "no"
                told = colour or "of no known colour"
                message = f"{key} is {told}, and there is {many} such container."
                raise GroundingError(kind, message, candidates=fitting or containers)
            clause.goals.append({"kind": "inside", "object": key, "container": fitting[0]})

    def _close(self, clause: Clause, start: int) -> None:
        """Take over the goals of a clause that is read to its end."""
        places = {goal["kind"] for goal in clause.goals}
        for source in clause.sources:
            if "inside" not in places:
                clause.add("outside", container=source)
        if not clause.goals:
            where = self.vocabulary.containers()
            message = f"'{self._rest(start)}' does not say where."
            raise GroundingError("unknown_clause", message, candidates=where)
        self._seen_by(clause)
        for meaning in self.manner:
            self._manner(clause, meaning)
        self.manner.clear()
        self.goals.add_clause(clause.goals)
        self.destination = clause.destination or self.destination
        self.memory.themes = clause.themes
        self.memory.placed += clause.themes
        for key in clause.themes:
            self.grasped.pop(key, None)
        self.verb = clause.verb


def gap_limits(low: float, high: float, side: str) -> list[float]:
    """The least and the greatest gap that a length asks for."""
    if side == "least":
        return [_m(low), _m(low + 0.1)]
    if side == "most":
        return [0.0, _m(high)]
    if low < high:
        return [_m(low), _m(high)]
    return [_m(max(0.0, low - GAP_TOLERANCE_M)), _m(low + GAP_TOLERANCE_M)]


def _m(length: float) -> float:
    """A length without the dust of its arithmetic."""
    return round(length, 6)
