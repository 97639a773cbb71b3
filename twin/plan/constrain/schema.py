"""What a constraint may say in one scene, and what is wrong with one that says something else.

``bridge/task/schemas/constraint.schema.json`` lists the kinds with their bounds and units. For a
scene its ids become enums of what is there. The findings are made here and not by jsonschema, which
agrees on what fits (see the tests): they follow the one kind that a constraint says it is, so that
each names its own place, and their number and time are bounded whatever is asked.
"""

import copy
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from itertools import islice
from typing import Any

from bridge.errors import UsageError
from bridge.task.check import BODIES, CAVITIES, TABLE, nearest
from bridge.task.task_file import ObjectModel, Task

Where = tuple[str | int, ...]
"""Keys and indices from the outermost value to the one that is meant."""
Problems = Iterator[tuple[Where, str]]
Schema = Mapping[str, Any]
MOST_PROBLEMS = 12
MOST_SHOWN = 60
"""Characters of a value in an error."""
SCENE, BASE = "scene", "world"
"""What stands for all that stands still, and for the base frame."""


@dataclass(frozen=True, kw_only=True)
class Vocabulary:
    """What constraints may name in one scene."""

    objects: tuple[str, ...]
    movable: tuple[str, ...]
    """Of the objects, those that the task moves."""
    containers: tuple[str, ...] = ()
    """Of the objects, those with a cavity."""
    cameras: tuple[str, ...] = ()
    num_keypoints: int = 0
    allowed_contacts: frozenset[frozenset[str]] | None = None
    """Pairs that may touch at some time, from the task file; None: no task file says so yet."""

    @staticmethod
    def of_task(
        task: Task,
        *,
        num_keypoints: int = 0,
        cameras: Iterable[str] = (),
        objects_alone: bool = False,
    ) -> "Vocabulary":
        """Read off a task file what may be named.

        Args:
            objects_alone: What the task does with its objects is not asked for: whatever is not
                fixed may be moved, and contacts are not known yet.
        """
        pairs = (pair for stage in task.stages for pair in stage.get("allowed_contacts", ()))
        free = tuple(key for key, model in task.objects.items() if not model.fixed)
        return Vocabulary(
            objects=tuple(task.objects),
            movable=free if objects_alone else task.manipulated,
            containers=tuple(key for key, model in task.objects.items() if _has_cavity(model)),
            cameras=tuple(sorted(cameras)),
            num_keypoints=num_keypoints,
            allowed_contacts=None if objects_alone else frozenset(map(frozenset, pairs)),
        )

    @cache  # noqa: B019  # as many as there are tasks
    def schema(self) -> dict[str, Any]:
        """The schema of constraints with the ids of this scene; not to be changed."""
        schema = copy.deepcopy(_schema())
        tops = [name for name in self.objects if name not in self.containers]
        ids = {
            "object_id": self.objects,
            "movable_id": self.movable,
            "container_id": self.containers,
            "support_id": (*tops, TABLE),
            "frame_id": (*self.objects, BASE),
            "obstacle_id": (*self.objects, TABLE, SCENE),
            "body_id": (*self.objects, *BODIES),
            "camera_id": self.cameras,
        }
        for name, known in ids.items():
            schema["$defs"][name] = {"enum": list(known)}
        schema["$defs"]["keypoint_id"]["maximum"] = self.num_keypoints - 1
        return schema


def _has_cavity(model: ObjectModel) -> bool:
    return model.shape in CAVITIES or model.mesh in CAVITIES


@cache
def _schema() -> dict[str, Any]:
    path = resources.files("bridge.task").joinpath("schemas/constraint.schema.json")
    return dict(json.loads(path.read_text()))


class ConstraintError(UsageError):
    """A constraint that cannot be used; lists what is wrong with it."""

    def __init__(self, *, problems: tuple[str, ...]) -> None:
        """Remember each problem with its place."""
        self.problems = problems
        listed = "\n".join(f"  {text}" for text in problems)
        super().__init__(f"not a constraint that can be planned with:\n{listed}")


