"""A task file from an instruction: goals as success predicates, stages and contacts by fixed rules.

The rules know kinds of goals and nothing of any particular task; the same instruction over the same
objects gives the same bytes.
"""

import hashlib
import json
import re
import tomllib
from collections.abc import Mapping, Sequence
from typing import Any

from bridge.task.check import GRIPPER, TABLE
from bridge.task.find import union_of
from bridge.task.summary import describe_predicate
from bridge.task.task_file import TaskFile
from twin.plan.ground.goals import Grounding

RULES_VERSION = 2
"""Of the rules below; a file says which it was made by."""
SETTLED = {"max_speed_m_s": 0.02, "for_s": 0.3}
SHAPE_TOLERANCE = 0.25
"""Of a soft object's extents, as in the tasks that ship."""
NAME_CHARACTERS = 48


def derive_task(grounding: Grounding, base: Sequence[TaskFile], *, by: str = "grammar") -> TaskFile:
    """Write the task file that an instruction asks for."""
    union_of(base)  # raises where the files disagree
    tables = [tomllib.loads(file.data.decode()) for file in base]
    objects = {key: about for table in tables for key, about in table["objects"].items()}
    starts = {key: about for table in tables for key, about in table["start"].items()}
    name = task_name(grounding, base)
    forces = [table["grip_force_N"] for table in tables if "grip_force_N" in table]
    named = [goal["container"] for goal in grounding.goals if "container" in goal]
    top: dict[str, Any] = {
        "schema_version": 1,
        "name": name,
        "instruction": grounding.text,
        "cell": tables[0].get("cell", "standin"),
        **({"grip_force_N": min(forces)} if forces else {}),
        "manipulated": list(grounding.order),
        **({"containers": list(dict.fromkeys(named))} if named else {}),
    }
    derived = {
        "by": by,
        "rules": RULES_VERSION,
        "tasks": sorted({table["name"] for table in tables}),
        "explanation": list(grounding.explanation),
    }
    parts = [
        ("[derived]", derived),
        *((f"[objects.{key}]", about) for key, about in objects.items()),
        *((f"[start.{key}]", about) for key, about in starts.items()),
        *(("[[stages]]", stage) for stage in stages_of(grounding, objects)),
        *(("[[success]]", spec) for spec in success_of(grounding, objects)),
    ]
    lines = [
        f"# Derived from an instruction by fixed rules, version {RULES_VERSION}.",
        *(f"{key} = {_toml(value)}" for key, value in top.items()),
        *(line for title, about in parts for line in _table(title, about)),
    ]
    text = "\n".join(lines)
    file = TaskFile(f"{text}\n".encode(), f"{name}.toml")
    file.task()
    return file


def task_name(grounding: Grounding, base: Sequence[TaskFile]) -> str:
    """Name a derived task by its words and by what decides it, its goals among that."""
    words = re.sub(r"[^a-z0-9]+", "_", grounding.text.lower())[:NAME_CHARACTERS].strip("_")
    meant = json.dumps([[dict(goal) for goal in grounding.goals], grounding.order])
    files = (file.sha256 for file in base)
    what = "\n".join([grounding.text, str(RULES_VERSION), meant, *files])
    digits = hashlib.sha256(what.encode()).hexdigest()[:8]
    return f"{words or 'task'}_{digits}"


def stages_of(grounding: Grounding, objects: Mapping[str, Any]) -> list[dict[str, Any]]:
    """For each object grasp, carry and release, with what may touch what in each.

    In every stage an object that is not handled may touch what it lies on: the table at first,
    later where it was put, with what lies there too. The grasp lets the object touch that as well,
    and the hand; the release what the object is put onto or into, and the hand a container's walls.
    """
    lies_on = {key: TABLE for key, about in objects.items() if not about.get("fixed", False)}
    stages: list[dict[str, Any]] = []
    for key in grounding.order:
        goals = [goal for goal in grounding.goals if goal["object"] == key]
        others = [pair for other in lies_on if other != key for pair in _rest(other, lies_on)]
        target = _target(goals)
        hand = [GRIPPER, key]
        starts_on = [[key, lies_on[key]]]
        starts_on += [[key, goal["container"]] for goal in goals if goal["kind"] == "outside"]
        lies_on[key] = target
        lands = [pair for pair in _rest(key, lies_on) if pair != hand]
        if any(goal["kind"] == "inside" for goal in goals):
            lands.append([GRIPPER, target])
        end = f"_{key}" if len(grounding.order) > 1 else ""
        where = " and ".join(describe_predicate(goal) for goal in goals)
        for verb, text, pairs in (
            ("grasp", f"Grasp {key}.", [*starts_on, hand]),
            ("carry", f"Carry {key}, so that {where}.", [hand]),
            ("release", f"Let {key} go, so that {where}.", [hand, *lands]),
        ):
            allowed = [*others, *pairs]
            stages.append(
                {"id": f"{verb}{end}", "text": text, verb: key, "allowed_contacts": allowed}
            )
    return stages


def _rest(key: str, lies_on: Mapping[str, str]) -> list[list[str]]:
    """What an object touches where it lies: that, and what lies in the same place."""
    place = lies_on[key]
    pairs = [[key, place]]
    if place != TABLE:
        pairs += [
            [other, key] for other, where in lies_on.items() if where == place != key != other
        ]
    return pairs


def _target(goals: Sequence[Mapping[str, Any]]) -> str:
    """What an object is put into or onto; the table where nothing else is said."""
    for goal in goals:
        if goal["kind"] in ("inside", "on"):
            return str(goal.get("container") or goal["support"])
    return TABLE


def success_of(grounding: Grounding, objects: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The goals; and of each object that it lies still, let go, and as it was if it is soft."""
    specs: list[dict[str, Any]] = []
    for key in grounding.order:
        specs += [dict(goal) for goal in grounding.goals if goal["object"] == key]
        specs.append({"kind": "settled", "object": key, **SETTLED})
        specs.append({"kind": "no_finger_contact", "object": key})
        if "soft" in objects[key]:
            tolerance = {"tolerance_fraction": SHAPE_TOLERANCE}
            specs.append({"kind": "shape", "object": key, **tolerance})
    return specs


def _table(title: str, about: Mapping[str, Any]) -> list[str]:
    return ["", title, *(f"{key} = {_toml(value)}" for key, value in about.items())]


def _toml(value: Any) -> str:
    """One value; strings as JSON writes them, which TOML reads the same way."""
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {_toml(item)}" for key, item in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_toml(item) for item in value) + "]"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007F")
    return json.dumps(value)
