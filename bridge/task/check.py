"""Everything that is wrong with a task file: keys and values, then what refers to nothing.

The keys, types and ranges are those of ``schemas/task.schema.json``. What a schema cannot say is
asked here: whether objects, containers and bodies that are named exist, whether ranges run upwards,
and whether every number is one.
"""

import difflib
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import reduce
from operator import getitem
from typing import TYPE_CHECKING, Any

from bridge.errors import UsageError
from bridge.task.record import find_problems, schema_of

if TYPE_CHECKING:
    from jsonschema_rs import ValidationError

SCHEMA_VERSION = 1
GRIPPER, TABLE = "gripper", "table"
BODIES = (GRIPPER, TABLE)
"""What may touch an object, besides other objects."""
CAVITIES = ("open_box", "basket")
VERBS = ("grasp", "carry", "release", "push")
MOST_LISTED = 40
REFERENCES = ("object", "container", "support", "reference", "first", "second", "against", "over")
"""Keys of a predicate or a constraint that name an object; the first is the one that moves."""
_TOOK_PLACE = {"object": "obj", "tolerance_rad": "max_deg", "tolerance_m": "tol", "over": "region"}
_TOOK_PLACE |= {"aside_m": "xy_tol", "direction": "way vector", "gap_m": "min_gap max_gap"}
_TOOK_PLACE |= {"the kind aligned": "undirected", "world, or object and axis, or ee": "from"}
RENAMED = {old: new for new, names in _TOOK_PLACE.items() for old in names.split()}
"""Keys of constraints of earlier editions, and what to say now."""
_GONE = {"part": " Leave it out: grasps are sought on the whole object."}


class TaskFileError(UsageError):
    """A task file that cannot be used; lists everything that is wrong with it."""

    def __init__(self, *, origin: str, problems: Sequence[str]) -> None:
        """Remember where the file lies, and each problem with its place."""
        self.origin = origin
        self.problems = tuple(problems)
        count = "1 problem" if len(problems) == 1 else f"{len(problems)} problems"
        left_out = len(problems) - MOST_LISTED
        more = [f"and {left_out} more"] if left_out > 0 else []
        listed = "\n".join(f"  {text}" for text in [*problems[:MOST_LISTED], *more])
        super().__init__(f"{origin} is not a task file, {count}:\n{listed}\nSee docs/tasks.md.")


def task_problems(table: Mapping[str, Any]) -> list[str]:
    """List what is wrong with the content of a task file, one line each; nothing for a good one."""
    version = table.get("schema_version")
    if type(version) is int and version > SCHEMA_VERSION:
        return [
            f"schema_version: {version} is newer than the {SCHEMA_VERSION} this version reads. "
            "Upgrade robot-gst."
        ]
    if odd := [f"{place_of(path)}: {what}" for path, what in _odd(table)]:
        return odd
    found = sorted(_sentence(error) for error in find_problems(table, name="task"))
    checks = (_object_lists, _starts, _stages, _predicates)  # what a good form names and has not
    return list(dict.fromkeys(found)) or [text for check in checks for text in check(table)]


def nearest(name: str, known: Iterable[str]) -> str:
    """Say which known name was probably meant, or nothing."""
    found = difflib.get_close_matches(name, list(known), n=1)
    return f" Did you mean {found[0]!r}?" if found else ""


def place_of(path: Iterable[str | int]) -> str:
    """A place in a record as text, such as ``stages[1].path[0].max``."""
    text = ""
    for part in path:
        if isinstance(part, int):
            text += f"[{part}]"
        else:
            text += f".{part}" if part.isprintable() and len(part) <= 80 else f".{part!r:.80}"
    return text.removeprefix(".") or "top level"


def _names(known: Iterable[str]) -> str:
    return ", ".join(sorted(known)) or "none"


def _odd(value: Any, path: tuple[str | int, ...] = ()) -> Iterator[tuple[Any, str]]:
    """What TOML can hold and no task: numbers that are none, dates and times."""
    if isinstance(value, Mapping | list):
        for key, inner in value.items() if isinstance(value, Mapping) else enumerate(value):
            yield from _odd(inner, (*path, key))
    elif isinstance(value, float) and not math.isfinite(value):
        yield path, f"{value} is not a number"
    elif not isinstance(value, str | int | float):
        yield path, f"{value} is a date or a time, and none is asked for"


