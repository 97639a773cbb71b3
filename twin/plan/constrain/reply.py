"""Replies of a model: text that nobody trusts becomes goals and constraints, or what is wrong.

Nothing in a reply is executed, formatted or trusted. It may name only what the scene has; what a
plan may touch follows from the goals by fixed rules.
"""

import json
import math
import re
from collections.abc import Iterator, Mapping
from typing import Any, NoReturn

import numpy as np

from bridge.errors import UsageError
from bridge.geometry import se3
from bridge.task.check import nearest
from twin.plan.constrain.bodies import Record, surface_points
from twin.plan.constrain.schema import (
    Vocabulary,
    find_problems,
    listed,
    meaning_problems,
    shown,
    values_of,
)
from twin.plan.problem import Problem, Vector

VERSION = 3
MAX_BYTES = 64 * 1024
MAX_DEPTH = 12
MOST_TRIES = 20
"""Braces in a reply at which an answer may begin."""
OFF_OBJECT_M = 0.03
"""A keypoint of an object may be so far off the box around it."""
PLACES = ("inside", "on", "outside", "beside", "between", "moved")
_HEADS = ("version", "goals", "cannot")
"""Keys by which an answer is told from other objects in a text."""
_EARLIER = "an earlier form. Say version 3: object for obj, direction for way, metres and radians"


class ReplyError(UsageError):
    """A reply that cannot be used; lists what is wrong with it."""

    def __init__(self, *, problems: tuple[str, ...]) -> None:
        """Remember each problem with its place in the JSON."""
        self.problems = problems
        super().__init__(f"the model's reply cannot be used: {'; '.join(problems)}")


Keypoints = Mapping[str, Record]
"""Named points of objects, as constraints say points."""


def read_reply(
    text: str | bytes, vocabulary: Vocabulary, problem: Problem, marks: Keypoints
) -> tuple[Record, tuple[str, ...]]:
    """Read what a reply asks for, if nothing in it is wrong, and say what was passed over.

    Prose and fences around it are passed over; of several answers the last one counts. Keypoints
    become points of their objects.
    """
    record, remarks = _answer_in(text)
    if record.get("version") in (1, 2):
        _refuse(f"version {record['version']:g} is {_EARLIER}")
    if problems := find_problems(record, "reply", vocabulary):
        raise ReplyError(problems=problems)
    known, odd = _keypoints(record, problem, marks)
    if problems := listed([*odd, *_contradictions(record, known)]):
        raise ReplyError(problems=problems)
    wishes = record.get("constraints", ())
    kept = [{**wish, "keep": _resolved(wish["keep"], known)} for wish in wishes]
    return {**record, "constraints": kept}, remarks


def _answer_in(text: str | bytes) -> tuple[dict[str, Any], tuple[str, ...]]:
    """The answer in a text, and what was passed over."""
    try:
        data = text.encode() if isinstance(text, str) else text
        plain = data.decode()
    except UnicodeError:
        _refuse("is not text in UTF-8")
    if len(data) > MAX_BYTES:
        _refuse(f"is {len(data)} bytes long; at most {MAX_BYTES} are read")
    found, why, at, tries = list[dict[str, Any]](), "", plain.find("{"), 0
    while at >= 0 and tries < MOST_TRIES:
        tries += 1
        try:
            record, end = _DECODER.raw_decode(plain, at)
            _refuse_deep(plain[at:end])
            json.dumps(record, ensure_ascii=False).encode()  # half a character is no text
        except ValueError as error:
            why, end = why or f": {error}", at + 1
        except RecursionError:
            _refuse(f"is nested more than {MAX_DEPTH} deep")
        else:
            found += [record] if any(head in record for head in _HEADS) else []
        at = plain.find("{", end)
    if not found:
        _refuse(f"is not JSON with {' or '.join(_HEADS[1:])}{why}")
    several = f"the last of {len(found)} answers in one reply was read"
    return found[-1], (several,) if any(each != found[-1] for each in found) else ()


