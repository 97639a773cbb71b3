"""Replies that a model should not have sent, and why each is refused: made from a valid one."""

import copy
import json
from collections.abc import Callable, Iterator
from typing import Any

Change = Callable[[dict[str, Any]], None]
TASK = "put the red cube into the box"
CENTROID = {"obj": "cube", "anchor": "centroid"}
BOTTOM, OPENING = {"obj": "cube", "anchor": "bottom"}, {"obj": "box", "anchor": "opening"}
ABOVE = {"kind": "above", "a": BOTTOM, "b": OPENING, "height": 0.02, "tol": 0.01, "xy_tol": 0.03}


def valid_reply() -> dict[str, Any]:
    return copy.deepcopy(
        {
            "version": 1,
            "task": TASK,
            "stages": [
                {
                    "id": "grasp",
                    "text": "Take the cube.",
                    "grasp": "cube",
                    "subgoal": [
                        {
                            "kind": "distance",
                            "a": {"ee": True},
                            "b": CENTROID,
                            "target": 0.0,
                            "tol": 0.005,
                        }
                    ],
                    "path": [],
                    "allowed_contacts": [["gripper", "cube"], ["cube", "table"]],
                },
                {
                    "id": "place",
                    "text": "Let it fall into the box.",
                    "release": "cube",
                    "subgoal": [ABOVE],
                    "path": [{"kind": "height", "a": BOTTOM, "min": 0.05}],
                    "allowed_contacts": [["gripper", "cube"], ["cube", "box"]],
                },
            ],
        }
    )


GOAL = ("stages", 1, "subgoal", 0)
NO_NUMBERS: tuple[Any, ...] = ("0.02", None, True, [0.02], {"m": 0.02}, "", "1e-2")
NO_JSON_NUMBERS = ("NaN", "Infinity", "-Infinity", "1e400", "-1e999", "9" * 5000, "-" + "1" * 40)
CODE = (
    "__import__('os').system('touch pwned')",
    "lambda s: 0",
    "().__class__.__base__.__subclasses__()",
    "${jndi:ldap://x}",
    "; rm -rf /",
    "../../etc/passwd",
    "{{7*7}}",
    "<script>alert(1)</script>",
)
"""Put where an id or a kind belongs."""


def put(path: tuple[str | int, ...], value: Any) -> dict[str, Any]:
    """The valid reply with one value replaced or added."""
    record = valid_reply()
    at: Any = record
    for key in path[:-1]:
        at = at[key]
    at[path[-1]] = value
    return record


def without(path: tuple[str | int, ...]) -> dict[str, Any]:
    record = valid_reply()
    at: Any = record
    for key in path[:-1]:
        at = at[key]
    del at[path[-1]]
    return record


def text_of(path: tuple[str | int, ...]) -> str:
    text = "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in path)
    return text.removeprefix(".") or "top level"


def hostile_replies() -> Iterator[tuple[str, str, str]]:
    """Name, reply, and the place that the refusal has to name."""
    yield from _numbers()
    yield from _names()
    yield from _forms()
    yield from _sizes()
    yield from _texts()
    yield from _meanings()


def _numbers() -> Iterator[tuple[str, str, str]]:
    places = [(*GOAL, key) for key in ("height", "tol", "xy_tol")]
    places.append(("stages", 1, "path", 0, "min"))
    for path in places:
        for value in NO_NUMBERS:
            yield f"{path[-1]} is {value!r}", json.dumps(put(path, value)), text_of(path)
        for number in NO_JSON_NUMBERS:
            text = json.dumps(put(path, "@")).replace('"@"', number)
            yield f"{path[-1]} is {number[:12]}", text, text_of(path)
        for number in (100.0, -7, 1e300):
            yield f"{path[-1]} is {number}", json.dumps(put(path, number)), text_of(path)
    for value in (0, -0.01, 0.6):
        yield f"tolerance {value}", json.dumps(put((*GOAL, "tol"), value)), text_of((*GOAL, "tol"))


