"""What a constraint may say in one scene, and what is wrong with one that says something else.

``bridge/task/schemas/constraint.schema.json`` lists the kinds with their bounds and units. For a
scene its ids become enums of what is there, and a constraint is judged as the one kind that it says
it is, so that each finding names its own place.
"""

import copy
import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from itertools import islice
from typing import TYPE_CHECKING, Any

from bridge.errors import UsageError
from bridge.task.check import CAVITIES, TABLE, nearest
from bridge.task.task_file import Task

if TYPE_CHECKING:
    import jsonschema_rs

Where = tuple[str | int, ...]
"""Keys and indices from the outermost value to the one that is meant."""
Problems = Iterator[tuple[Where, str]]
Schema = Mapping[str, Any]
MOST_PROBLEMS = 12
MOST_SHOWN, MOST_TEXT = 60, 240
"""Characters of a value, and of a library's words, in an error."""
SCENE, BASE = "scene", "world"
"""What stands for all that stands still, and for the base frame."""


@dataclass(frozen=True, kw_only=True)
class Vocabulary:
    """What constraints may name in one scene."""

    objects: tuple[str, ...]
    movable: tuple[str, ...]
    containers: tuple[str, ...] = ()

    @staticmethod
    def of_task(task: Task, *, objects_alone: bool = False) -> "Vocabulary":
        """Read off a task file what may be named.

        Args:
            objects_alone: What the task does with its objects is not asked for: whatever is not
                fixed may be moved.
        """
        hollow = (key for key, m in task.objects.items() if {m.shape, m.mesh} & set(CAVITIES))
        free = tuple(key for key, model in task.objects.items() if not model.fixed)
        return Vocabulary(
            objects=tuple(task.objects),
            movable=free if objects_alone else task.manipulated,
            containers=tuple(hollow),
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
        }
        for name, known in ids.items():
            schema["$defs"][name] = {"enum": list(known)}
        return schema

    @cache  # noqa: B019
    def validator(self, name: str) -> "jsonschema_rs.Draft202012Validator":
        """Judges a part of the schema's ``$defs``, such as ``constraint`` or ``reply``."""
        import jsonschema_rs  # noqa: PLC0415  # most commands check no constraint

        defs = dict(self.schema()["$defs"])
        if name != "reply":  # where a reply says keypoint, a task says object and offset
            defs["keypoint_id"] = {"enum": []}
        kind = defs["constraint"]["properties"]["kind"]
        ways = [
            {"if": {"properties": {"kind": {"const": each}}}, "then": {"$ref": f"#/$defs/{each}"}}
            for each in kind["enum"]
        ]
        defs["constraint"] = {
            "type": "object",
            "properties": {"kind": kind},
            "required": ["kind"],
            "if": {"properties": {"kind": kind}, "required": ["kind"]},
            "then": {"allOf": ways},
        }
        return jsonschema_rs.Draft202012Validator({"$ref": f"#/$defs/{name}", "$defs": defs})


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


def values_of(record: Mapping[str, Any], keys: tuple[str, ...]) -> Iterator[str]:
    """What stands behind some keys anywhere in a record."""
    for key, value in record.items():
        if isinstance(value, Mapping):
            yield from values_of(value, keys)
        elif key in keys:
            yield value


def check_constraint(record: Mapping[str, Any], vocabulary: Vocabulary) -> None:
    """Refuse a constraint that does not fit the schema or names what is not there."""
    found = find_problems(record, "constraint", vocabulary)
    if not found:
        found = told(meaning_problems(record, ()))
    if found:
        raise ConstraintError(problems=found)


def find_problems(value: Any, name: str, vocabulary: Vocabulary) -> tuple[str, ...]:
    """List what does not fit a part of the schema, one line each, at most ``MOST_PROBLEMS``."""
    errors = vocabulary.validator(name).iter_errors(value)
    return told((tuple(error.instance_path), _what(error)) for error in errors)


def _what(error: Any) -> str:
    """What is wrong, in words that a model or a person can act on."""
    about, value = error.kind.as_dict(), error.instance
    if error.kind.name == "enum":
        known = [str(each) for each in about["options"]]
        near = nearest(value[:80], known) if isinstance(value, str) else ""
        return f"{shown(value)} is unknown. Known: {', '.join(known) or 'none'}.{near}"
    if error.kind.name == "additionalProperties":
        return f"unknown key {', '.join(map(shown, about['unexpected'][:3]))}"
    return _ascii(error.message[:MOST_TEXT])


def told(problems: Iterable[tuple[Where, str]]) -> tuple[str, ...]:
    """One line for each of the first problems: place and what is wrong."""
    lines = (f"{place(where)}: {what}" for where, what in islice(problems, MOST_PROBLEMS))
    return tuple(dict.fromkeys(lines))


def place(where: Where) -> str:
    """A place in JSON as text, such as ``stages[1].subgoal[0].height``."""
    text = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in where)
    return _ascii(text.removeprefix("."))[:MOST_TEXT] or "top level"


def _ascii(text: str) -> str:
    return printable(text).encode("ascii", "backslashreplace").decode()


def printable(text: str) -> str:
    """Text with everything escaped that a terminal or a log would not show as it is."""
    return "".join(
        char if char.isprintable() else char.encode("unicode_escape").decode() for char in text
    )


def shown(value: Any) -> str:
    """A value in an error: short, on a single line, in ASCII."""
    if isinstance(value, str):
        cut = "..." if len(value) > MOST_SHOWN else ""
        return json.dumps(value[:MOST_SHOWN]) + cut
    if isinstance(value, dict | list):
        return "an object" if isinstance(value, dict) else "a list"
    return f"{json.dumps(value):.60}"


# What a schema cannot say of one constraint

_ORDERED = (("min", "max"), ("min_gap", "max_gap"), ("at_least", "at_most"))
_OTHERS = ("support", "container", "reference", "against")


def meaning_problems(record: Mapping[str, Any], where: Where) -> Problems:
    """List what contradicts itself in a constraint that fits the schema."""
    for low, high in _ORDERED:
        if low in record and high in record and record[low] > record[high]:
            yield where, f"{low} {record[low]:g} is above {high} {record[high]:g}"
    yield from _alike(record, where)
    if record["kind"] == "moved":
        yield from _course(record, where)


def _alike(record: Mapping[str, Any], where: Where) -> Problems:
    """Nothing is related to itself."""
    for key in _OTHERS:
        if "obj" in record and record.get(key) == record["obj"]:
            yield (*where, key), f"{record['obj']} cannot be related to itself"
    if "obj" in record and record.get("region", {}).get("over") == record["obj"]:
        yield (*where, "region", "over"), f"{record['obj']} is always over itself"
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
