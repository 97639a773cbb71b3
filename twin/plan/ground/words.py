"""The closed words of the grammar, and how an instruction is cut into words.

Nouns and colours are those of the scene and of the lexicon (``twin.naming.words``).
"""

import re
import unicodedata
from dataclasses import dataclass

from twin.plan.ground.vocabulary import refuse

MAX_CHARACTERS = 2000


@dataclass(frozen=True)
class Token:
    """One word, number, length or sign of an instruction."""

    text: str
    """In lower case."""
    number: int | None = None
    length_m: tuple[float, float] | None = None
    """Least and greatest; equal where one number is given."""


_COUNTED = "one two three four five six seven eight nine ten eleven twelve"
NUMBERS = {word: number for number, word in enumerate(_COUNTED.split(), start=1)}
UNITS_M = {"mm": 1e-3, "mi": 1e-3, "cm": 1e-2, "ce": 1e-2, "m": 1.0, "me": 1.0}
"""By how a unit begins."""
_TOKEN = re.compile(
    r"(?P<low>\d+(?:\.\d+)?)(?:\s*(?:-|–|to)\s*(?P<high>\d+(?:\.\d+)?))?\s*"
    r"(?P<unit>mm|cm|m|(?:milli|centi)?met(?:er|re)s?)\b"
    r"|(?P<number>\d{1,6})(?![\w.]\w)"
    r"|(?P<word>[^\W\d][\w'-]*)"
    r"|(?P<space>\s+|[\"“”])"
    r"|(?P<other>.)"
)

_PUT = "put place set lay drop throw bring insert arrange leave get keep pop position store"
VERBS = {"pack": "pack", "stack": "stack"} | dict.fromkeys(_PUT.split(), "put")
VERBS |= dict.fromkeys(("move", "push", "slide"), "move")
VERBS |= dict.fromkeys(("take", "remove", "grab", "pick up"), "take")
CARRIED = ("push", "slide", "throw", "drop")
"""Verbs whose manner is not kept, which is said."""
_BESIDE = [f"{way}{{}}{end} of" for way in ("", "to the ", "on the ") for end in ("", " side")]
RELATIONS = {
    **dict.fromkeys(("in", "into", "in to", "inside"), "inside"),
    **dict.fromkeys(("on", "onto", "on to", "on top of", "atop"), "on"),
    **dict.fromkeys(("beside", "next to"), "beside"),
    **{words.format(side): side for side in ("left", "right") for words in _BESIDE},
    "in front of": "in_front",
    "behind": "behind",
    **dict.fromkeys(("out of", "from"), "outside"),
}
"""Where something belongs, by the words before what it is relative to."""
WAYS = {
    **{f"{before}{side}": side for side in ("left", "right") for before in ("", "to the ")},
    **{f"{way}{s}": f"{way}s" for way in ("forward", "backward") for s in ("", "s")},
}
PHRASES = {
    phrase: letter
    for letter, phrases in {
        "V": VERBS, "R": RELATIONS, "W": WAYS, "U": ("upright",), "A": ("and",), "O": ("to",),
        "T": ("then", "after that", "afterwards", "finally"), "F": ("first",), "B": ("by",),
        "P": ("please", "could you", "can you", "would you", "i want"),
        "E": ("goes", "go", "belongs", "belong"), "G": ("with a gap of", "with gaps of"),
        "S": ",.;:!?",
    }.items()
    for phrase in phrases
}  # fmt: skip
"""What each fixed phrase is in a clause; besides, a noun phrase is N and a length L."""
PRONOUNS = ("it", "them")
SIZES = {"small": -1, "little": -1, "tiny": -1, "large": 1, "big": 1}
TABLES = ("table", "desk")
NEGATIONS = ("no", "not", "never", "dont", "without", "except", "nothing", "neither", "nor")
CLOSED = frozenset(word for phrase in PHRASES for word in phrase.split())
"""Words that end a noun phrase."""


def tokens_of(text: str) -> list[Token]:
    """Cut an instruction into tokens."""
    if len(text) > MAX_CHARACTERS:
        message = f"the instruction has {len(text)} characters; {MAX_CHARACTERS} is the most."
        refuse("too_long", message)
    plain = unicodedata.normalize("NFKC", text).replace("’", "'").lower()
    return [_token(match) for match in _TOKEN.finditer(plain) if match.lastgroup != "space"]


def _token(match: re.Match[str]) -> Token:
    if match["unit"]:
        scale = UNITS_M[match["unit"][:2]]
        low, high = (float(match[name] or match["low"]) * scale for name in ("low", "high"))
        return Token(match[0], length_m=(low, high))
    return Token(match[0], number=int(match[0]) if match["number"] else NUMBERS.get(match[0]))