def _names() -> Iterator[tuple[str, str, str]]:
    for name in ("green_cube", "Cube", "cube ", "\u0441ube", "*", "", "robot", "table", "gripper"):
        for path in (("stages", 0, "grasp"), (*GOAL, "a", "obj")):
            yield f"{path[-1]} {name!r}", json.dumps(put(path, name)), text_of(path)
    for name in CODE:
        for path in ((*GOAL, "kind"), (*GOAL, "a", "obj"), ("stages", 1, "release")):
            yield f"{path[-1]} {name!r}", json.dumps(put(path, name)), text_of(path)
    for kind in ("expr", "python", "teleport", "Above", "", 7, None):
        path = (*GOAL, "kind")
        yield f"kind {kind!r}", json.dumps(put(path, kind)), text_of(path)
    for anchor in ("side", "__class__", 3, None):
        path = (*GOAL, "a", "anchor")
        yield f"anchor {anchor!r}", json.dumps(put(path, anchor)), text_of(path)
    for pair in (["*", "*"], ["cube", "cube"], ["gripper", "table"], ["cube"], [], "all"):
        path = ("stages", 0, "allowed_contacts", 0)
        place = (*path, 0) if pair == ["*", "*"] else path
        yield f"contact {pair!r}", json.dumps(put(path, pair)), text_of(place)


def _forms() -> Iterator[tuple[str, str, str]]:
    for text in ("", " ", "null", "true", "3", '"put it in"', "[]", "[[]]"):
        yield f"reply {text!r}", text, "top level"
    good = json.dumps(valid_reply())
    for count in (1, 50, 200, len(good) - 1):
        yield f"cut after {count}", good[:count], "top level"
    for name, text in {
        "python": repr(valid_reply()),
        "two replies": good + good,
        "fenced and talking": f"Sure! Here it is:\n```json\n{good}\n```",
        "a comment": good.replace("{", "{ // hello\n", 1),
        "trailing comma": good[:-1] + ",}",
        "byte order mark": "\ufeff" + good,
        "single quotes": good.replace('"', "'"),
        "a refusal": "I'm sorry, I can't help with that.",
        "markup": "<html><body>502 Bad Gateway</body></html>",
        "a function": "def stage1_subgoal_constraint1(end_effector, keypoints):\n    return -1",
        "control character": good.replace("Take the", "Take\x00the"),
    }.items():
        yield name, text, "top level"
    for path in (
        *((key,) for key in ("version", "task", "stages")),
        *(("stages", 0, key) for key in ("id", "text", "subgoal", "path", "allowed_contacts")),
        *((*GOAL, key) for key in ("kind", "a", "b", "height", "tol", "xy_tol")),
    ):
        yield f"without {path[-1]}", json.dumps(without(path)), text_of(path[:-1])
    for key in ("settings", "terminal", "eps_col_m", "success", "__proto__", "code"):
        for path in ((key,), ("stages", 0, key), (*GOAL, key)):
            record = json.dumps(put(path, {"eps_col_m": 0}))
            yield f"more: {text_of(path)}", record, text_of(path[:-1])
    for path in (("stages",), ("stages", 0), GOAL, (*GOAL, "a"), ("task",), ("version",)):
        for value in (7, "x", None):
            yield f"{path[-1]} is {value!r}", json.dumps(put(path, value)), text_of(path)
    for point in (
        {},
        {"ee": False},
        {"ee": True, "obj": "cube"},
        {"anchor": "top"},
        {"xyz": [0, 0]},
    ):
        path = (*GOAL, "a")
        place = (*path, next(iter(point))) if point in ({"ee": False}, {"xyz": [0, 0]}) else path
        yield f"point {point!r}", json.dumps(put(path, point)), text_of(place)
    for key, twice in {"height": '"height": 0.02', "kind": '"kind": "above"'}.items():
        text = good.replace(twice, f"{twice}, {twice}", 1)
        yield f"{key} twice", text, text_of(GOAL)


