"""What a constraint may say in one scene, and what is wrong with one that says something else.

Kinds about bodies are those of task files, ``task.schema.json``: the words of success predicates
and of what holds on the way. ``constraint.schema.json`` adds kinds about points and directions, and
the form of a reply. For a scene the ids become enums of what is there.
"""

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from itertools import islice
from typing import TYPE_CHECKING, Any

from bridge.errors import UsageError
from bridge.task.check import CAVITIES, RENAMED, TABLE, contradictions, nearest, place_of
from bridge.task.record import schema_of
from bridge.task.relations import RELATIONS
from bridge.task.task_file import Task

if TYPE_CHECKING:
    import jsonschema_rs

KINDS = (
    *("distance", "above", "align", "clearance", "keepout", "height", "speed"),
    *RELATIONS,
)
MOST_PROBLEMS = 12
MOST_SHOWN, MOST_TEXT = 60, 480
"""Characters of a value, and of an error."""
SCENE, BASE = "scene", "world"
"""What stands for all that stands still, and for the base frame."""


@dataclass(frozen=True, kw_only=True)
class Vocabulary:
    """What constraints may name in one scene."""

    objects: tuple[str, ...]
    movable: tuple[str, ...]
    containers: tuple[str, ...] = ()

    @staticmethod
    def of_task(task: Task) -> "Vocabulary":
        """Read off a task file what may be named; whatever is not fixed may be moved."""
        hollow = (key for key, m in task.objects.items() if {m.shape, m.mesh} & set(CAVITIES))
        free = (key for key, model in task.objects.items() if not model.fixed)
        return Vocabulary(
            objects=tuple(task.objects), movable=tuple(free), containers=tuple(hollow)
        )

    @cache  # noqa: B019  # as many as there are tasks
    def definitions(self) -> dict[str, Any]:
        """The kinds and a reply's form, with the ids of this scene; not to be changed."""
        of_tasks, own = (schema_of(name)["$defs"] for name in ("task", "constraint"))
        shared = {
            name: of_tasks[name] for name in (*KINDS, "vector", "tilt_rad") if name in of_tasks
        }
        tops = [name for name in self.objects if name not in self.containers]
        ids = {
            "object_id": self.objects,
            "movable_id": self.movable,
            "container_id": self.containers,
            "support_id": (*tops, TABLE),
            "frame_id": (*self.objects, BASE),
            "obstacle_id": (*self.objects, TABLE, SCENE),
        }
        ways = [
            {
                "if": {"properties": {"kind": {"const": kind}}, "required": ["kind"]},
                "then": {"$ref": f"#/$defs/{kind}"},
            }
            for kind in KINDS
        ]
        constraint = {
            "type": "object",
            "properties": {"kind": {"enum": list(KINDS)}},
            "required": ["kind"],
            "allOf": ways,
        }
        found = {name: {"enum": list(known)} for name, known in ids.items()}
        keypoint = {"type": "string", "minLength": 1, "maxLength": 80}
        return {**shared, **own, **found, "constraint": constraint, "keypoint_id": keypoint}

    @cache  # noqa: B019
    def validator(self, name: str) -> "jsonschema_rs.Draft202012Validator":
        """Judges what one of the definitions says, such as ``constraint`` or ``reply``."""
        import jsonschema_rs  # noqa: PLC0415  # most commands check no constraint

        defs = dict(self.definitions())
        if name != "reply":  # where a reply says keypoint, a task says object and offset
            defs["keypoint_id"] = {"enum": []}
        return jsonschema_rs.Draft202012Validator({"$ref": f"#/$defs/{name}", "$defs": defs})


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
    if found := found or listed(meaning_problems(record, "")):
        raise UsageError(f"not a constraint that can be planned with: {'; '.join(found)}")


def find_problems(value: Any, name: str, vocabulary: Vocabulary) -> tuple[str, ...]:
    """List what does not fit a definition, one line each, at most ``MOST_PROBLEMS``."""
    errors = vocabulary.validator(name).iter_errors(value)
    return listed(f"{place_of(error.instance_path)}: {_what(error)}" for error in errors)


def _what(error: Any) -> str:
    """What is wrong, in words that a model or a person can act on."""
    about, value = error.kind.as_dict(), error.instance
    if error.kind.name == "enum":
        known = [str(each) for each in about["options"]]
        near = nearest(value[:80], known) if isinstance(value, str) else ""
        return f"{shown(value)} is unknown. Known: {', '.join(known) or 'none'}.{near}"
    if error.kind.name == "additionalProperties":
        keys = about["unexpected"][:3]
        now = [f"For {key} say {RENAMED[key]}" for key in keys if key in RENAMED]
        return ". ".join([f"unknown key {', '.join(map(shown, keys))}", *now])
    return str(error.message)


def listed(problems: Iterable[str]) -> tuple[str, ...]:
    """The first problems, each once, short and in ASCII."""
    plain = (printable(text[:MOST_TEXT]) for text in islice(problems, MOST_PROBLEMS))
    lines = (text.encode("ascii", "backslashreplace").decode()[:MOST_TEXT] for text in plain)
    return tuple(dict.fromkeys(lines))


def printable(text: str) -> str:
    """Text with everything escaped that a terminal or a log would not show as it is."""
    return "".join(
        char if char.isprintable() else char.encode("unicode_escape").decode() for char in text
    )


def shown(value: Any) -> str:
    """A value in an error: short, on a single line, in ASCII."""
    text = json.dumps(value)
    return text if len(text) <= MOST_SHOWN else f"{text[:MOST_SHOWN]}..."


def meaning_problems(record: Mapping[str, Any], place: str) -> Iterator[str]:
    """List what contradicts itself in a constraint that fits the schema."""
    yield from contradictions(place or "top level", record)
    if record["kind"] in ("distance", "above", "align") and record["a"] == record["b"]:
        yield f"{place}.b: is the same as a"