def _sentence(error: "ValidationError") -> str:
    """One finding, with the names that are known where one is not."""
    place, value, about = place_of(error.instance_path), error.instance, error.kind.as_dict()
    match error.kind.name:
        case "additionalProperties":
            known = reduce(getitem, error.schema_path[:-1], schema_of("task"))["properties"]
            said = "; ".join(
                f"unknown key {key!r}.{_GONE.get(key) or nearest(RENAMED.get(key, key), known)}"
                for key in about["unexpected"]
            )
            return f"{place}: {said} Allowed: {_names(known)}."
        case "enum":
            known = about["options"]
            near = nearest(value, known) if isinstance(value, str) else ""
            return f"{place}: {value!r} is unknown. Known: {_names(known)}.{near}"
    return f"{place}: {error.message:.200}"


def _is_no_object(place: str, name: str, table: Mapping[str, Any]) -> Iterator[str]:
    objects = table["objects"]
    if name not in objects:
        near = nearest(name, objects)
        yield f"{place}: there is no object {name!r}. Objects: {_names(objects)}.{near}"


def _has_no_cavity(place: str, name: str, table: Mapping[str, Any]) -> Iterator[str]:
    model = table["objects"].get(name)
    if model is not None and model["shape"] not in CAVITIES and model.get("mesh") not in CAVITIES:
        yield f"{place}: {name} is no container; only an open_box or a basket has an inside"


def _object_lists(table: Mapping[str, Any]) -> Iterator[str]:
    objects = table["objects"]
    for name in objects:
        if name in BODIES:
            yield f"objects.{name}: an object cannot be called so; it is the robot's or the cell's"
        if not all(part.isalnum() for part in name.replace("-", "_").split("_")) or not name:
            yield f"objects.{name}: may hold letters, digits, '_' and '-' only"
    for key in ("manipulated", "containers"):
        names = table.get(key, [])
        for index, name in enumerate(names):
            yield from _is_no_object(f"{key}[{index}]", name, table)
            if name in names[:index]:
                yield f"{key}[{index}]: {name} is listed twice"
            if key == "containers":
                yield from _has_no_cavity(f"{key}[{index}]", name, table)
            elif objects.get(name, {}).get("fixed"):
                yield f"{key}[{index}]: {name} is fixed, and nothing can move it"


def _starts(table: Mapping[str, Any]) -> Iterator[str]:
    for name, ranges in table["start"].items():
        yield from _is_no_object(f"start.{name}", name, table)
        for key, (low, high) in ranges.items():
            if low > high:
                yield f"start.{name}.{key}: runs from {low:g} down to {high:g}; turn it round"
    for name in table["objects"]:
        if name not in table["start"]:
            yield f"start: says nothing of {name}. Add a table start.{name}: x_m, y_m, yaw_rad."


def _stages(table: Mapping[str, Any]) -> Iterator[str]:
    seen: set[str] = set()
    bodies = [*table["objects"], *BODIES]
    for index, stage in enumerate(table["stages"]):
        place = f"stages[{index}]"
        if stage["id"] in seen:
            yield f"{place}.id: there is a stage {stage['id']!r} already"
        seen.add(stage["id"])
        for verb in VERBS:
            if verb not in stage:
                continue
            name = stage[verb]
            yield from _is_no_object(f"{place}.{verb}", name, table)
            if name in table["objects"] and name not in table["manipulated"]:
                yield f"{place}.{verb}: {name} is not in manipulated"
        yield from _on_the_way(place, stage, table)
        for number, pair in enumerate(stage.get("allowed_contacts", [])):
            where = f"{place}.allowed_contacts[{number}]"
            for body in pair:
                if body not in bodies:
                    near = nearest(body, bodies)
                    yield f"{where}: there is no body {body!r}. Bodies: {_names(bodies)}.{near}"
            if pair[0] == pair[1]:
                yield f"{where}: {pair[0]} cannot touch itself"


