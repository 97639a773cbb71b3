"""Replies of a model: text that nobody trusts becomes stages, or a list of what is wrong with it.

Nothing in a reply is executed, formatted or trusted. What a plan may touch and what counts as
success come from the task file; a reply that allows or asks for anything else is refused.
"""

import json
import math
import re
from collections.abc import Mapping
from typing import Any, NoReturn

from bridge.errors import UsageError
from bridge.task.plan import Stage
from twin.plan.constrain.schema import (
    MOST_PROBLEMS,
    Problems,
    Repeated,
    Unreadable,
    Vocabulary,
    find_problems,
    meaning_problems,
    printable,
    shown,
    told,
)

MAX_BYTES = 64 * 1024
MAX_DEPTH = 12
MAX_VALUES = 5000
MAX_CONSTRAINTS = 16
"""Of one stage, subgoal and path together."""
_MOST_DIGITS = 18


class ReplyError(UsageError):
    """A reply that cannot be used; lists what is wrong with it."""

    def __init__(self, *, problems: tuple[str, ...]) -> None:
        """Remember each problem with its place in the JSON."""
        self.problems = problems
        listed = "\n".join(f"  {text}" for text in problems)
        super().__init__(f"the model's reply cannot be used:\n{listed}")


def read_reply(text: str | bytes, vocabulary: Vocabulary, task: str) -> tuple[Stage, ...]:
    """Read the stages of a reply, if nothing in it is wrong.

    A reply to another instruction is refused. The stages have no times, and printable texts.
    """
    record = parse_strictly(text)
    problems = find_problems(record, "reply", vocabulary)
    if not problems:
        problems = told(_contradictions(record, vocabulary, task))
    if problems:
        raise ReplyError(problems=problems[:MOST_PROBLEMS])
    return tuple(_stage(stage) for stage in record["stages"])


def parse_strictly(text: str | bytes) -> Any:
    """Parse JSON that is short and flat; odd numbers and repeated keys are kept to be named."""
    try:
        data = text.encode() if isinstance(text, str) else text
        if len(data) > MAX_BYTES:
            _refuse(f"is {len(data)} bytes long; at most {MAX_BYTES} are read")
        plain = data.decode()
    except UnicodeError:
        _refuse("is not text in UTF-8")
    if plain.count("[") + plain.count("{") > MAX_VALUES:
        _refuse(f"has more than {MAX_VALUES} lists and objects")
    if _is_deep(plain):
        _refuse(f"is nested more than {MAX_DEPTH} deep")
    try:
        return json.loads(
            plain,
            parse_constant=Unreadable,
            parse_float=_float,
            parse_int=_int,
            object_pairs_hook=_object,
        )
    except ValueError as error:
        _refuse(f"is not JSON: {error}")


def _refuse(found: str) -> NoReturn:
    raise ReplyError(problems=(f"top level: {found}",))


def _float(digits: str) -> float | Unreadable:
    number = float(digits)
    return number if math.isfinite(number) else Unreadable(digits)


def _int(digits: str) -> int | Unreadable:
    return int(digits) if len(digits) <= _MOST_DIGITS else Unreadable(digits)


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    record = dict(pairs)
    return record if len(record) == len(pairs) else Repeated(pairs)


_TOKEN = re.compile(r'"(?:[^"\\]|\\.)*+(?:"|\Z|\\\Z)|[\[\]{}]', re.DOTALL)
"""Strings, so that brackets in them do not count, and brackets; never looks back."""


def _is_deep(text: str) -> bool:
    depth = 0
    for token in _TOKEN.finditer(text):
        first = text[token.start()]
        if first in "[{":
            depth += 1
            if depth > MAX_DEPTH:
                return True
        elif first in "]}":
            depth -= 1
    return False


def _contradictions(record: Mapping[str, Any], vocabulary: Vocabulary, task: str) -> Problems:
    """What is wrong with a reply of the right form."""
    if _plain_words(record["task"]) != _plain_words(task):
        yield ("task",), f"{shown(record['task'])} was not asked; the task is {shown(task)}"
    seen: set[str] = set()
    for index, stage in enumerate(record["stages"]):
        where = ("stages", index)
        if stage["id"] in seen:
            yield (*where, "id"), f"there is a stage {shown(stage['id'])} already"
        seen.add(stage["id"])
        count = len(stage["subgoal"]) + len(stage["path"])
        if count > MAX_CONSTRAINTS:
            yield where, f"has {count} constraints; at most {MAX_CONSTRAINTS} are allowed"
        for key in ("subgoal", "path"):
            for number, constraint in enumerate(stage[key]):
                yield from meaning_problems(constraint, (*where, key, number))
                if key == "subgoal" and constraint["kind"] == "speed":
                    yield (*where, key, number), "speed is about a path and belongs to path"
    yield from _hand(record["stages"])
    yield from _contacts(record["stages"], vocabulary)


def _plain_words(text: str) -> list[str]:
    return text.casefold().rstrip(" .!").split()


def _hand(stages: list[dict[str, Any]]) -> Problems:
    """Follow what the hand holds: one thing at a time, released where it is held."""
    held: str | None = None
    for index, stage in enumerate(stages):
        grasped, released = stage.get("grasp"), stage.get("release")
        if grasped is not None and released is not None:
            yield ("stages", index), "grasps and releases; make it two stages"
            return
        if grasped is not None:
            if held is not None:
                yield ("stages", index, "grasp"), f"the hand holds {held} already"
            held = grasped
        if released is not None:
            if held != released:
                holds = f"the hand holds {held}" if held else "the hand is empty"
                yield ("stages", index, "release"), f"{released} is not held here: {holds}"
            held = None
    if held is not None:
        yield ("stages", len(stages) - 1), f"{held} is never released"


def _contacts(stages: list[dict[str, Any]], vocabulary: Vocabulary) -> Problems:
    held: str | None = None
    for index, stage in enumerate(stages):
        held = stage.get("grasp") or held
        for number, pair in enumerate(stage["allowed_contacts"]):
            where = ("stages", index, "allowed_contacts", number)
            allowed = vocabulary.allowed_contacts
            if pair[0] == pair[1]:
                yield where, f"{pair[0]} cannot touch itself"
            elif allowed is not None and frozenset(pair) not in allowed:
                yield where, f"the task never lets {pair[0]} touch {pair[1]}"
            elif allowed is None and held not in pair:
                yield where, f"is not about what the hand holds here ({held or 'nothing'})"
        if stage.get("release"):
            held = None


def _stage(record: Mapping[str, Any]) -> Stage:
    return Stage(
        id=printable(record["id"]),
        text=printable(record["text"]),
        subgoal=tuple(record["subgoal"]),
        path=tuple(record["path"]),
        grasp=record.get("grasp"),
        release=record.get("release"),
        allowed_contacts=tuple((a, b) for a, b in record["allowed_contacts"]),
    )
