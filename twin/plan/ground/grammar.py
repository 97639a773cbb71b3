"""The grammar: from the words of an instruction to goals, in order, with limits on the way.

An instruction is read from left to right, once. Whatever is not understood is an error that names
it; adjectives without a meaning here are the one thing that is passed over, with a remark.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from bridge.task.check import TABLE
from bridge.task.relations import SIDES
from bridge.task.relations import WAYS as NAMED_WAYS
from twin.plan.ground import noun_phrases
from twin.plan.ground.goals import PLACES, Goals, Grounding, PathLimit, ordered
from twin.plan.ground.noun_phrases import SAME_COLOURED, Memory, NounPhrase, Resolver
from twin.plan.ground.path_clauses import LIMITS, PathReader
from twin.plan.ground.vocabulary import GroundingError, Vocabulary
from twin.plan.ground.words import (
    ADVERBS,
    ALTERNATIVES,
    BELONGS,
    COMMA,
    CONDITIONS,
    CONJUNCTIONS,
    ENSURE,
    LAYERS,
    LENGTH,
    NEGATIONS,
    POLITE,
    PUSHED,
    QUESTIONS,
    RELATIONS,
    SEQUENCES,
    STOP,
    THROWN,
    UNSUPPORTED_VERBS,
    VERBS,
    VIEWS,
    WAYS,
    WORD,
    Phrases,
    printable,
    tokens_of,
)
from twin.scene.semantics.language import colour_of, part_of, singular

GAP_TOLERANCE_M = 0.01
"""Of a gap that is said as one number."""
LEAST_MOVE_M = 0.05
"""Of something that is to move in a direction, where nobody says how far."""
SLOW_M_S = 0.1
"""Of the tool, where something is to be done slowly."""
PARTICLES = frozenset({"up", "down", "over", "back", "out", "away", "off", "together"})
COLOURS = frozenset({"colour", "color", "colours", "colors"})
TOWERS = frozenset({"tower", "stack", "pile", "column"})
VIEWERS = frozenset({"camera", "cam", "view", "viewpoint", "perspective", "image", "side"})
ROBOTS = frozenset({"robot", "arm", "your", "base", "robot's", "yourself"})
ABOUT = Phrases(
    dict.fromkeys(
        ("about", "roughly", "around", "approximately", "exactly", "by", "by about", "some",
         "another", "a distance of", "by exactly", "by roughly", "for", "by another"),
        "",
    )
)  # fmt: skip
"""Words before a length that change nothing."""
A_LITTLE = Phrases(
    dict.fromkeys(("a bit", "a little", "slightly", "a little bit", "somewhat", "a bit more"), "")
)
GAPS = Phrases(
    dict.fromkeys(
        ("with", "with a", "with a gap of", "leaving", "leaving a gap of", "leaving a", "leave",
         "with a distance of", "with a spacing of", "at a distance of", "leaving a space of",
         "and leave", "and leave a gap of", "with a space of", "with a clearance of",
         "with a gap between them of", "keeping a gap of", "with gaps of", "with a gap"),
        "",
    )
)  # fmt: skip
GAP_WORDS = frozenset("gap space distance between them clearance apart the two of spacing".split())


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
    pending_gap: tuple[float, float] | None = None
    by_colour: bool = False

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


def ground(text: str, vocabulary: Vocabulary) -> Grounding:
    """Turn an instruction into goals, their order, and limits on the way.

    Args:
        text: What a person wrote.
        vocabulary: What there is.

    Raises:
        GroundingError: When it is not understood whole, or cannot be done; never a guess.
    """
    return Reader(text, vocabulary).read()


class Reader:
    """Reads one instruction."""

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
        self.at = 0

    # What the parser looks at.

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
        said = self._rest(start)
        return GroundingError("unknown_clause", f"'{said}' {why}.")

    # The instruction as a whole.

    def read(self) -> Grounding:
        """Read all clauses."""
        then = before = False
        last = None
        while True:
            joined = self._between_clauses()
            then, before = then or joined == "then", before or joined == "before"
            if self.at >= len(self.tokens):
                break
            start, known = self.at, len(self.goals.steps)
            self._clause()
            if self.at == start:
                raise self._unknown(start)
            self._end_of_clause(start)
            if len(self.goals.steps) > known:
                if last is not None and (then or before):
                    edge = (last, known) if then else (known, last)
                    self.goals.edges.append(edge)
                    self.goals.is_order_said = True
                last, then, before = len(self.goals.steps) - 1, False, False
        return self._finish()

    def _between_clauses(self) -> str:
        """Skip signs and words without effect; say whether they order what follows."""
        joined = ""
        while self.at < len(self.tokens):
            start = self.at
            if self._kind() in (STOP, COMMA):
                self.at += 1
            elif CONJUNCTIONS.match(self.tokens, self.at) and self._kind() == WORD:
                self._take(CONJUNCTIONS)
            elif RELATIONS.match(self.tokens, self.at) and self._word() in ("next", "first"):
                break
            elif (meaning := SEQUENCES.match(self.tokens, self.at)) is not None:
                joined = meaning[0] if meaning[0] != "first" else joined
                self.at = meaning[1]
            elif self._is_polite():
                self._take(POLITE)
            if self.at == start:
                break
        return joined

    def _is_polite(self) -> bool:
        polite = POLITE.match(self.tokens, self.at)
        if polite is None:
            return False
        ensure = ENSURE.match(self.tokens, self.at)
        return ensure is None or polite[1] > ensure[1]

    def _end_of_clause(self, start: int) -> None:
        """Raise where words are left that belong to nothing."""
        if self.at >= len(self.tokens) or self._kind() in (STOP, COMMA):
            return
        if CONJUNCTIONS.match(self.tokens, self.at) or SEQUENCES.match(self.tokens, self.at):
            return
        if self._word() in ("before", "after", "while", "whilst", "but"):
            return
        self._refuse_word()
        raise self._unknown(start, f"is not understood from '{self._word()}' on")

    def _refuse_word(self) -> None:
        """Raise where a word is here that the grammar knows and does not take."""
        word = self._word()
        if word in ALTERNATIVES:
            message = f"'{word}': only one thing can be done. Choose."
            raise GroundingError("alternative", message, candidates=self.memory.mentioned)
        if word in NEGATIONS or (word in ("do", "does", "must", "should") and self._word(1) == "not"):
            message = (
                f"'{self._rest(self.at)}' says what is not wanted. Say what is to be done instead."
            )
            raise GroundingError("negated", message)
        if word in CONDITIONS:
            message = f"'{self._rest(self.at)}': conditions are not understood. Say what to do."
            raise GroundingError("unknown_clause", message)

    def _finish(self) -> Grounding:
        for key, word in self.grasped.items():
            if not any(goal["object"] == key for goal in self.goals.found):
                message = f"'{word}' {key}: say where it is to go; holding it is not an end."
                raise GroundingError("unsupported_verb", message)
        if not self.goals.found:
            if self.limits:
                message = f"'{printable(self.text)}' says how, and not what is to be done."
                raise GroundingError("unknown_clause", message)
            message = "the instruction asks for nothing. Say what is to be put where."
            raise GroundingError("empty", message)
        found = self.goals.merged()
        order = ordered(self.goals, found)
        return Grounding(
            text=self.text,
            goals=tuple(found),
            order=order,
            is_order_said=self.goals.is_order_said,
            path=tuple(self._spread(order)),
            grasp_parts=dict(self.parts),
            choices=tuple(self.memory.choices),
            remarks=tuple(dict.fromkeys(self.memory.remarks)),
            explanation=tuple(dict.fromkeys(self.memory.explanation)),
        )

    def _spread(self, order: Sequence[str]) -> list[PathLimit]:
        """Limits said before any object was named hold for all."""
        spread = []
        for limit in self.limits:
            for key in order if limit.object_id == ANY else [limit.object_id]:
                constraint = {
                    name: key if value == ANY else value for name, value in limit.constraint.items()
                }
                words = limit.words.replace(ANY, key)
                spread.append(
                    replace(limit, object_id=key, constraint=constraint, words=words)
                )
        return list({(limit.words): limit for limit in spread}.values())

    # One clause.

    def _clause(self) -> None:
        start = self.at
        if self._path_clause():
            return
        if self._word() in ("before", "after"):
            return self._ordered_clauses()
        if self._word() == "but":
            self.at += 1
            return None
        self._refuse_word()
        if self._word() in QUESTIONS:
            raise self._unknown(start, "is a question or a statement, and not a task")
        ensure = ENSURE.match(self.tokens, self.at)
        if ensure is not None and ensure[1] > start:
            self.at = ensure[1]
            return self._declarative(start, ensured=True)
        if VERBS.match(self.tokens, self.at) is not None:
            return self._verb_clause()
        self._refuse_verb(start)
        if self.memory.themes and self._continues():
            clause = Clause(verb=self.verb, themes=self.memory.themes)
            self._arguments(clause)
            return self._close(clause, start)
        return self._declarative(start, ensured=False)

    def _path_clause(self) -> bool:
        themes = self.memory.themes or (ANY,)
        if VERBS.match(self.tokens, self.at) and self._word() in ("leave", "carry", "carrying"):
            return False
        found = self.paths.read(self.at, themes, self.destination)
        if found is None:
            return False
        self.limits += found.limits
        self.at = found.at
        return True

    def _ordered_clauses(self) -> None:
        """After putting A there, put B here; before you put A there, put B here."""
        word, start = self._word(), self.at
        self.at += 1
        later = len(self.goals.steps) > 0
        self._subject()
        known = len(self.goals.steps)
        self._clause()
        if len(self.goals.steps) == known:
            raise self._unknown(start)
        self.goals.is_order_said = True
        if later:  # this was the second half of a sentence
            pair = (known - 1, known)
        else:
            while self._kind() == COMMA or self._word() == "then":
                self.at += 1
            self._between_clauses()
            self._clause()
            if len(self.goals.steps) < known + 2:
                raise self._unknown(start)
            pair = (known + 1, known)
        self.goals.edges.append(pair if word == "before" else pair[::-1])

    def _subject(self) -> None:
        """Skip "you" and "having"."""
        while self._word() in ("you", "having", "you've", "have", "that"):
            self.at += 1

    def _continues(self) -> bool:
        """Whether what follows is said of the last objects: a relation, a length, an adverb."""
        return (
            RELATIONS.match(self.tokens, self.at) is not None
            or ADVERBS.match(self.tokens, self.at) is not None
            or WAYS.match(self.tokens, self.at) is not None
            or self._kind() == LENGTH
        )

    def _refuse_verb(self, start: int) -> None:
        """Raise where the clause begins with a verb that nobody here can do."""
        word = self._word()
        stems = {word, singular(word), word.removesuffix("ing"), word.removesuffix("ing") + "e"}
        if stems & UNSUPPORTED_VERBS and not self._is_thing(word):
            can = "put, move, take out, stack, sort, pack"
            message = f"'{word}' is nothing this robot can do. It can {can}."
            raise GroundingError("unsupported_verb", message)
        if self._is_thing(word):
            return
        at, self.at = self.at, self.at + 1
        phrase = noun_phrases.read(self.tokens, self.at) if self._kind(-1) == WORD else None
        self.at = at
        if phrase is None or colour_of(word) or part_of(word):
            return
        begins = self.tokens[at + 1].text in ("the", "a", "an", "all", "every", "both", "it")
        nouns = {name for thing in self.vocabulary.things.values() for name in thing.names}
        if begins and (phrase[0].pronoun or set(phrase[0].words[-1:]) & nouns):
            message = f"'{word}' is no verb that is known here."
            raise GroundingError("unsupported_verb", message)
        if begins:
            raise self._unknown(start)

    def _is_thing(self, word: str) -> bool:
        known = self.vocabulary.nouns()
        return singular(word) in known and VERBS.match(self.tokens, self.at) is None

    # Sentences about objects: "every green block goes into the red bin".

    def _declarative(self, start: int, *, ensured: bool) -> None:
        phrases = self._theme_phrases()
        stacks = not ensured and self.verb == "stack" and bool(self.goals.found)
        follows = BELONGS.match(self.tokens, self.at) is not None or self._continues()
        if not phrases or not (follows or stacks or self._kind() == COMMA):
            raise self._unknown(start)
        themes = self._resolved(phrases)
        belongs = self._take(BELONGS)
        if belongs == "is" and not ensured:
            raise self._unknown(start, "is a statement, and not a task")
        if self._word() in NEGATIONS:
            self._refuse_word()
        if belongs is not None:
            self._take(VERBS)
        if belongs is None and stacks:
            layer = self._take(LAYERS)
            ends = self.at >= len(self.tokens) or self._kind() in (STOP, COMMA)
            ends = ends or CONJUNCTIONS.match(self.tokens, self.at) is not None
            if layer == "top" or (layer is None and ends):
                return self._on_top(themes)
        clause = Clause(verb=self.verb or "put", themes=themes)
        self.memory.themes = themes
        self._arguments(clause)
        if not clause.goals:
            raise self._unknown(start, "does not say what is to be done")
        return self._close(clause, start)

    def _on_top(self, themes: tuple[str, ...]) -> None:
        lower = self.memory.themes[-1]
        clause = Clause(verb="stack", themes=themes)
        for key in themes:
            clause.goals.append({"kind": "on", "object": key, "support": lower})
            lower = key
        self.goals.is_order_said = True
        self._close(clause, self.at)

    # Imperatives.

    def _verb_clause(self) -> None:
        start, word = self.at, self._word()
        verb = self._take(VERBS) or ""
        if any(word.startswith(stem[:4]) for stem in THROWN):
            self.memory.remarks.append(f"'{word}' is done by letting go close above")
        if any(word.startswith(stem[:4]) for stem in PUSHED):
            self.memory.remarks.append(f"'{word}' is done by lifting and putting down")
        if verb == "build":
            return self._build(start)
        if verb == "empty":
            return self._empty(start)
        if self._word() in PARTICLES and RELATIONS.match(self.tokens, self.at) is None:
            self.at += 1
        phrases = self._theme_phrases()
        if phrases:
            themes = self._resolved(phrases)
        elif self.memory.themes and verb in ("put", "move") and self._continues():
            themes = self.memory.themes
        else:
            raise self._unknown(start, "does not say what is to be moved")
        self.verb = verb
        self.memory.themes = themes
        clause = Clause(verb=verb, themes=themes)
        if verb == "sort":
            return self._sort(clause, start)
        if verb == "stack" and self._kind() == STOP and self._word() == ":":
            self.at += 1
            return self._tower(start, ())
        self._arguments(clause)
        if verb == "take" and not clause.goals and not clause.sources:
            self.grasped |= dict.fromkeys(themes, word)
            return None
        if verb == "pack" and not any(goal["kind"] in PLACES for goal in clause.goals):
            self._into_the_only_container(clause)
        if verb == "stack" and not clause.goals:
            return self._tower(start, themes)
        return self._close(clause, start)

    def _theme_phrases(self) -> list[NounPhrase]:
        """The objects of a clause as they are said: one noun phrase or several."""
        phrases = []
        while True:
            found = noun_phrases.read(self.tokens, self.at)
            if found is None:
                break
            phrases.append(found[0])
            self.at = found[1]
            comma = self._kind() == COMMA
            following = self.at + comma
            joined = CONJUNCTIONS.match(self.tokens, following)
            following = joined[1] if joined else following
            if not (comma or joined) or not self._goes_on(following):
                break
            self.at = following
        self._refuse_word()
        return phrases

    def _resolved(self, phrases: Sequence[NounPhrase]) -> tuple[str, ...]:
        ids: dict[str, None] = {}
        for phrase in _with_shared_noun(phrases):
            resolved = self.resolver.resolve(phrase, "theme", besides=tuple(ids))
            if resolved.part:
                self._by_part(resolved.ids, resolved.part)
            ids |= dict.fromkeys(resolved.ids)
        return tuple(ids)

    def _goes_on(self, at: int) -> bool:
        """Whether another object of the same clause follows a comma or "and"."""
        tokens = self.tokens
        for table in (VERBS, SEQUENCES, ENSURE, POLITE):
            if table.match(tokens, at) is not None:
                return False
        if at >= len(tokens) or tokens[at].text in UNSUPPORTED_VERBS:
            return False
        return noun_phrases.read(tokens, at) is not None

    def _close(self, clause: Clause, start: int) -> None:
        """Take over the goals of a clause that is read to its end."""
        places = {goal["kind"] for goal in clause.goals}
        for source in clause.sources:
            if "inside" not in places:
                clause.add("outside", container=source)
        if clause.pending_gap is not None:
            raise self._unknown(start)
        if not clause.goals:
            where = self.vocabulary.containers()
            message = f"'{self._rest(start)}' does not say where."
            raise GroundingError("unknown_clause", message, candidates=where)
        self._seen_by(clause)
        self.goals.add_clause(clause.goals)
        self.destination = clause.destination or self.destination
        self.memory.themes = clause.themes
        self.memory.placed += clause.themes
        for key in clause.themes:
            self.grasped.pop(key, None)
        self.verb = clause.verb

    def _into_the_only_container(self, clause: Clause) -> None:
        containers = self.vocabulary.containers()
        if len(containers) != 1:
            message = "it is not said what to pack into."
            kind = "ambiguous_object" if containers else "impossible"
            raise GroundingError(kind, message, candidates=containers)
        clause.add("inside", container=containers[0])
        self.memory.explanation.append(f"no container is named; {containers[0]} is the only one")

    # What follows the objects of a clause.

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
        words = []
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
            said = " ".join(token.text for token in self.tokens[at : self.at])
            message = f"'{said}' is no camera whose place is known."
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
            if found is not None and found[1] < len(self.tokens):
                if self.tokens[found[1]].kind == LENGTH:
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
            if relation[0] == "from" and self._between_two(clause, (low, high)):
                return True
            self._relate(clause, kind, gap=_gap(low, high, side))
            return True
        self.at = start
        return False

    def _between_two(self, clause: Clause, length: tuple[float, float]) -> bool:
        """5 cm from the box, to the left: the relation follows."""
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
            goal["gap_m"] = _gap(low, high, limit[0] if limit else "")
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
            said = " ".join(token.text for token in self.tokens[at - 1 : at + 3])
            message = f"'{said}': the relation '{word}' is not known here."
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
        elif meaning == "slowly":
            for key in clause.themes:
                constraint = {"kind": "speed", "max": SLOW_M_S}
                words = f"{key} at most {SLOW_M_S:g} m/s"
                self.limits.append(
                    PathLimit(
                        object_id=key, constraint=constraint, until_release=False, words=words
                    )
                )
        elif meaning == "fast":
            self.memory.remarks.append("as fast as the robot's limits allow, as always")
        elif meaning == "singly":
            self.memory.remarks.append("one after the other, as always")
        elif meaning == "this order":
            self._in_this_order(clause)
        return True

    def _in_this_order(self, clause: Clause) -> None:
        first = len(self.goals.steps)
        for key in clause.themes[:-1]:
            self.goals.steps.append((key,))
        self.goals.edges += [(first + n, first + n + 1) for n in range(len(clause.themes) - 1)]
        self.goals.is_order_said = True

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

    # Relations and movements.

    def _move(
        self, clause: Clause, way: str, length: tuple[float, float] | None, side: str
    ) -> None:
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

    def _relate(
        self, clause: Clause, kind: str, gap: list[float] | None = None
    ) -> None:
        """Read what a relation is to, and ask for it."""
        start = self.at
        if kind == "between":
            return self._between(clause)
        found = noun_phrases.read(self.tokens, self.at)
        if found is None:
            self._refuse_word()
            raise self._unknown(start - 1 if start else 0, "does not say what it is relative to")
        phrase, self.at = found
        if kind in ("left", "right") and phrase.text in ("it", "them"):
            pass
        if self._word() in ALTERNATIVES:
            self._refuse_word()
        if kind == "inside":
            return self._inside(clause, phrase)
        if kind == "on":
            return self._on(clause, phrase)
        if kind in ("outside", "from"):
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
            self.goals.is_order_said = True
        return None

    def _out(self, clause: Clause, phrase: NounPhrase, kind: str) -> None:
        if phrase.words[-1:] and phrase.words[-1] in noun_phrases.TABLE_NAMES:
            if kind == "from" or self._word():
                return
            raise GroundingError("unsupported_relation", "off the table: say where it is to go.")
        source = self._single(phrase, clause, "container" if kind == "outside" else "reference")
        container = self.vocabulary.things[source].container
        if kind == "outside" and not container and self._word(-1) and clause.verb == "take":
            message = f"{self.vocabulary.describe([source])} has no inside to take something out of."
            raise GroundingError("impossible", message, candidates=self.vocabulary.containers())
        if kind == "outside":
            clause.add("outside", container=source)
        elif container:
            clause.sources.append(source)
        else:
            self.memory.remarks.append(f"'from {phrase.text}' is where it is now")

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
                    phrase = _with_shared_noun([phrase, following[0]])[0]
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
            said = self._rest(start - 1)
            message = f"'{said}': it takes two things to be between, not {len(ids)}."
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
        R = self.vocabulary.cameras[clause.view][:3, :3]
        ahead = R[:, 2] if np.linalg.norm(R[:2, 2]) > 0.5 else -R[:, 1]  # looking down: image up
        right = np.array([ahead[1], -ahead[0], 0.0])
        if right @ R[:, 0] < 0:  # hung upside down
            right = -right
        for goal in spoken:
            forwards, left, _ = {**SIDES, **NAMED_WAYS}[goal["direction"]]
            way = forwards * np.array([ahead[0], ahead[1], 0.0]) - left * right
            goal["direction"] = [round(float(part), 6) for part in way / np.linalg.norm(way)]
        self.memory.explanation.append(f"directions are as camera {clause.view} sees them")

    # Sorting, towers, emptying.

    def _sort(self, clause: Clause, start: int) -> None:
        phrase: NounPhrase | None = None
        while self.at < len(self.tokens) and self._kind() == WORD:
            relation = RELATIONS.match(self.tokens, self.at)
            if self._word() in ("by", "according", "based") and self._colour_follows():
                clause.by_colour = True
            elif relation is not None and relation[0] == "inside":
                found = noun_phrases.read(self.tokens, relation[1])
                if found is None:
                    raise self._unknown(start)
                phrase, self.at = found
            else:
                break
        matching = phrase is not None and (
            phrase.matching or bool(set(phrase.words) & SAME_COLOURED)
        )
        if not clause.by_colour and not matching:
            message = f"'{self._rest(start)}': say by what. By colour is what is known here."
            raise GroundingError("ambiguous_relation", message)
        self._by_colour(clause, phrase)
        self._arguments(clause)
        self._close(clause, start)

    def _colour_follows(self) -> bool:
        at = self.at
        while at < len(self.tokens) and self.tokens[at].text in (
            "by", "according", "to", "based", "on", "the", "their", "its",
        ):  # fmt: skip
            at += 1
        if at < len(self.tokens) and self.tokens[at].text in COLOURS:
            self.at = at + 1
            return True
        by = " ".join(token.text for token in self.tokens[self.at : at + 1])
        message = f"'{by}': only colour is known to sort by."
        raise GroundingError("unsupported_relation", message)

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
                message = f"{key} is {colour or 'of no known colour'}, and there is {many} such container."
                raise GroundingError(kind, message, candidates=fitting or containers)
            clause.goals.append({"kind": "inside", "object": key, "container": fitting[0]})

    def _empty(self, start: int) -> None:
        self.at += self._word() == "out"
        found = noun_phrases.read(self.tokens, self.at)
        if found is None:
            raise self._unknown(start)
        themes = self.vocabulary.movable()
        clause = Clause(verb="take", themes=themes)
        self.at = found[1]
        clause.add("outside", container=self._single(found[0], clause, "container"))
        self.memory.explanation.append(f"emptied: all of {', '.join(themes)} end outside")
        self._arguments(clause)
        self._close(clause, start)

    def _build(self, start: int) -> None:
        while self._word() in ("a", "one", "the", "single", "small", "high", "tall", "me", "up"):
            self.at += 1
        if singular(self._word()) not in TOWERS:
            raise self._unknown(start, "is nothing that can be built here: say a tower")
        self.at += 1
        self._tower(start, ())

    def _tower(self, start: int, themes: tuple[str, ...]) -> None:
        """Layers from the bottom up, in the order said, or any order where none is."""
        phrases: list[NounPhrase] = []
        layers: list[str] = []
        told = False
        while self.at < len(self.tokens):
            begun = self.at
            if self._kind() == COMMA or (self._kind() == STOP and self._word() in (":", ";")):
                self.at += 1
                continue
            if self._kind() == STOP:
                break
            if self._word() in ("of", "with", "out", "from", "using", "and", "then", "where", "put"):
                layer = self._take(LAYERS)
                if layer is None:
                    told = told or self._word() == "then"
                    self.at += 1
                    continue
            else:
                layer = self._take(LAYERS)
            if layer in ("upwards", "downwards"):
                told = True
                layers.append(layer)
                phrases.append(NounPhrase(text=""))
                continue
            if ADVERBS.match(self.tokens, self.at):
                told = told or self._take(ADVERBS) == "this order"
                continue
            self._take(BELONGS)
            found = noun_phrases.read(self.tokens, self.at)
            if found is None:
                if layer is not None:
                    raise self._unknown(begun)
                break
            self.at = found[1]
            self._take(BELONGS)
            layer = layer or self._take(LAYERS) or ""
            phrase = found[0]
            if phrase.words and phrase.words[-1] in ("first", "last"):
                layer = "bottom" if phrase.words[-1] == "first" else "top"
                phrase = replace(phrase, words=phrase.words[:-1], plural=False)
            phrases.append(phrase)
            layers.append(layer)
        self._stack_up(start, themes, phrases, layers, told=told)

    def _stack_up(
        self,
        start: int,
        themes: tuple[str, ...],
        phrases: Sequence[NounPhrase],
        layers: Sequence[str],
        *,
        told: bool,
    ) -> None:
        shared = _with_shared_noun(phrases)
        down = "downwards" in layers
        named = [(p, layer) for p, layer in zip(shared, layers, strict=True) if p.text]
        ids = [(key, "") for key in themes]
        for phrase, layer in named:
            listed = [key for key, _ in ids]
            if layer and listed:  # "red on top" of those that were listed before
                again = self.resolver.resolve(phrase, "theme").ids
                if len(again) == 1 and again[0] in listed:
                    ids[listed.index(again[0])] = (again[0], layer)
                    continue
            besides = tuple(listed)
            for key in self.resolver.resolve(phrase, "theme", besides=besides).ids:
                if key not in besides:
                    ids.append((key, layer))
        known = [layer for _, layer in ids if layer]
        if known and not told and len(ids) > 2 and len(known) < len(ids) - 1:
            message = f"'{self._rest(start)}' does not say the whole order of the tower."
            among = [key for key, _ in ids]
            raise GroundingError("ambiguous_relation", message, candidates=among)
        down = down or (bool(ids) and ids[0][1] == "top" and len(ids) > 1)
        tower = [key for key, _ in (reversed(ids) if down else ids)]
        if known and not told and not down:
            rank = {"bottom": 0, "middle": 1, "": 1, "top": 2}
            tower = [key for key, _ in sorted(ids, key=lambda item: rank[item[1]])]
        if len(tower) < 2:
            message = f"'{self._rest(start)}': a tower takes two objects or more."
            raise GroundingError("too_few_objects", message, candidates=tower)
        clause = Clause(verb="stack", themes=tuple(tower[1:]))
        for lower, upper in zip(tower, tower[1:], strict=False):
            clause.goals.append({"kind": "on", "object": upper, "support": lower})
        why = "" if known or told else ": the planner's choice, for no order is said"
        self.memory.explanation.append(f"from the bottom up: {', '.join(tower)}{why}")
        self.goals.is_order_said = self.goals.is_order_said or bool(known or told)
        self._close(clause, start)


ANY = "*"
"""Stands for objects that are named later."""


def _gap(low: float, high: float, side: str) -> list[float]:
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


def _with_shared_noun(phrases: Sequence[NounPhrase]) -> list[NounPhrase]:
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
