"""Replies that a model should not have sent, and why each is refused: made from a valid one."""

import copy
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

BOTTOM, OPENING = {"object": "cube", "anchor": "bottom"}, {"object": "box", "anchor": "opening"}
ABOVE = {
    "kind": "above",
    "a": BOTTOM,
    "b": OPENING,
    "height": 0.02,
    "tolerance_m": 0.01,
    "aside_m": 0.03,
}


INSIDE = {"kind": "inside", "object": "cube", "container": "box"}


def valid_reply() -> dict[str, Any]:
    return copy.deepcopy(
        {
            "version": 3,
            "goals": [INSIDE],
            "keypoints": [{"name": "corner", "object": "cube", "xyz": [0.52, -0.13, 0.04]}],
            "constraints": [
                {"when": "release", "moving": "cube", "keep": ABOVE},
                {
                    "when": "carry",
                    "moving": "cube",
                    "keep": {"kind": "height", "a": {"keypoint": "corner"}, "min": 0.05},
                },
            ],
        }
    )


GOAL = ("goals", 0)
KEEP = ("constraints", 0, "keep")
LOW = ("constraints", 1, "keep")
NO_NUMBERS: tuple[Any, ...] = ("0.02", None, True, [0.02], {"m": 0.02}, "", "1e-2")
NO_JSON_NUMBERS = ("NaN", "Infinity", "-Infinity", "1e400", "-1e999", "9" * 5000, "-" + "1" * 40)


def put(path: tuple[str | int, ...], value: Any) -> dict[str, Any]:
    """The valid reply with one value replaced or added."""
    record = valid_reply()
    at: Any = record
    for key in path[:-1]:
        at = at[key]
    at[path[-1]] = value
    return record


def text_of(path: tuple[str | int, ...]) -> str:
    text = "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in path)
    return text.removeprefix(".") or "top level"


def hostile_replies() -> Iterator[tuple[str, str, str]]:
    """Name, reply, and the place that the refusal has to name."""
    yield from _numbers()
    yield from _sizes()
    yield from _written_down()


def _numbers() -> Iterator[tuple[str, str, str]]:
    places = [(*KEEP, key) for key in ("height", "tolerance_m", "aside_m")]
    places += [(*LOW, "min"), ("keypoints", 0, "xyz", 2)]
    for path in places:
        for value in NO_NUMBERS:
            yield f"{path[-1]} is {value!r}", json.dumps(put(path, value)), text_of(path)
        for number in NO_JSON_NUMBERS:
            text = json.dumps(put(path, "@")).replace('"@"', number)
            yield f"{path[-1]} is {number[:12]}", text, text_of(path)
        for number in (100.0, -7, 1e300):
            yield f"{path[-1]} is {number}", json.dumps(put(path, number)), text_of(path)
    for value in (0, -0.01, 0.6):
        yield (
            f"tolerance {value}",
            json.dumps(put((*KEEP, "tolerance_m"), value)),
            text_of((*KEEP, "tolerance_m")),
        )


def _sizes() -> Iterator[tuple[str, str, str]]:
    name = ("keypoints", 0, "name")
    yield "a megabyte", json.dumps(put(name, "a" * 1_000_000)), "top level"
    yield "a megabyte of prose", "word " * 200_000 + json.dumps(valid_reply()), "top level"
    yield "a long name", json.dumps(put(name, "a" * 1000)), text_of(name)
    yield "a long reason", json.dumps({"version": 3, "cannot": "a" * 301}), "cannot"
    for depth in (13, 100, 5000, 30_000):
        yield f"{depth} lists", "[" * depth + "]" * depth, "top level"
        yield f"{depth} objects", '{"a":' * depth + "1" + "}" * depth, "top level"
    yield "deep behind a quote", 'He said "well: ' + '{"a":' * 4900 + "1" + "}" * 4900, "top level"
    yield "many lists", "[" + "[]," * 20_000 + "[]]", "top level"
    yield "lists without end", "[" * 60_000, "top level"
    yield "braces that never close", '{"goals": ' * 900, "top level"
    yield "a string without end", '"' + '\\"' * 30_000, "top level"
    for count in (33, 200):
        yield f"{count} goals", json.dumps(put(("goals",), [INSIDE] * count)), "goals"
    wishes = valid_reply()["constraints"]
    for count in (17, 120):
        path = ("constraints",)
        yield f"{count} constraints", json.dumps(put(path, wishes[:1] * count)), text_of(path)
    points = valid_reply()["keypoints"] * 17
    yield "17 keypoints", json.dumps(put(("keypoints",), points)), "keypoints"
    keys = {f"key{index}": index for index in range(3000)}
    yield "3000 keys", json.dumps(put((*KEEP, "a"), keys)), text_of((*KEEP, "a"))


def _written_down() -> Iterator[tuple[str, str, str]]:
    """Names, forms, and what is at odds with itself or the scene."""
    for line in Path(__file__).with_name("refused_replies.txt").read_text().splitlines()[1:]:
        name, place, reply = json.loads(line)
        yield name, reply, place
