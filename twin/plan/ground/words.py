"""The closed words of the grammar: verbs, relations, directions, quantifiers, and how text is cut.

Open words, nouns and adjectives, are the lexicon's: ``twin.scene.semantics.language``.
"""

import re
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from twin.plan.ground.vocabulary import GroundingError


def word_set(text: str) -> frozenset[str]:
    """The words of a text, to ask whether one is among them."""
    return frozenset(text.split())


MAX_CHARACTERS = 2000
"""Of an instruction."""
MAX_WORDS = 300
WORD, NUMBER, LENGTH, COMMA, STOP, OTHER = "word", "number", "length", "comma", "stop", "other"


@dataclass(frozen=True)
class Token:
    """One word, number, length or sign of an instruction."""

    kind: str
    text: str
    """In lower case."""
    value: tuple[float, float] = (0.0, 0.0)
    """Of a number or a length [m]: least and most; equal where one number is given."""


UNITS_M = {
    "mm": 1e-3, "millimetre": 1e-3, "millimetres": 1e-3, "millimeter": 1e-3, "millimeters": 1e-3,
    "cm": 1e-2, "centimetre": 1e-2, "centimetres": 1e-2, "centimeter": 1e-2, "centimeters": 1e-2,
    "m": 1.0, "metre": 1.0, "metres": 1.0, "meter": 1.0, "meters": 1.0,
    "inch": 0.0254, "inches": 0.0254,
}  # fmt: skip
_COUNTED = (
    "zero one two three four five six seven eight nine ten eleven twelve thirteen fourteen "
    "fifteen sixteen seventeen eighteen nineteen twenty"
)
NUMBERS = {word: number for number, word in enumerate(_COUNTED.split())} | {
    "thirty": 30,
    "forty": 40,
    "fifty": 50,
    "hundred": 100,
    "dozen": 12,
}
_NUMBER = r"\d+(?:[.,]\d+)?"
_TOKEN = re.compile(
    rf"(?P<range>({_NUMBER})\s*(?:-|–|to)\s*({_NUMBER})\s*(?P<range_unit>{'|'.join(UNITS_M)})\b)"
    rf"|(?P<length>({_NUMBER})\s*-?(?P<unit>{'|'.join(UNITS_M)})\b)"
    rf"|(?P<number>{_NUMBER}(?![\w]))"
    r"|(?P<possessive>'s\b|(?<=s)'(?=\s))"
    r"|(?P<word>[^\W\d_][\w]*(?:-\w+)*)"
    r"|(?P<comma>,)|(?P<stop>[.;:!?]+)|(?P<space>\s+|[\"“”‘])|(?P<other>.)",
    re.DOTALL,
)
CONTRACTIONS = {
    "don't": "do not", "dont": "do not", "doesn't": "does not", "can't": "can not",
    "cannot": "can not", "mustn't": "must not", "shouldn't": "should not", "won't": "will not",
    "isn't": "is not", "aren't": "are not", "i'd": "i would", "let's": "let us",
    "you're": "you are", "it's": "it is", "i'm": "i am", "that's": "that is",
    "couldn't": "could not", "i'll": "i will", "they're": "they are",
}  # fmt: skip


def tokens_of(text: str) -> list[Token]:
    """Cut an instruction into tokens.

    Raises:
        GroundingError: When it says nothing, or is too long to be an instruction.
    """
    if len(text) > MAX_CHARACTERS:
        message = f"the instruction has {len(text)} characters; {MAX_CHARACTERS} is the most."
        raise GroundingError("too_long", message)
    plain = unicodedata.normalize("NFKC", text).replace("’", "'").lower()
    plain = re.sub(r"[a-z]+'[a-z]+", lambda m: CONTRACTIONS.get(m[0], m[0]), plain)
    plain = re.sub(r"\b(?:dont|cannot)\b", lambda m: CONTRACTIONS[m[0]], plain)
    tokens = [_token(match) for match in _TOKEN.finditer(plain) if match.lastgroup != "space"]
    tokens = _spelled_lengths(tokens)
    if len(tokens) > MAX_WORDS:
        message = f"the instruction has {len(tokens)} words; {MAX_WORDS} is the most."
        raise GroundingError("too_long", message)
    if not any(token.kind in (WORD, NUMBER, LENGTH) for token in tokens):
        if any(token.kind == OTHER for token in tokens):
            message = f"{printable(text)!r} has no word in it."
            raise GroundingError("unknown_clause", message)
        raise GroundingError("empty", "the instruction is empty. Say what is to be done.")
    return tokens


