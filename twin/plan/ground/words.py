"""The closed words of the grammar, and how an instruction is cut into words.

Nouns and colours are those of the scene and of the lexicon (``twin.naming.words``).
"""

import re
import unicodedata
from dataclasses import dataclass

from twin.plan.ground.vocabulary import GroundingError


def word_set(text: str) -> frozenset[str]:
    """The words of a text, to ask whether one is among them."""
    return frozenset(text.split())


MAX_CHARACTERS = 2000


@dataclass(frozen=True)
class Token:
    """One word, number, length or sign of an instruction."""

    text: str
    """In lower case."""
    number: int | None = None
    length_m: tuple[float, float] | None = None
    """Least and greatest; equal where one number is given."""

    @property
    def is_sign(self) -> bool:
        """It only divides: a comma, a full stop."""
        return self.text in SIGNS


SIGNS = (",", ".", ";", ":", "!", "?")
_COUNTED = "one two three four five six seven eight nine ten eleven twelve"
NUMBERS = {word: number for number, word in enumerate(_COUNTED.split(), start=1)}
UNITS_M = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
LONG_UNITS = {
    f"{long}{ending}": short
    for long, short in {"millimet": "mm", "centimet": "cm", "met": "m"}.items()
    for ending in ("re", "res", "er", "ers")
}
_TOKEN = re.compile(
    r"(?P<low>\d+(?:\.\d+)?)(?:\s*(?:-|–|to)\s*(?P<high>\d+(?:\.\d+)?))?\s*(?P<unit>mm|cm|m)\b"
    r"|(?P<number>\d{1,6})(?![\w.]\w)"
    r"|(?P<word>[^\W\d][\w'-]*)"
    r"|(?P<space>\s+|[\"“”])"
    r"|(?P<other>.)"
)

VERBS = {
    **dict.fromkeys(
        ("put", "place", "set", "lay", "drop", "throw", "bring", "insert", "arrange", "leave"),
        "put",
    ),
    **dict.fromkeys(("move", "push", "slide"), "move"),
    **dict.fromkeys(("take", "remove", "grab", "pick up"), "take"),
    "pack": "pack",
    "stack": "stack",
}
CARRIED = ("push", "slide", "throw", "drop")
"""Verbs whose manner is not kept, which is said."""
ENDS_THERE = ("goes", "go", "belongs", "belong")
"""Every green block goes into the red bin."""
UNSUPPORTED_VERBS = word_set(
    "balance clean close count cover cut find flip fold give hand hold hover juggle lift open "
    "pick poke pour press raise roll rotate shake show sort spin squeeze stir swap tilt tip touch "
    "turn twist unscrew wave wipe"
)
"""Verbs of other work; named here so that an error says it is the verb that nobody can do."""
RELATIONS = {
    **dict.fromkeys(("in", "into", "in to", "inside"), "inside"),
    **dict.fromkeys(("on", "onto", "on to", "on top of"), "on"),
    **dict.fromkeys(("beside", "next to"), "beside"),
    **{
        f"{before}{side}{behind} of": side
        for side in ("left", "right")
        for before in ("", "to the ", "on the ")
        for behind in ("", " side")
    },
    "in front of": "in_front",
    "behind": "behind",
    "out of": "outside",
    "from": "outside",
}
"""Where something belongs, by the words before what it is relative to."""
UNSUPPORTED_RELATIONS = word_set(
    "above across against along around at below beneath between by close near off outside over "
    "past through under underneath within"
)
WAYS = {
    **{f"{before}{side}": side for side in ("left", "right") for before in ("", "to the ")},
    **{f"{way}{s}": f"{way}s" for way in ("forward", "backward") for s in ("", "s")},
}
THEN = ("then", "after that", "afterwards", "finally")
POLITE = ("please", "could you", "can you")
GAP = ("with a gap of", "with gaps of")
PRONOUNS = ("it", "them")
ARTICLES = ("the", "a", "an")
ALL = ("all", "every", "each", "everything")
SIZES = {"small": -1, "little": -1, "tiny": -1, "large": 1, "big": 1}
TABLES = ("table", "desk")
NEGATIONS = word_set("no not never don't dont without except nothing neither nor")
CLOSED = frozenset(
    word
    for table in (
        VERBS, ENDS_THERE, UNSUPPORTED_VERBS, RELATIONS, UNSUPPORTED_RELATIONS, WAYS, THEN, POLITE,
        GAP, ("and", "first", "to", "upright"),
    )
    for phrase in table
    for word in phrase.split()
)  # fmt: skip
"""Words that end a noun phrase."""
KNOWN = (
    "What is understood: put, pack, stack, push, move, take out of; in, on, next to, left of, "
    "right of, in front of, behind, 10 cm to the left; colours, small and large, all, both, "
    "numbers, it; and, then. For example: 'put the red cube into the box, then stack the small "
    "cube on the block'."
)


def tokens_of(text: str) -> list[Token]:
    """Cut an instruction into tokens."""
    if len(text) > MAX_CHARACTERS:
        message = f"the instruction has {len(text)} characters; {MAX_CHARACTERS} is the most."
        raise GroundingError("too_long", message)
    plain = unicodedata.normalize("NFKC", text).replace("’", "'").lower()
    for long, short in LONG_UNITS.items():
        plain = re.sub(rf"\b{long}\b", short, plain)
    return [_token(match) for match in _TOKEN.finditer(plain) if match.lastgroup != "space"]


def _token(match: re.Match[str]) -> Token:
    text = match[0]
    if match["unit"]:
        scale = UNITS_M[match["unit"]]
        low = float(match["low"]) * scale
        high = float(match["high"]) * scale if match["high"] else low
        return Token(text, length_m=(low, high))
    if match["number"]:
        return Token(text, number=int(text))
    return Token(text)


def printable(text: str) -> str:
    """A short, harmless form of what somebody wrote."""
    shown = "".join(sign if sign.isprintable() else " " for sign in text[:80])
    return " ".join(shown.split()) + ("..." if len(text) > 80 else "")