def check_constraint(record: Mapping[str, Any], vocabulary: Vocabulary) -> None:
    """Refuse a constraint that does not fit the schema or names what is not there."""
    found = find_problems(record, "constraint", vocabulary.schema())
    if not found:
        found = told(meaning_problems(record, ()))
    if found:
        raise ConstraintError(problems=found)


def find_problems(value: Any, name: str, schema: Schema) -> tuple[str, ...]:
    """List what does not fit a part of the schema, at most ``MOST_PROBLEMS``.

    Returns:
        One line each: the place, what was found, what is allowed.
    """
    return told(_Fitting(schema["$defs"]).problems(value, {"$ref": f"#/$defs/{name}"}, ()))


def portable_schema(schema: Schema, name: str) -> dict[str, Any]:
    """Part of a schema in the words that every model server knows: types, properties, items.

    Servers differ in what else they understand, and some refuse a request for an enum or a bound.
    Kinds are laid over each other, so that each key of any of them may be there. What comes back is
    judged by the whole schema in any case.
    """
    return _portable({"$ref": f"#/$defs/{name}"}, schema["$defs"])


def _portable(spec: Schema, defs: Mapping[str, Schema]) -> dict[str, Any]:
    if "$ref" in spec:
        return _portable(defs[spec["$ref"].rpartition("/")[2]], defs)
    if "const" in spec or "enum" in spec:
        value = spec.get("const", "text")
        found = {bool: "boolean", int: "integer", str: "string"}
        return {"type": found[type(value)]}
    if spec["type"] == "array":
        return {"type": "array", "items": _portable(spec["items"], defs)}
    if spec["type"] != "object":
        return {"type": spec["type"]}
    properties = {key: _portable(inner, defs) for key, inner in spec["properties"].items()}
    for option in spec.get("oneOf", ()):
        if "$ref" in option:
            for key, inner in _portable(option, defs)["properties"].items():
                properties[key] = _laid_over(properties.get(key, inner), inner)
    return {
        "type": "object",
        "properties": properties,
        "required": list(spec.get("required", ())),
        "additionalProperties": False,
    }


def _laid_over(one: dict[str, Any], other: dict[str, Any]) -> dict[str, Any]:
    """Both of two objects at once; of anything else the first."""
    if one.get("type") != "object" or other.get("type") != "object":
        return one
    properties = one["properties"] | other["properties"]
    required = [key for key in one["required"] if key in other["required"]]
    return one | {"properties": properties, "required": required}


def told(problems: Problems) -> tuple[str, ...]:
    """One line for each of the first problems: place and what is wrong."""
    lines = (f"{place(where)}: {what}" for where, what in islice(problems, MOST_PROBLEMS))
    return tuple(dict.fromkeys(lines))


def place(where: Where) -> str:
    """A place in JSON as text, such as ``stages[1].subgoal[0].height``."""
    text = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in where)
    return text.removeprefix(".") or "top level"


def shown(value: Any) -> str:
    """A value in an error: short, on a single line, in ASCII."""
    if isinstance(value, str):
        cut = "..." if len(value) > MOST_SHOWN else ""
        return json.dumps(value[:MOST_SHOWN]) + cut
    if isinstance(value, dict):
        return "an object"
    if isinstance(value, list):
        return "a list"
    return json.dumps(value) if value is None or isinstance(value, bool) else f"{value!r:.60}"


@dataclass(frozen=True)
class Unreadable:
    """A number that JSON text holds and no program should use."""

    text: str


class Repeated(dict[str, Any]):
    """An object that says one key more than once."""

    def __init__(self, pairs: list[tuple[str, Any]]) -> None:
        """Keep the last of each key, and which keys came more than once."""
        super().__init__(pairs)
        names = [name for name, _ in pairs]
        self.names = sorted({name for name in names if names.count(name) > 1})