def printable(text: str) -> str:
    """A short, harmless form of what somebody wrote."""
    shown = "".join(sign if sign.isprintable() else " " for sign in text[:80])
    return " ".join(shown.split()) + ("..." if len(text) > 80 else "")


def _token(match: re.Match[str]) -> Token:
    text = match[0]
    if match["range"]:
        low, high, scale = match[2], match[3], UNITS_M[match["range_unit"]]
        return Token(LENGTH, text, (_number(low) * scale, _number(high) * scale))
    if match["length"]:
        value = _number(re.match(_NUMBER, text)[0]) * UNITS_M[match["unit"]]  # type: ignore[index]
        return Token(LENGTH, text, (value, value))
    if match["number"]:
        return Token(NUMBER, text, (_number(text), _number(text)))
    if match["comma"]:
        return Token(COMMA, text)
    if match["stop"]:
        return Token(STOP, text)
    return Token(WORD if match["word"] or match["possessive"] else OTHER, text)


def _number(text: str) -> float:
    return float(text.replace(",", "."))


def _spelled_lengths(tokens: Sequence[Token]) -> list[Token]:
    """Join "five", "cm" into a length; "two ducks" stays."""
    joined: list[Token] = []
    for token in tokens:
        if token.kind == WORD and token.text in UNITS_M and joined:
            before = joined[-1]
            number: float | None = NUMBERS.get(before.text)
            if before.kind == NUMBER:
                number = before.value[0]
            elif before.text in ("a", "an"):
                number = 1.0
            if number is not None and (before.text not in ("a", "an") or token.text != "m"):
                length = number * UNITS_M[token.text]
                joined[-1] = Token(LENGTH, f"{before.text} {token.text}", (length, length))
                continue
        joined.append(token)
    return joined


class Phrases:
    """Finds the longest phrase of a table that begins at some word."""

    def __init__(self, table: Mapping[str, str]) -> None:
        """Sort the phrases by their first word, longest first.

        Args:
            table: Meaning by phrase.
        """
        self._by_first: dict[str, list[tuple[tuple[str, ...], str]]] = {}
        for phrase, meaning in table.items():
            words = tuple(phrase.split())
            self._by_first.setdefault(words[0], []).append((words, meaning))
        for found in self._by_first.values():
            found.sort(key=lambda item: -len(item[0]))

    def match(self, tokens: Sequence[Token], at: int) -> tuple[str, int] | None:
        """The meaning of the phrase that begins here, and where it ends; None: there is none."""
        if at >= len(tokens):
            return None
        for words, meaning in self._by_first.get(tokens[at].text, ()):
            part = tokens[at : at + len(words)]
            if len(part) == len(words) and all(
                token.text == word for token, word in zip(part, words, strict=True)
            ):
                return meaning, at + len(words)
        return None


def _all(meaning: str, phrases: Iterable[str]) -> dict[str, str]:
    return dict.fromkeys(phrases, meaning)


def _forms(meaning: str, verbs: str) -> dict[str, str]:
    """A verb, and what "she ..." and "... is" make of it."""
    found = {}
    for verb in verbs.split(","):
        first, _, rest = verb.strip().partition(" ")
        stem = first[:-1] if first.endswith("e") else first
        doubled = first + first[-1]
        for form in (first, f"{first}s", f"{first}es", f"{stem}ing", f"{doubled}ing"):
            found[f"{form} {rest}".strip()] = meaning
    return found