def _on_the_way(place: str, stage: Mapping[str, Any], table: Mapping[str, Any]) -> Iterator[str]:
    """What belongs to one verb, what holds meanwhile, and where a push goes."""
    for key, verb in (("clearance_m", "carry"), ("speed_m_s", "push")):
        if key in stage and verb not in stage:
            yield f"{place}.{key}: belongs to {verb}"
    for number, way in enumerate(stage.get("path", [])):
        yield from _named(f"{place}.path[{number}]", way, table)
    pushed = stage.get("push")
    if pushed is None:
        return
    if any(verb in stage for verb in VERBS if verb != "push"):
        yield f"{place}.push: a stage that pushes neither grasps, carries nor releases"
    if not any(spec.get("object") == pushed and "target_m" in spec for spec in table["success"]):
        yield (
            f"{place}.push: no success predicate says where {pushed} is to be moved. Add one of "
            "kind moved with target_m."
        )


def _predicates(table: Mapping[str, Any]) -> Iterator[str]:
    for index, spec in enumerate(table["success"]):
        place = f"success[{index}]"
        yield from _named(place, spec, table)
        if "container" in spec:
            yield from _has_no_cavity(f"{place}.container", spec["container"], table)
        if "support" in spec:
            model = table["objects"].get(spec["support"], {})
            if CAVITIES[0] in model.values() or CAVITIES[1] in model.values():
                said = "is open above; what is put there is inside, not on it"
                yield f"{place}.support: {spec['support']} {said}"


def _named(place: str, spec: Mapping[str, Any], table: Mapping[str, Any]) -> Iterator[str]:
    for key in REFERENCES:
        if key in spec and (key, spec[key]) not in (("support", TABLE), ("against", TABLE)):
            yield from _is_no_object(f"{place}.{key}", spec[key], table)
    yield from contradictions(place, spec)


def contradictions(place: str, spec: Mapping[str, Any]) -> Iterator[str]:
    """What is at odds with itself in a predicate or a constraint of the right form."""
    named = [(key, spec[key]) for key in REFERENCES if key in spec]
    for number, (key, name) in enumerate(named):
        if name in (before for _, before in named[:number]):
            yield f"{place}.{key}: {name} cannot be in, on or beside itself"
    if spec.get("min", -math.inf) > spec.get("max", math.inf):
        yield f"{place}: min {spec['min']} is above max {spec['max']}"
    if spec["kind"] == "height" and not {"min", "max"} & spec.keys():
        yield f"{place}: says no limit. Give one or both of max, min."
    yield from _direction(place, spec)
    if spec["kind"] == "moved":
        yield from _moved(place, spec)


def _direction(place: str, spec: Mapping[str, Any]) -> Iterator[str]:
    """Three numbers need a length; beside something, and by a distance, one seen from above."""
    direction = spec.get("direction", "")
    if not isinstance(direction, str):
        if not any(direction):
            yield f"{place}.direction: has no length"
        elif direction[2] and (spec["kind"] == "beside" or "by_m" in spec):
            yield f"{place}.direction: must be level, its third number 0"
    if "gap_m" in spec and spec["gap_m"][0] > spec["gap_m"][1]:
        low, high = spec["gap_m"]
        yield f"{place}.gap_m: runs from {low:g} down to {high:g}; turn it round"


def _moved(place: str, spec: Mapping[str, Any]) -> Iterator[str]:
    limits = ("at_least_m", "at_most_m", "by_m", "target_m")
    if not any(key in spec for key in limits):
        yield f"{place}: says no limit. Give one or more of {', '.join(limits)}."
    if "target_m" in spec and "by_m" in spec:
        yield f"{place}: by_m and target_m each say where it is to end; give one"
    elif ("target_m" in spec) != ("tolerance_m" in spec) and "by_m" not in spec:
        yield f"{place}: target_m and tolerance_m belong together"
    if "by_m" in spec and "direction" not in spec:
        yield f"{place}.by_m: needs a direction"
    if "direction" in spec and not any(key in spec for key in limits[:3]):
        yield f"{place}.direction: belongs to at_least_m, at_most_m or by_m"
    if spec.get("at_least_m", 0) > spec.get("at_most_m", math.inf):
        yield f"{place}: at_least_m {spec['at_least_m']} is above at_most_m {spec['at_most_m']}"
