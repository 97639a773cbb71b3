"""Replies of a model: text that nobody trusts becomes goals and constraints, or what is wrong.

Nothing in a reply is executed, formatted or trusted. It may name only what the scene has; what a
plan may touch follows from the goals by fixed rules.
"""

import json
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NoReturn

import numpy as np

from bridge.errors import UsageError
from bridge.geometry import se3
from bridge.task.check import nearest
from twin.plan.constrain.bodies import surface_points
from twin.plan.constrain.relations import PLACES
from twin.plan.constrain.schema import (
    MOST_PROBLEMS,
    Problems,
    Vocabulary,
    Where,
    find_problems,
    meaning_problems,
    printable,
    shown,
    told,
    values_of,
)
from twin.plan.problem import Problem, Vector

VERSION = 2
MAX_BYTES = 64 * 1024
MAX_DEPTH = 12
MAX_VALUES = 5000
OFF_OBJECT_M = 0.03
"""A keypoint of an object may be so far off the box around it."""
_MOST_DIGITS = 18
_HEADS = ("version", "goals", "cannot")
"""Keys by which an answer is told from other objects in a text."""


class ReplyError(UsageError):
    """A reply that cannot be used; lists what is wrong with it."""

    def __init__(self, *, problems: tuple[str, ...]) -> None:
        """Remember each problem with its place in the JSON."""
        self.problems = problems
        super().__init__(f"the model's reply cannot be used: {'; '.join(problems)}")


@dataclass(frozen=True, kw_only=True)
class Keypoint:
    """A named point of an object."""

    obj: str
    p_object_m: Vector


Keypoints = Mapping[str, Keypoint]


@dataclass(frozen=True, kw_only=True)
class Wish:
    """A constraint, and when it is to be kept."""

    when: str
    """``grasp``, ``carry``, ``release`` or ``always``."""
    moving: str | None
    """While this object is moved; None: while any is."""
    keep: Mapping[str, Any]


@dataclass(frozen=True, kw_only=True)
class Reply:
    """What a model asks for."""

    goals: tuple[Mapping[str, Any], ...] = ()
    """Constraints about where objects are at the end."""
    in_order: bool = False
    wishes: tuple[Wish, ...] = ()
    cannot: str = ""
    """Why it says that it cannot be done; empty: there are goals."""
    remarks: tuple[str, ...] = ()
    """What was passed over in the text."""


def read_reply(
    text: str | bytes, vocabulary: Vocabulary, problem: Problem, marks: Keypoints
) -> Reply:
    """Read what a reply asks for, if nothing in it is wrong.

    Prose and fences around it are passed over; of several answers the last one counts. Keypoints
    become points of their objects.
    """
    record, remarks = _answer_in(text)
    if problems := find_problems(record, "reply", vocabulary):
        raise ReplyError(problems=problems[:MOST_PROBLEMS])
    known, odd = _keypoints(record, problem, marks)
    if problems := told([*odd, *_contradictions(record, known)]):
        raise ReplyError(problems=problems)
    if "cannot" in record:
        return Reply(cannot=printable(record["cannot"]))
    wishes = (
        Wish(when=each["when"], moving=each.get("moving"), keep=_resolved(each["keep"], known))
        for each in record.get("constraints", ())
    )
    return Reply(
        goals=tuple(record["goals"]),
        in_order=record.get("in_order", False),
        wishes=tuple(wishes),
        remarks=remarks,
    )


def _answer_in(text: str | bytes) -> tuple[Any, tuple[str, ...]]:
    """The answer in a text, and what was passed over."""
    plain = _limited(text)
    try:
        return _parsed(plain), ()
    except ValueError as error:
        why = f"is not JSON: {error}"
    found = []
    for begin, end in _objects(plain):
        try:
            record = _parsed(plain[begin:end])
        except ValueError as error:
            why = f"is not JSON: {error}"
            continue
        if any(head in record for head in _HEADS):
            found.append(record)
    if not found:
        _refuse(why)
    several = f"the last of {len(found)} answers in one reply was read"
    return found[-1], (several,) if any(each != found[-1] for each in found) else ()


def _limited(text: str | bytes) -> str:
    try:
        data = text.encode() if isinstance(text, str) else text
        if len(data) > MAX_BYTES:
            _refuse(f"is {len(data)} bytes long; at most {MAX_BYTES} are read")
        plain = data.decode()
    except UnicodeError:
        _refuse("is not text in UTF-8")
    if plain.count("[") + plain.count("{") > MAX_VALUES:
        _refuse(f"has more than {MAX_VALUES} lists and objects")
    depth = 0
    for token in _TOKEN.finditer(plain):
        depth += {"[": 1, "{": 1, "]": -1, "}": -1}.get(token[0], 0)
        if depth > MAX_DEPTH:
            _refuse(f"is nested more than {MAX_DEPTH} deep")
    return plain