_TYPES: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "object": ("an object", lambda value: isinstance(value, dict)),
    "array": ("a list", lambda value: isinstance(value, list)),
    "string": ("text", lambda value: isinstance(value, str)),
    "number": ("a number", lambda value: type(value) in (int, float) and math.isfinite(value)),
    "integer": ("a whole number", lambda value: type(value) is int),
    "boolean": ("true or false", lambda value: isinstance(value, bool)),
}


class _Fitting:
    """Follows a value and its schema; knows the keywords that our schema uses."""

    def __init__(self, defs: Mapping[str, Schema]) -> None:
        self._defs = defs

    def problems(self, value: Any, spec: Schema, where: Where) -> Problems:
        if "$ref" in spec:
            spec = self._defs[spec["$ref"].rpartition("/")[2]]
        if isinstance(value, Unreadable):
            yield where, f"{value.text[:MOST_SHOWN]} is not a number that can be used"
        elif "const" in spec:
            if type(value) is not type(spec["const"]) or value != spec["const"]:
                yield where, f"{shown(value)} should be {shown(spec['const'])}"
        elif "enum" in spec:
            yield from _enum(value, spec["enum"], where)
        else:
            named, fits = _TYPES[spec["type"]]
            if not fits(value):
                yield where, f"{shown(value)} should be {named}"
            elif spec["type"] == "object":
                yield from self._object(value, spec, where)
            elif spec["type"] == "array":
                yield from self._array(value, spec, where)
            elif spec["type"] == "string":
                yield from _text(value, spec, where)
            else:
                yield from _bounds(value, spec, where)

    def _array(self, value: list[Any], spec: Schema, where: Where) -> Problems:
        least, most = spec.get("minItems", 0), spec.get("maxItems", math.inf)
        if not least <= len(value) <= most:
            allowed = f"{least}" if least == most else f"{least} to {most}"
            yield where, f"has {len(value)} values; it must have {allowed}"
            return
        for index, inner in enumerate(value):
            yield from self.problems(inner, spec["items"], (*where, index))

    def _object(self, value: dict[str, Any], spec: Schema, where: Where) -> Problems:
        if isinstance(value, Repeated):
            for name in value.names:
                yield where, f"the key {shown(name)} is there more than once"
        known = spec["properties"]
        one_of = spec.get("oneOf", ())
        if one_of and "$ref" in one_of[0]:  # the kinds of constraints, told apart by their names
            if "kind" not in value:
                yield where, "kind is missing"
            elif found := list(self.problems(value["kind"], known["kind"], (*where, "kind"))):
                yield from found
            else:
                yield from self.problems(value, self._defs[value["kind"]], where)
            return
        for name in value:
            if name not in known:
                yield (
                    where,
                    f"unknown key {shown(name)}.{nearest(name[:80], known)} " + _known(known),
                )
        for name in spec.get("required", ()):
            if name not in value:
                yield where, f"{name} is missing"
        for name, inner in known.items():
            if name in value:
                yield from self.problems(value[name], inner, (*where, name))
        yield from _together(value, spec, where)


def _enum(value: Any, known: list[Any], where: Where) -> Problems:
    if type(value) is not str or value not in known:
        near = nearest(value[:80], known) if isinstance(value, str) else ""
        yield where, f"{shown(value)} is unknown. {_known(known)}{near}"


def _known(names: Iterable[str]) -> str:
    return f"Known: {', '.join(names) or 'none'}."


def _text(value: str, spec: Schema, where: Where) -> Problems:
    least, most = spec.get("minLength", 0), spec.get("maxLength", math.inf)
    if not least <= len(value) <= most:
        yield where, f"has {len(value)} characters; it must have {least} to {most}"
    elif not value.isascii() and not _is_unicode(value):
        yield where, "holds half of a character (a lone surrogate)"


