"""Clauses that arrange several objects: sort by colour, build a tower, empty a container."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

from twin.plan.ground import noun_phrases
from twin.plan.ground.arguments import COLOURS, ArgumentReader, Clause
from twin.plan.ground.noun_phrases import SAME_COLOURED, NounPhrase
from twin.plan.ground.vocabulary import GroundingError
from twin.plan.ground.words import (
    ADVERBS,
    BELONGS,
    COMMA,
    LAYERS,
    RELATIONS,
    STOP,
    WORD,
    Phrases,
)
from twin.scene.semantics.language import singular

TOWERS = frozenset({"tower", "stack", "pile", "column"})
IN_ORDER = Phrases(
    dict.fromkeys(
        ("in the order", "in this order :", "in the following order", "as follows",
         "from bottom to top :", "in that order :", "in the order of"),
        "",
    )
)  # fmt: skip


class ArrangementReader(ArgumentReader):
    """Reads clauses that arrange several objects at once."""

    def _sort(self, clause: Clause, start: int) -> None:
        if self._word() == ":":  # what follows says it object by object
            self.verb = "put"
            return
        phrase: NounPhrase | None = None
        by_colour = False
        while self.at < len(self.tokens) and self._kind() == WORD:
            relation = RELATIONS.match(self.tokens, self.at)
            if self._word() in ("by", "according", "based") and self._colour_follows():
                by_colour = True
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
        if not by_colour and not matching:
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

    def _tower(
        self, start: int, themes: tuple[str, ...], *, expected: tuple[str, ...] = ()
    ) -> None:
        """Layers from the bottom up, in the order said, or any order where none is."""
        phrases: list[NounPhrase] = []
        layers: list[str] = []
        told = bool(expected)
        while self.at < len(self.tokens):
            begun = self.at
            if self._kind() == COMMA or (self._kind() == STOP and self._word() in (":", ";")):
                self.at += 1
                continue
            if self._kind() == STOP:
                break
            if self._word() in (
                "of",
                "with",
                "out",
                "from",
                "using",
                "and",
                "then",
                "where",
                "put",
            ):
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
        named = {key for goal in self.goals.found for key in (goal["object"], goal.get("support"))}
        if expected and set(expected) - named:
            message = f"'{self._rest(start)}' does not say the whole order of the tower."
            raise GroundingError("ambiguous_relation", message, candidates=expected)

    def _stack_up(
        self,
        start: int,
        themes: tuple[str, ...],
        phrases: Sequence[NounPhrase],
        layers: Sequence[str],
        *,
        told: bool,
    ) -> None:
        shared = noun_phrases.with_shared_noun(phrases)
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
        for lower, upper in pairwise(tower):
            clause.goals.append({"kind": "on", "object": upper, "support": lower})
        why = "" if known or told else ": the planner's choice, for no order is said"
        self.memory.explanation.append(f"from the bottom up: {', '.join(tower)}{why}")
        self.goals.is_order_given = self.goals.is_order_given or bool(known or told)
        self._close(clause, start)