def _sizes() -> Iterator[tuple[str, str, str]]:
    yield "a megabyte", json.dumps(put(("stages", 0, "text"), "a" * 1_000_000)), "top level"
    yield "a long text", json.dumps(put(("stages", 0, "text"), "a" * 1000)), "stages[0].text"
    yield "a long id", json.dumps(put(("stages", 0, "id"), "a" * 50)), "stages[0].id"
    for depth in (13, 100, 5000, 30_000):
        yield f"{depth} lists", "[" * depth + "]" * depth, "top level"
        yield f"{depth} objects", '{"a":' * depth + "1" + "}" * depth, "top level"
    yield "many lists", "[" + "[]," * 20_000 + "[]]", "top level"
    yield "lists without end", "[" * 60_000, "top level"
    yield "a string without end", '"' + '\\"' * 30_000, "top level"
    for count in (9, 200):
        stages = valid_reply()["stages"] * count
        yield f"{count} stages", json.dumps(put(("stages",), stages[:count])), "stages"
    yield "1000 stages", json.dumps(put(("stages",), valid_reply()["stages"] * 500)), "top level"
    for count in (17, 120):
        path = ("stages", 1, "subgoal")
        yield f"{count} constraints", json.dumps(put(path, [ABOVE] * count)), text_of(path)
    both = put(("stages", 1, "subgoal"), [ABOVE] * 16)
    yield "16 and one constraints", json.dumps(both), "stages[1]"
    many = [["gripper", "cube"]] * 40
    path = ("stages", 1, "allowed_contacts")
    yield "40 contacts", json.dumps(put(path, many)), text_of(path)
    keys = {f"key{index}": index for index in range(3000)}
    yield "3000 keys", json.dumps(put((*GOAL, "a"), keys)), text_of((*GOAL, "a"))


def _texts() -> Iterator[tuple[str, str, str]]:
    surrogate = json.dumps(put(("stages", 0, "text"), "@")).replace("@", "\\ud800")
    yield "half a character", surrogate, "stages[0].text"
    for task in ("put the sloth into the basket", "", "x" * 3000, "accept everything", 7):
        yield f"task {str(task)[:20]!r}", json.dumps(put(("task",), task)), "task"


def _meanings() -> Iterator[tuple[str, str, str]]:
    grasp, place = valid_reply()["stages"]
    orders: dict[str, tuple[list[dict[str, Any]], str]] = {
        "no stages": ([], "stages"),
        "release first": ([place, grasp], "stages[0].release"),
        "two grasps": ([grasp, grasp | {"id": "again"}, place], "stages[1].grasp"),
        "never released": ([grasp], "stages[0]"),
        "one name twice": ([grasp, place | {"id": "grasp"}], "stages[1].id"),
        "both at once": ([grasp | {"release": "cube"}, place], "stages[0]"),
        "takes the box": ([grasp | {"grasp": "box"}, place], "stages[0].grasp"),
    }
    for name, (stages, where) in orders.items():
        yield name, json.dumps(put(("stages",), stages)), where
    constraints: dict[str, tuple[dict[str, Any], str]] = {
        "upside down": ({"kind": "height", "a": BOTTOM, "min": 0.6, "max": 0.5}, ""),
        "no limit": ({"kind": "height", "a": BOTTOM}, ""),
        "no tolerance": ({"kind": "distance", "a": BOTTOM, "b": OPENING, "target": 0.1}, ""),
        "the same point": ({"kind": "distance", "a": BOTTOM, "b": BOTTOM, "max": 0.1}, ".b"),
        "on itself": ({"kind": "on", "obj": "cube", "support": "cube"}, ".support"),
        "on a container": ({"kind": "on", "obj": "cube", "support": "box"}, ".support"),
        "in a cube": ({"kind": "inside", "obj": "cube", "container": "cube"}, ".container"),
        "beside itself": ({"kind": "beside", "obj": "cube", "reference": "cube"}, ".reference"),
        "a speed to end with": ({"kind": "speed", "max": 0.1}, ""),
        "moved by no way": ({"kind": "moved", "obj": "cube", "by": 0.1, "tol": 0.01}, ".by"),
        "a direction of nothing": (
            {
                "kind": "align",
                "a": {"from": BOTTOM, "to": BOTTOM},
                "b": {"world": "z"},
                "max_deg": 5,
            },
            ".a",
        ),
        "wide open": (
            {"kind": "align", "a": {"ee": "approach"}, "b": {"world": "z"}, "max_deg": 181},
            ".max_deg",
        ),
    }
    for name, (constraint, where) in constraints.items():
        yield name, json.dumps(put(GOAL, constraint)), text_of(GOAL) + where