VERBS = Phrases(
    _forms(
        "put",
        "put, put down, put back, place, set, set down, lay, lay down, drop, drop off, throw, "
        "toss, bring, carry, position, deposit, insert, transfer, transport, stick, pop, relocate, "
        "return, leave, rest, pull, get, slip, load, locate, arrange, organise, organize, "
        "distribute, gather, collect, dump, slot, plop, stand, park, deliver",
    )
    | _forms("move", "move, shift, push, slide, nudge, shove, drag")
    | _forms(
        "take",
        "take, take out, grab, grab hold of, grasp, grip, pick, pick up, seize, remove, extract, "
        "fetch, retrieve, hold, lift, lift up, unload, get hold of, take hold of",
    )
    | _forms("pack", "pack, pack up, store, stow, stow away, put away, tidy up, tidy away, stash")
    | _forms("stack", "stack, stack up, pile, pile up")
    | _forms("build", "build, make, create, form, construct")
    | _forms("sort", "sort, separate")
    | _forms("align", "align, line up")
    | _forms("empty", "empty")
    | {"laid": "put", "placed": "put", "moved": "move", "stacked": "stack", "packed": "pack"}
)
"""Verbs by what they ask for; only at the beginning of a clause."""
THROWN = ("throw", "toss", "drop", "dump", "plop")
PUSHED = ("push", "slide", "nudge", "shove", "drag", "pull")
UNSUPPORTED_VERBS = word_set(
    "pour hand give pass show open close shut spin rotate turn flip twist tilt roll shake stir "
    "clean wash cut slice fold unfold press squeeze poke hit kick point look watch find count "
    "screw unscrew plug unplug fill water cook eat swap exchange switch wave dance hug "
    "balance juggle catch bend break crush smash paint draw write hang tie connect attach detach "
    "wipe sweep scan measure weigh touch knock tap tip raise lower hover feed sell buy throw-away "
    "bounce mix assemble disassemble straighten cover wrap unwrap unpack clear scoop"
)
"""Verbs that are understood and that nobody here can do."""
RELATIONS = Phrases(
    _all(
        "inside",
        ("in", "into", "inside", "inside of", "in to", "within", "to the inside of", "down into",
         "back in", "back into", "down in", "over into", "inside into"),
    )
    | _all(
        "on",
        ("on", "onto", "on to", "on top of", "upon", "atop", "down on", "down onto", "back on",
         "back onto", "back on top of", "to the top of", "over onto", "on the top of"),
    )
    | _all(
        "beside",
        ("next to", "beside", "besides", "near", "near to", "close to", "adjacent to",
         "alongside", "right next to", "directly next to", "to the side of", "at the side of",
         "right beside", "by the side of", "down next to", "side by side with", "nearby",
         "close by", "by"),
    )
    | {
        f"{before}{side}{behind}": side
        for side in ("left", "right")
        for before, behind in (
            ("", " of"), ("to the ", " of"), ("on the ", " of"), ("on the ", " side of"),
            ("on the ", "-hand side of"), ("to the ", " side of"), ("to the ", "-hand side of"),
            ("at the ", " of"), ("at the ", " side of"), ("immediately ", " of"), ("just ", " of"),
            ("directly to the ", " of"), ("immediately to the ", " of"), ("just to the ", " of"),
        )
    }
    | _all("in_front", ("in front of", "ahead of", "directly in front of", "just in front of"))
    | _all("behind", ("behind", "in back of", "directly behind", "just behind", "right behind"))
    | _all("between", ("between", "in between", "in the space between", "in the gap between"))
    | _all(
        "outside",
        ("out of", "outside", "outside of", "from out of", "from inside", "from inside of",
         "from within"),
    )
    | _all("off", ("off of", "off"))
    | {"from": "from"}
    | _all("to", ("to", "towards", "toward", "over to", "up to"))
    | {
        "away from": "away", "clear of": "away", "apart from": "away",
        "aligned with": "aligned", "parallel to": "aligned", "in line with": "aligned",
        "parallel with": "aligned", "lined up with": "aligned",
    }
    | _all(
        "unsupported",
        (
            "under", "underneath", "below", "beneath", "above", "over", "around", "through",
            "against", "at", "across", "along", "past", "opposite", "in the middle of",
            "in the centre of", "in the center of", "in the corner of", "at the edge of",
            "on the edge of", "in the middle between", "among", "opposite of", "on the side of",
            "at the corner of", "on the corner of", "onto the side of", "via", "about", "behind of",
        ),
    )
)  # fmt: skip
"""Prepositions by the relation they ask for."""
WAYS = Phrases(
    {
        f"{before}{side}{behind}": side
        for side in ("left", "right")
        for before, behind in (
            ("to the ", ""), ("", ""), ("", "ward"), ("", "wards"), ("towards the ", ""),
            ("toward the ", ""), ("to your ", ""), ("to the ", " side"), ("to the robot's ", ""),
            ("to the ", "-hand side"), ("further to the ", ""), ("further ", ""),
            ("over to the ", ""), ("a bit to the ", ""), ("to the robot 's ", ""),
        )
    }
    | _all(
        "forwards",
        ("forward", "forwards", "ahead", "away from the robot", "further away", "away from you",
         "away from yourself", "straight ahead", "straight forward", "to the front",
         "away from the robot base", "away from your base"),
    )
    | _all(
        "backwards",
        ("back", "backward", "backwards", "towards the robot", "toward the robot", "closer",
         "closer to the robot", "nearer to the robot", "nearer", "towards you", "toward you",
         "towards yourself", "to the back", "closer to you", "toward yourself"),
    )
    | _all(
        "vertical", ("up", "upward", "upwards", "down", "downward", "downwards", "higher", "lower")
    )
    | {f"{to} its {side}": f"its {side}" for to in ("to", "on") for side in ("left", "right")}
    | _all(
        "mine",
        ("to my left", "to my right", "towards me", "toward me", "away from me", "closer to me",
         "on my left", "on my right"),
    )
)  # fmt: skip
"""Directions of a movement, as the robot sees them."""
VIEWS = Phrases(
    _all(
        "camera",
        ("as seen from", "as seen by", "seen from", "seen by", "as viewed from", "viewed from",
         "as seen in", "seen in", "from the view of", "from the viewpoint of",
         "from the perspective of", "in the view of", "in the image of", "as viewed by",
         "from the point of view of", "in the frame of"),
    )
)  # fmt: skip
"""Words before the name of whoever looks."""
QUANTIFIERS = Phrases(
    _all("all", ("all", "all of", "all the", "every", "each", "each of", "every one of",
                 "each one of", "every single", "the whole set of", "all of the", "every last"))
    | _all("both", ("both", "both of", "both the", "both of the"))
    | _all("any", ("any", "any of", "either", "either of", "whichever", "any one of", "any one"))
    | _all("a", ("a", "an", "another"))
    | {"a couple of": "2", "a pair of": "2", "a dozen": "12", "the pair of": "2"}
    | _all("vague", ("some", "some of", "several", "several of", "many", "many of", "most",
                     "most of", "a few", "a few of", "few", "half", "half of", "half the",
                     "enough", "more", "various", "a number of", "half of the", "a bunch of"))
    | _all("other", ("the other", "the others", "the remaining", "the rest of", "the rest",
                     "all other", "all others", "all the others", "the other one",
                     "all remaining", "all the other", "every other"))
    | _all("the", ("the", "this", "that", "these", "those", "my", "your", "our", "its", "their"))
)  # fmt: skip
PRONOUNS = frozenset({"it", "them", "they", "itself", "themselves"})
EVERYTHING = frozenset({"everything", "everyone"})
SELECTORS = word_set(
    "first second third fourth fifth last next left right leftmost rightmost nearest closest "
    "farthest furthest nearer front back middle central top bottom upper lower same smaller larger "
    "smallest largest biggest tallest shortest heaviest lightest other wrong remaining bigger "
    "matching"
)
"""Adjectives that choose one of several: they are never passed over."""
EXTRA_COLOURS = word_set("transparent clear rainbow multicoloured multicolored")
LAYERS = Phrases(
    _all("bottom", ("on the bottom", "at the bottom", "at the base", "as the base", "lowest",
                    "on bottom", "as the bottom", "as base", "undermost", "first"))
    | _all("middle", ("in the middle", "in between", "second", "in the centre", "in the center"))
    | _all("top", ("on top", "on the top", "at the top", "at top", "topmost", "last", "uppermost",
                   "on the very top", "as the top", "above it", "on top of it", "on top of that"))
    | _all("upwards", ("from bottom to top", "from the bottom up", "from the bottom to the top",
                       "bottom to top", "from bottom up", "bottom up", "upwards", "from below"))
    | _all("downwards", ("from top to bottom", "from the top down", "top to bottom",
                         "from top down", "from the top to the bottom"))
)  # fmt: skip
"""Where in a tower something goes."""
POLITE = Phrases(
    _all(
        "",
        ("please", "kindly", "just", "now", "can you", "could you", "would you", "will you",
         "i want you to", "i would like you to", "i need you to", "you should", "you must",
         "you have to", "you need to", "go ahead and", "try to", "let us", "hey", "hello", "hi",
         "ok", "okay", "robot", "thanks", "thank you", "your task is to", "the task is to",
         "for me", "would you mind", "be so kind as to", "i want to", "your job is to", "well",
         "simply", "carefully now", "good morning", "dear robot", "so", "the goal is to",
         "we need to", "we want to", "you can", "start by", "begin by", "you shall", "also", "too",
         "thank you very much", "as well", "same for", "the following", "do the following"),
    )
)  # fmt: skip
"""Words without any effect."""
ENSURE = Phrases(
    _all(
        "",
        ("make sure that", "make sure", "ensure that", "ensure", "see that", "see to it that",
         "i want", "i would like", "i need", "we want", "we need", "let", "have", "be sure that",
         "check that", "so that", "such that"),
    )
)  # fmt: skip
"""Words before a state that is to be."""
BELONGS = Phrases(
    _all(
        "goes",
        ("goes", "go", "belongs", "belong", "should go", "should be", "must be", "must go",
         "has to be", "has to go", "have to be", "have to go", "needs to be", "needs to go",
         "need to be", "need to go", "should end up", "ends up", "end up", "ought to be",
         "shall be", "shall go", "should sit", "should stand", "should lie", "to go", "to be",
         "is to be",
         "are to be", "is to go", "are to go", "must end up", "should stay", "must stand",
         "should all be", "should all go", "must all be", "all go", "should come", "comes",
         "is supposed to be", "are supposed to be", "should rest", "needs to end up",
         "has to end up", "needs to sit", "should each be", "should each go"),
    )
    | _all("is", ("is", "are", "sits", "stands", "lies", "ends", "end", "be", "rests", "stand"))
)  # fmt: skip
"""Verbs of a sentence whose subject is the object; "is" only after ``ENSURE``."""
SEQUENCES = Phrases(
    _all(
        "then",
        ("then", "after that", "afterwards", "afterward", "next", "finally", "lastly", "secondly",
         "subsequently", "followed by", "when done", "once done", "when that is done", "after this",
         "thirdly", "second", "third", "at last", "in the end", "when you are done", "last"),
    )
    | _all("first", ("first", "firstly", "first of all", "to begin with", "initially"))
    | _all("before", ("before that", "but before that", "but first", "before doing so"))
)  # fmt: skip
"""Words that put clauses into an order; at their beginning."""
CONJUNCTIONS = Phrases(
    _all("and", ("and", "plus", "as well as", "along with", "together with", "&"))
)
CONDITIONS = word_set("if unless whenever when while-not provided whether otherwise except")
ALTERNATIVES = frozenset({"or", "nor", "either-or", "maybe", "perhaps"})
NEGATIONS = frozenset({"not", "never", "no", "none", "neither", "nothing", "nobody", "nowhere"})
QUESTIONS = word_set("what where who why how which whose is are does did was were has am")
ADVERBS = Phrases(
    _all("upright", ("upright", "standing upright", "standing up", "so that it stands upright",
                     "in an upright position", "so it stands upright", "right side up",
                     "the right way up", "vertically", "standing", "right way up",
                     "so that it is upright", "so it is upright", "in upright position"))
    | _all("slowly", ("slowly", "gently", "carefully", "softly", "with care", "cautiously"))
    | _all("fast", ("quickly", "fast", "as fast as you can", "swiftly", "rapidly", "immediately",
                    "right away", "at once", "as fast as possible", "as quickly as possible"))
    | _all("singly", ("one at a time", "one by one", "one after the other", "one after another",
                      "individually", "separately", "each in turn"))
    | _all("any order", ("in any order", "in whatever order", "in whichever order",
                         "the order does not matter", "in any sequence"))
    | _all("this order", ("in this order", "in that order", "in order", "in the given order"))
    | _all("again", ("again", "there", "here", "somewhere", "anywhere", "elsewhere", "away"))
    | _all("", ("only", "exactly", "directly", "completely", "fully", "neatly", "nicely", "safely",
                "properly", "correctly", "together", "please", "now", "as well", "too", "for me",
                "with the gripper", "with your gripper", "with the robot", "with the hand",
                "robot", "thanks", "thank you", "all the way", "straight", "down", "alone"))
)  # fmt: skip
"""What may stand beside the relations of a clause."""

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
GAP_WORDS = word_set("gap space distance between them clearance apart the two of spacing")