_TOKEN = re.compile(r'"(?:[^"\\]|\\.)*+"|[\[\]{}]')
"""Strings, so that brackets in them do not count, and brackets; never looks back."""


def _refuse_deep(text: str) -> None:
    depth = 0
    for token in _TOKEN.findall(text):
        depth += {"[": 1, "{": 1, "]": -1, "}": -1}.get(token, 0)
        if depth > MAX_DEPTH:
            raise RecursionError


def _refuse(found: str) -> NoReturn:
    raise ReplyError(problems=listed([f"top level: {found}"]))


def _number(digits: str) -> float | str:
    """A number, or text where it is too large to be one."""
    number = float(digits)
    return number if math.isfinite(number) else digits


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object; a key that comes twice makes an unknown one."""
    twice = {"a key more than once": None}
    return dict(pairs) | (twice if len(dict(pairs)) < len(pairs) else {})


_DECODER = json.JSONDecoder(
    parse_constant=str, parse_float=_number, parse_int=_number, object_pairs_hook=_object
)


def _keypoints(
    record: Record, problem: Problem, marks: Keypoints
) -> tuple[dict[str, Record], list[str]]:
    """The marks and what a reply names besides, in the frames of their objects."""
    known, odd = dict(marks), list[str]()
    for number, item in enumerate(record.get("keypoints", ())):
        where, name, key = f"keypoints[{number}]", item["name"], item["object"]
        T = problem.scene.Ts_base_object.get(key)
        if name in known:
            odd.append(f"{where}.name: there is a keypoint {shown(name)} already")
        elif T is None:
            odd.append(f"{where}.object: nobody knows where {key} is")
        else:
            p_object = se3.apply(se3.invert(T), np.array(item["xyz"], dtype=np.float64))
            surface = surface_points(problem, key)
            low, high = surface.min(axis=0) - OFF_OBJECT_M, surface.max(axis=0) + OFF_OBJECT_M
            if ((p_object < low) | (p_object > high)).any():
                there = T[:3, 3].round(3).tolist()
                odd.append(f"{where}.xyz: is not on {key}, which is at {there}")
            known[name] = keypoint(key, p_object)
    return known, odd


def keypoint(object_id: str, p_object_m: Vector) -> Record:
    """A point of an object, as constraints say it."""
    return {"object": object_id, "anchor": "origin", "offset": p_object_m.round(4).tolist()}


def _contradictions(record: Record, known: Keypoints) -> Iterator[str]:
    """What is wrong with a reply of the right form."""
    if "cannot" in record:
        for key in ("goals", "constraints"):
            if key in record:
                yield f"cannot: says that it cannot be done, and {key} say what to do"
        return
    for number, goal in enumerate(record["goals"]):
        yield from meaning_problems(goal, f"goals[{number}]")
    for number, wish in enumerate(record.get("constraints", ())):
        where, keep = f"constraints[{number}].keep", wish["keep"]
        unknown = [name for name in values_of(keep, ("keypoint",)) if name not in known]
        for name in unknown:
            near = nearest(name, known)
            yield f"{where}: keypoint {shown(name)} is unknown. Known: {', '.join(known)}.{near}"
        if unknown:
            continue
        yield from meaning_problems(_resolved(keep, known), where)
        if keep["kind"] in PLACES:
            yield f"{where}.kind: where objects end is said by goals"
        if keep["kind"] == "speed" and wish["when"] in ("grasp", "release"):
            yield f"constraints[{number}].when: speed is about a way: carry or always"


def _resolved(record: Record, known: Keypoints) -> dict[str, Any]:
    """A constraint whose keypoints are points of their objects."""
    found = {
        key: _resolved(value, known) if isinstance(value, Mapping) else value
        for key, value in record.items()
    }
    if "keypoint" not in record:
        return found
    point, more = known[record["keypoint"]], found.get("offset", (0.0, 0.0, 0.0))
    return dict(keypoint(point["object"], np.array(point["offset"]) + more))