_SURROGATE = re.compile("[\ud800-\udfff]")
_BRACE = re.compile(r"{")
_TOKEN = re.compile(r'"(?:[^"\\]|\\.)*+(?:"|\Z|\\\Z)|[\[\]{}]', re.DOTALL)
"""Strings, so that brackets in them do not count, and brackets; never looks back."""


def _objects(plain: str) -> Iterator[tuple[int, int]]:
    """Where objects begin and end that lie in no other; a quote in prose is none of JSON's."""
    depth, begin, at = 0, 0, 0
    while match := (_TOKEN if depth else _BRACE).search(plain, at):
        at = match.end()
        if match[0] == "{":
            begin = begin if depth else match.start()
            depth += 1
        elif match[0] == "}":
            depth -= 1
            if not depth:
                yield begin, at


def _parsed(text: str) -> Any:
    """Parse JSON; a number that is none becomes text, a key that comes twice an unknown one."""
    try:
        return json.loads(
            text, parse_constant=str, parse_float=_float, parse_int=_int, object_pairs_hook=_object
        )
    except RecursionError:  # brackets that a quote in prose hid from the count
        _refuse(f"is nested more than {MAX_DEPTH} deep")


def _refuse(found: str) -> NoReturn:
    raise ReplyError(problems=(f"top level: {found}",))


def _float(digits: str) -> float | str:
    number = float(digits)
    return number if math.isfinite(number) else digits


def _int(digits: str) -> int | str:
    return int(digits) if len(digits) <= _MOST_DIGITS else digits


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Text with half of a character becomes nothing."""
    names = [key.encode(errors="backslashreplace").decode() for key, _ in pairs]
    record = {
        name: None if isinstance(value, str) and _SURROGATE.search(value) else value
        for name, (_, value) in zip(names, pairs, strict=True)
    }
    twice = [name for name in record if names.count(name) > 1] if len(record) < len(pairs) else []
    return record | {f"{name}, more than once": None for name in twice}


def _keypoints(
    record: Mapping[str, Any], problem: Problem, marks: Keypoints
) -> tuple[dict[str, Keypoint], list[tuple[Where, str]]]:
    """The marks and what a reply names besides, in the frames of their objects."""
    known, odd = dict(marks), list[tuple[Where, str]]()
    for number, item in enumerate(record.get("keypoints", ())):
        where, name, obj = ("keypoints", number), item["name"], item["obj"]
        T = problem.scene.Ts_base_object.get(obj)
        if name in known:
            odd.append(((*where, "name"), f"there is a keypoint {shown(name)} already"))
        elif T is None:
            odd.append(((*where, "obj"), f"nobody knows where {obj} is"))
        else:
            p_object = se3.apply(se3.invert(T), np.array(item["xyz"], dtype=np.float64))
            surface = surface_points(problem, obj)
            low, high = surface.min(axis=0) - OFF_OBJECT_M, surface.max(axis=0) + OFF_OBJECT_M
            if ((p_object < low) | (p_object > high)).any():
                odd.append(((*where, "xyz"), f"is not on {obj}, which is at {_metres(T[:3, 3])}"))
            known[name] = Keypoint(obj=obj, p_object_m=p_object)
    return known, odd


def _metres(p_m: Vector) -> str:
    return "[" + ", ".join(f"{value:.3f}" for value in p_m) + "]"


def _contradictions(record: Mapping[str, Any], known: Keypoints) -> Problems:
    """What is wrong with a reply of the right form."""
    if "cannot" in record:
        for key in ("goals", "constraints"):
            if key in record:
                yield ("cannot",), f"says that it cannot be done, and {key} say what to do"
        return
    for number, goal in enumerate(record["goals"]):
        yield from meaning_problems(goal, ("goals", number))
    for number, wish in enumerate(record.get("constraints", ())):
        where, keep = ("constraints", number, "keep"), wish["keep"]
        unknown = [name for name in values_of(keep, ("keypoint",)) if name not in known]
        for name in unknown:
            near = nearest(name, known)
            yield where, f"keypoint {shown(name)} is unknown. Known: {', '.join(known)}.{near}"
        if unknown:
            continue
        yield from meaning_problems(_resolved(keep, known), where)
        if keep["kind"] in PLACES:
            yield (*where, "kind"), "where objects end is said by goals"
        if keep["kind"] == "speed" and wish["when"] in ("grasp", "release"):
            yield ("constraints", number, "when"), "speed is about a way: carry or always"


def _resolved(record: Mapping[str, Any], known: Keypoints) -> dict[str, Any]:
    """A constraint whose keypoints are points of their objects."""
    found = {
        key: _resolved(value, known) if isinstance(value, Mapping) else value
        for key, value in record.items()
    }
    if "keypoint" not in record:
        return found
    del found["keypoint"]
    point = known[record["keypoint"]]
    offset = point.p_object_m + np.array(found.get("offset", (0.0, 0.0, 0.0)))
    offset_m = [round(value, 4) for value in offset.tolist()]
    return {"obj": point.obj, "anchor": "origin", "offset": offset_m}
