"""Clauses about the way: keep it upright, not over something, so far away from something."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from bridge.task.check import TABLE
from twin.plan.ground import noun_phrases
from twin.plan.ground.goals import PathLimit
from twin.plan.ground.noun_phrases import NounPhrase, Resolver
from twin.plan.ground.vocabulary import GroundingError
from twin.plan.ground.words import LENGTH, WORD, Phrases, Token, word_set
from twin.scene.semantics.language import part_of

UPRIGHT_DEG = 15.0
"""Tilt on the way that counts as upright."""
DEFAULT_CLEARANCE_M = 0.05
"""Where somebody asks to stay away and does not say how far."""
TOUCH_CLEARANCE_M = 0.005
"""Where something is not to be touched."""
SLOW_M_S = 0.1
"""Of the tool, where it is to move slowly."""


def _table(meaning: str, *phrases: str) -> dict[str, str]:
    return dict.fromkeys(phrases, meaning)


LEADS = Phrases(
    _table(
        "",
        "while", "and while", "by", "making sure to", "make sure to", "be sure to", "always",
        "at all times", "taking care to", "take care to", "whilst", "on the way", "meanwhile",
        "as you go", "during the motion", "you must", "being careful to", "be careful to",
    )
)  # fmt: skip
"""Words before a clause about the way; without effect."""
STARTS = Phrases(
    _table("keep", "keep", "keeping", "hold", "holding", "carry", "carrying", "it stays",
           "it remains", "it must stay", "it should stay", "it is", "it has to stay")
    | _table("not tilt", *(
        f"{no} {verb}" for no, verbs in (
            ("without", ("tilting", "tipping", "turning", "tipping over")),
            ("do not", ("tilt", "tip", "tip over")), ("never", ("tilt", "tip")),
            ("not", ("tilting", "tipping")), ("avoid", ("tilting", "tipping")),
            ("avoiding", ("tilting", "tipping")),
        ) for verb in verbs))
    | _table("not over", *(
        f"{no} {verb} {over}".replace("  ", " ")
        for no, verbs in (
            ("without", ("going", "passing", "moving", "flying", "reaching", "travelling",
                         "traveling", "carrying it", "moving it", "swinging", "lifting it",
                         "passing it", "crossing", "taking it")),
            ("do not", ("go", "pass", "move", "fly", "reach", "carry it", "move it", "cross",
                        "swing", "travel")),
            ("never", ("go", "pass", "move", "fly", "reach", "carry it", "cross")),
            ("avoid", ("going", "passing", "moving", "flying", "crossing")),
            ("avoiding", ("going", "passing", "moving", "flying", "crossing")),
            ("not", ("going", "passing", "moving", "flying")), ("must not", ("go", "pass")),
            ("it must not", ("go", "pass")),
        ) for verb in verbs for over in ("over", "above", "across", "over the top of")),
        "without crossing", "not over", "do not cross", "avoid the space over",
        "avoid the space above", "avoid the area above")
    | _table("away", "stay away from", "staying away from", "keep away from", "keeping away from",
             "stay clear of", "staying clear of", "keep clear of", "keeping clear of", "avoid",
             "avoiding", "go around", "going around", "moving around", "move around",
             "steer clear of", "well clear of", "without going near", "without coming close to",
             "do not go near", "without getting close to", "passing around")
    | _table("untouched", *(
        f"{no} {verb}" for no, verbs in (
            ("without", ("touching", "hitting", "bumping into", "colliding with",
                         "knocking over", "knocking into", "bumping", "brushing", "disturbing",
                         "moving")),
            ("do not", ("touch", "hit", "bump into", "collide with", "knock over", "disturb")),
            ("never", ("touch", "hit", "bump into")), ("avoid", ("touching", "hitting")),
            ("avoiding", ("touching", "hitting")), ("not", ("touching", "hitting")),
        ) for verb in verbs))
    | _table("stay", "stay", "staying", "remain", "remaining", "keep it", "keeping it",
             "keep a distance of", "keeping a distance of", "keep", "with a distance of",
             "with a clearance of", "maintain", "maintaining", "maintain a distance of",
             "with", "leave", "keep a clearance of", "maintain a clearance of",
             "keeping a clearance of", "it should stay", "it must stay", "at a distance of",
             "stay a distance of", "keeping at", "keep at", "keep a gap of", "always stay")
)  # fmt: skip
LIMITS = Phrases(
    _table("least", "at least", "more than", "no less than", "not less than", "a minimum of",
           "no closer than", "not closer than", "at a minimum", "over", "further than",
           "farther than", "at the very least", "above", "a distance of", "a clearance of",
           "a distance of at least", "a clearance of at least", "at a distance of at least",
           "at a distance of", "a minimum distance of", "of at least", "higher than")
    | _table("most", "at most", "no more than", "not more than", "below", "less than", "under",
             "no higher than", "not higher than", "lower than", "up to", "within", "a maximum of",
             "at a height of at most", "no farther than")
)  # fmt: skip
BETWEEN_WORDS = frozenset({"away", "clearance", "distance", "space", "gap", "clear", "off", "of"})
FROM_WORDS = ("from", "of", "to", "between")
LEVEL = frozenset({"upright", "level", "horizontal", "vertical", "straight", "flat", "untilted"})
HEIGHT = Phrases(
    _table("height", "above the table", "over the table", "above the table top", "high",
           "above the surface", "in height", "above ground", "above the tabletop")
)  # fmt: skip
UNTIL = Phrases(_table("until", "until", "till", "before", "up to when", "as long as"))
OVER_IT = word_set(
    "you are it is the gripper hand above over at inside in it there release releasing box its "
    "them you're has reached reach reaches arrive arrives directly right just about to let go "
    "letting container basket bin"
)
"""Words of "until you are above it"."""


@dataclass(frozen=True, kw_only=True)
class Read:
    """A clause about the way that was read."""

    limits: tuple[PathLimit, ...]
    at: int
    """Where it ends."""


class PathReader:
    """Reads clauses about the way of certain objects."""

    def __init__(self, tokens: Sequence[Token], resolver: Resolver) -> None:
        """Remember the instruction.

        Args:
            tokens: All of it.
            resolver: Finds what is meant.
        """
        self.tokens = tokens
        self.resolver = resolver

    def read(self, at: int, themes: Sequence[str], destination: str) -> Read | None:
        """Read the clause that begins here; None: it is not about the way.

        Args:
            at: Where it may begin.
            themes: The objects that "it" stands for.
            destination: What they are put into, onto or beside; empty: not known.
        """
        lead = LEADS.match(self.tokens, at)
        start = lead[1] if lead else at
        for meaning, behind in self._starts(start):
            found = self._clause(meaning, behind, themes, destination)
            if found is not None:
                return found
        return self._height(start, themes)

    def _starts(self, at: int) -> list[tuple[str, int]]:
        found = []
        best = STARTS.match(self.tokens, at)
        if best is not None:
            found.append(best)
        word = self.tokens[at].text if at < len(self.tokens) else ""
        if word in ("keep", "keeping"):
            found += [("keep", at + 1), ("stay", at + 1)]
        if LIMITS.match(self.tokens, at) is not None or word == "with":
            found.append(("stay", at + (word == "with")))
        return found

    def _clause(
        self, meaning: str, at: int, themes: Sequence[str], destination: str
    ) -> Read | None:
        if meaning in ("keep", "not tilt"):
            return self._upright(meaning, at, themes)
        if meaning == "stay":
            return self._distance(at, themes, destination)
        named = self._reference(at, themes, destination)
        if named is None:
            return None
        key, behind = named
        if meaning == "not over":
            if key == destination:
                message = (
                    f"{', '.join(themes)} cannot get to {key} without passing over it. Leave that "
                    "out."
                )
                raise GroundingError("contradiction", message, candidates=[key])
            over = {"kind": "keepout", "region": {"over": key}}
            return self._limits(over, f"not over {key}", behind, themes, until=False)
        least = TOUCH_CLEARANCE_M if meaning == "untouched" else DEFAULT_CLEARANCE_M
        return self._clearance(least, key, behind, themes, destination)

    def _upright(self, meaning: str, at: int, themes: Sequence[str]) -> Read | None:
        phrase = noun_phrases.read(self.tokens, at)
        ids = tuple(themes)
        if phrase is not None and not (set(phrase[0].words) & LEVEL):
            if phrase[0].words and phrase[0].words[-1] in ("way", "hand", "gripper"):
                return None
            ids = self._themes(phrase[0], themes)
            at = phrase[1]
        if meaning == "keep":
            if at >= len(self.tokens) or self.tokens[at].text not in LEVEL:
                return None
            at += 1
        constraint = {"kind": "upright", "max_deg": UPRIGHT_DEG}
        return self._limits(constraint, f"upright within {UPRIGHT_DEG:g} degrees", at, ids)

    def _themes(self, phrase: NounPhrase, themes: Sequence[str]) -> tuple[str, ...]:
        if phrase.pronoun and themes:
            return tuple(themes)
        return self.resolver.resolve(phrase, "theme").ids

    def _distance(self, at: int, themes: Sequence[str], destination: str) -> Read | None:
        """At least so far (away) from something."""
        tokens = self.tokens
        if at < len(tokens) and tokens[at].text in ("it", "them"):
            at += 1
        while at < len(tokens) and tokens[at].text in ("a", "an", "always", "well"):
            at += 1
        limit = LIMITS.match(tokens, at)
        at = limit[1] if limit else at
        if at >= len(tokens) or tokens[at].kind != LENGTH:
            return None
        length = tokens[at].value[0]
        at += 1
        height = HEIGHT.match(tokens, at)
        if height is not None:
            return self._height_limit(limit[0] if limit else "least", length, height[1], themes)
        while at < len(tokens) and tokens[at].text in BETWEEN_WORDS:
            if tokens[at].text == "of" and tokens[at - 1].text not in ("clear", "distance"):
                break
            at += 1
        if at >= len(tokens) or tokens[at].text not in FROM_WORDS:
            if tokens[at - 1].text != "of":
                return None
            at -= 1
        named = self._reference(at + 1, themes, destination)
        if named is None or (limit and limit[0] == "most"):
            return None
        return self._clearance(length, named[0], named[1], themes, destination)

    def _height(self, at: int, themes: Sequence[str]) -> Read | None:
        """No higher than so much."""
        tokens = self.tokens
        if at < len(tokens) and tokens[at].text in ("it", "staying", "stay", "keeping", "lift"):
            at += 1
        limit = LIMITS.match(tokens, at)
        if limit is None or limit[1] >= len(tokens) or tokens[limit[1]].kind != LENGTH:
            return None
        worded = tokens[limit[1] - 2].text in ("higher", "lower")
        height = HEIGHT.match(tokens, limit[1] + 1)
        if height is None and not worded:
            return None
        length = tokens[limit[1]].value[0]
        return self._height_limit(limit[0], length, height[1] if height else limit[1] + 1, themes)

    def _height_limit(
        self, side: str, length: float, at: int, themes: Sequence[str]
    ) -> Read | None:
        bound = "min" if side == "least" else "max"
        words = f"its lowest point at {side} {length * 100:g} cm over the table"
        return self._limits({"kind": "height", bound: round(length, 6)}, words, at, themes)

    def _reference(
        self, at: int, themes: Sequence[str], destination: str
    ) -> tuple[str, int] | None:
        """The thing that a limit is about; "its walls" are those of the destination."""
        tokens = self.tokens
        its = at < len(tokens) and tokens[at].text in ("its", "their")
        found = noun_phrases.read(tokens, at + its)
        if found is None:
            return None
        phrase, behind = found
        part = part_of(phrase.words[-1]) if phrase.words else None
        owner = phrase.words[:-1] if part and not its else ()
        if part and not phrase.part and not set(owner) & self.resolver.vocabulary.nouns():
            return (destination, behind) if destination not in ("", TABLE) else None
        if part and owner:  # the box walls
            cut = replace(phrase, words=owner, plural=False)
            return self.resolver.resolve(cut, "reference", besides=themes).ids[0], behind
        if phrase.pronoun == "it" and destination not in ("", TABLE):
            return destination, behind
        ids = self.resolver.resolve(phrase, "reference", besides=themes).ids
        if len(ids) != 1:
            message = f"'{phrase.text}': one object at a time. Say each in a clause of its own."
            raise GroundingError("ambiguous_object", message, candidates=ids)
        return ids[0], behind

    def _clearance(
        self, least_m: float, key: str, at: int, themes: Sequence[str], destination: str
    ) -> Read | None:
        ends = UNTIL.match(self.tokens, at)
        if ends is not None:
            at = self._until(ends[1])
        until = ends is not None or key == destination
        constraint = {"kind": "clearance", "against": key, "min": round(least_m, 6)}
        words = f"at least {least_m * 100:g} cm from {key}"
        return self._limits(constraint, words, at, themes, until=until)

    def _until(self, at: int) -> int:
        """Skip "you are above it", the one end of a limit that is known: before the release."""
        start = at
        while (
            at < len(self.tokens)
            and self.tokens[at].kind == WORD
            and self.tokens[at].text in OVER_IT
        ):
            at += 1
        if at == start:
            told = " ".join(token.text for token in self.tokens[at : at + 8])
            message = f"'until {told}' is not understood. A limit ends above the place of release."
            raise GroundingError("unknown_clause", message)
        return at

    def _limits(
        self,
        constraint: dict[str, Any],
        words: str,
        at: int,
        themes: Sequence[str],
        *,
        until: bool = False,
    ) -> Read | None:
        if not themes:
            return None
        kind = constraint.pop("kind")
        until = until or constraint.get("region", {}).get("over") is not None
        end = " until it is above its place" if until else ""
        return Read(
            limits=tuple(
                PathLimit(
                    object_id=key,
                    constraint={"kind": kind, "obj": key, **constraint},
                    until_release=until,
                    words=f"{key} {words}{end}",
                )
                for key in themes
            ),
            at=at,
        )