def _is_unicode(value: str) -> bool:
    try:
        value.encode()
    except UnicodeEncodeError:
        return False
    return True


def _bounds(value: int | float, spec: Schema, where: Where) -> Problems:
    low = spec.get("minimum", spec.get("exclusiveMinimum", -math.inf))
    high = spec.get("maximum", math.inf)
    if value < low or value > high or value == spec.get("exclusiveMinimum"):
        least = f"above {low:g}" if "exclusiveMinimum" in spec else f"at least {low:g}"
        if low > high:
            yield where, f"{value} is unknown: there is none"
        else:
            yield where, f"{value:.6g} makes no sense; it must be {least} and at most {high:g}"


def _together(value: Mapping[str, Any], spec: Schema, where: Where) -> Problems:
    """Keys that need each other, and choices between keys."""
    for name, others in spec.get("dependentRequired", {}).items():
        for other in others:
            if name in value and other not in value:
                yield where, f"{name} belongs to {other}, which is missing"
    choices = [spec, *spec.get("allOf", ())]
    for choice in choices:
        for keyword, least, most in (("oneOf", 1, 1), ("anyOf", 1, math.inf)):
            options = [option["required"] for option in choice.get(keyword, ())]
            count = sum(all(name in value for name in names) for names in options)
            if options and not least <= count <= most:
                listed = ", ".join(" with ".join(names) for names in options)
                wanted = "exactly one" if most == 1 else "one or more"
                yield where, f"give {wanted} of {listed}"


# What a schema cannot say of one constraint

_ORDERED = (("min", "max"), ("min_gap", "max_gap"), ("at_least", "at_most"))
_OTHERS = ("support", "container", "reference", "against", "first", "second")


def meaning_problems(record: Mapping[str, Any], where: Where) -> Problems:
    """List what contradicts itself in a constraint that fits the schema."""
    for low, high in _ORDERED:
        if low in record and high in record and record[low] > record[high]:
            yield where, f"{low} {record[low]:g} is above {high} {record[high]:g}"
    yield from _alike(record, where)
    if "q_wxyz" in record and abs(math.hypot(*record["q_wxyz"]) - 1.0) > 0.01:
        yield (*where, "q_wxyz"), "is not of unit length"
    if record["kind"] == "moved":
        yield from _course(record, where)
    if "box" in record.get("region", {}):
        box = record["region"]["box"]
        if any(low >= high for low, high in zip(box["min"], box["max"], strict=True)):
            yield (*where, "region", "box"), "has no volume: min must be below max"


def _alike(record: Mapping[str, Any], where: Where) -> Problems:
    """Nothing is related to itself."""
    for key in _OTHERS:
        if "obj" in record and record.get(key) == record["obj"]:
            yield (*where, key), f"{record['obj']} cannot be related to itself"
    if "obj" in record and record.get("region", {}).get("over") == record["obj"]:
        yield (*where, "region", "over"), f"{record['obj']} is always over itself"
    if record["kind"] == "between" and record["first"] == record["second"]:
        yield (*where, "second"), f"{record['second']} is named twice"
    if record["kind"] in ("distance", "above", "align") and record["a"] == record["b"]:
        yield (*where, "b"), "is the same as a"
    for key in ("a", "b"):
        direction = record.get(key, {})
        if "from" in direction and direction["from"] == direction["to"]:
            yield (*where, key), "runs from a point to the same point"


def _course(record: Mapping[str, Any], where: Where) -> Problems:
    """The direction of kind ``moved``, as a word or as a vector."""
    named = [key for key in ("way", "vector") if key in record]
    if len(named) == 2:
        yield where, "way and vector both say the direction; give one"
    if named and not any(key in record for key in ("at_least", "at_most", "by")):
        yield (*where, named[0]), "belongs to at_least, at_most or by"
    if "by" in record and not named:
        yield (*where, "by"), "needs a way or a vector"
    if not any(record.get("vector", (1,))):
        yield (*where, "vector"), "has no length"
