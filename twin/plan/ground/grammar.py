"""The grammar: from the words of an instruction to goals, in order, with limits on the way.

An instruction is read from left to right, once. Whatever is not understood is an error that names
it; adjectives without a meaning here are the one thing that is passed over, with a remark.
"""

from collections.abc import Sequence
from dataclasses import replace

from twin.plan.ground import noun_phrases
from twin.plan.ground.arguments import ANY, PARTICLES, Clause
from twin.plan.ground.arrangements import IN_ORDER, ArrangementReader
from twin.plan.ground.goals import PLACES, Grounding, PathLimit, ordered
from twin.plan.ground.noun_phrases import NounPhrase
from twin.plan.ground.vocabulary import GroundingError, Vocabulary
from twin.plan.ground.words import (
    ADVERBS,
    BELONGS,
    COMMA,
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
    WAYS,
    WORD,
    printable,
)
from twin.scene.semantics.language import colour_of, part_of, singular


def ground(text: str, vocabulary: Vocabulary) -> Grounding:
    """Turn an instruction into goals, their order, and limits on the way.

    Args:
        text: What a person wrote.
        vocabulary: What there is.

    Raises:
        GroundingError: When it is not understood whole, or cannot be done; never a guess.
    """
    return Reader(text, vocabulary).read()


class Reader(ArrangementReader):
    """Reads one instruction, clause by clause."""

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
                    self.goals.is_order_given = True
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
            elif self._word() in ("but", "however", "yet"):
                self.at += 1
            elif RELATIONS.match(self.tokens, self.at) and self._word() in ("next", "first"):
                break
            elif (meaning := SEQUENCES.match(self.tokens, self.at)) is not None:
                joined = meaning[0] if meaning[0] != "first" else joined
                self.at = meaning[1]
            elif self._is_polite():
                self._take(POLITE)
            elif (adverb := self._leading_adverb()) is not None:
                self.manner.append(adverb)
            if self.at == start:
                break
        return joined

    def _leading_adverb(self) -> str | None:
        """Slowly put ...: how, said before the verb."""
        found = ADVERBS.match(self.tokens, self.at)
        if found is None or found[0] not in ("slowly", "fast", ""):
            return None
        joined = CONJUNCTIONS.match(self.tokens, found[1])
        after = joined[1] if joined else found[1]
        if VERBS.match(self.tokens, after) is None and ADVERBS.match(self.tokens, after) is None:
            return None
        self.at = found[1]
        return found[0]

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
            is_order_given=self.goals.is_order_given,
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
                spread.append(replace(limit, object_id=key, constraint=constraint, words=words))
        return list({(limit.words): limit for limit in spread}.values())

    def _clause(self) -> None:
        start = self.at
        if self._path_clause():
            return
        if self._word() in ("before", "after"):
            return self._ordered_clauses()
        self._refuse_word()
        if self._word() in QUESTIONS:
            raise self._unknown(start, "is a question or a statement, and not a task")
        ensure = ENSURE.match(self.tokens, self.at)
        if ensure is not None and ensure[1] > start:
            self.at = ensure[1]
            return self._declarative(start, ensured=True)
        if VERBS.match(self.tokens, self.at) is not None:
            return self._verb_clause()
        if self.memory.themes and self._continues():
            clause = Clause(verb=self.verb, themes=self.memory.themes)
            self._arguments(clause)
            return self._close(clause, start) if clause.goals or self.at == start else None
        self._refuse_verb(start)
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
        self.goals.is_order_given = True
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
        if self._is_thing(word) or RELATIONS.match(self.tokens, start) is not None:
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

    def _declarative(self, start: int, *, ensured: bool) -> None:
        phrases = self._theme_phrases()
        stacks = not ensured and self.verb == "stack" and bool(self.goals.found)
        follows = BELONGS.match(self.tokens, self.at) is not None or self._continues()
        if not phrases or not (follows or stacks or self._kind() == COMMA):
            raise self._unknown(start)
        belongs = self._take(BELONGS)
        if belongs == "is" and not ensured:
            raise self._unknown(start, "is a statement, and not a task")
        themes = self._resolved(phrases)
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
        self.goals.is_order_given = True
        self._close(clause, self.at)

    def _verb_clause(self) -> None:
        start, word = self.at, self._word()
        verb = self._take(VERBS) or ""
        self._remark_on(word)
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
        if verb == "stack":
            return self._stack(clause, start)
        self._arguments(clause)
        if verb == "take" and not clause.goals and not clause.sources:
            self.grasped |= {key: word for key in themes if key not in self.grasped}
            return None
        if verb == "pack" and not any(goal["kind"] in PLACES for goal in clause.goals):
            self._into_the_only_container(clause)
        return self._close(clause, start)

    def _remark_on(self, word: str) -> None:
        """Say how a verb is done that asks for more than putting down."""
        if any(word.startswith(stem[:4]) for stem in THROWN):
            self.memory.remarks.append(f"'{word}' is done by letting go close above")
        if any(word.startswith(stem[:4]) for stem in PUSHED):
            self.memory.remarks.append(f"'{word}' is done by lifting and putting down")

    def _stack(self, clause: Clause, start: int) -> None:
        """Stack A on B; stack A, B and C; stack the cubes in the order A, B, C."""
        if self._word() == ":":
            self.at += 1
            return self._tower(start, ())
        if self._take(IN_ORDER) is not None:
            return self._tower(start, (), expected=clause.themes)
        self._arguments(clause)
        if not clause.goals:
            return self._tower(start, clause.themes)
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
        for phrase in noun_phrases.with_shared_noun(phrases):
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

    def _into_the_only_container(self, clause: Clause) -> None:
        containers = self.vocabulary.containers()
        if len(containers) != 1:
            message = "it is not said what to pack into."
            kind = "ambiguous_object" if containers else "impossible"
            raise GroundingError(kind, message, candidates=containers)
        clause.add("inside", container=containers[0])
        self.memory.explanation.append(f"no container is named; {containers[0]} is the only one")
