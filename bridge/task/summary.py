"""Say in words what a task asks for: objects, stages, what counts as success."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from bridge.task.check import TABLE, VERBS
from bridge.task.predicate import MOVED_TOLERANCE_M
from bridge.task.relations import (
    BESIDE_GAP_M,
    BETWEEN_TOLERANCE_M,
    ON_TOLERANCE_M,
    TILT_TOLERANCE_RAD,
)
from bridge.task.task_file import ObjectModel, StartRange, Task


def describe_task(task: Task) -> str:
    """Return some lines for a person who wants to know whether the file says what they mean."""
    stages = [
        f"  {number}. {stage['id']}: {_handled(stage)}; may touch: {_pairs(stage)}"
        + "".join(f"; {describe_way(way)}" for way in stage.get("path", []))
        for number, stage in enumerate(task.stages, start=1)
    ]
    about = task.derived
    made = [f"derived by the {about['by']} from {', '.join(about['tasks'])}"] if about else []
    return "\n".join(
        [
            f"{task.name}: {task.instruction}",
            *made,
            f"cell: {task.cell}; moved by the robot: {', '.join(task.manipulated)}",
            "objects",
            *(f"  {_object(model, task.start[key])}" for key, model in task.objects.items()),
            "stages",
            *stages,
            "success, when at the end",
            *(f"  {describe_predicate(spec)}" for spec in task.success),
        ]
    )


def describe_predicate(spec: Mapping[str, Any]) -> str:
    """Say in words when one success predicate holds."""
    return _WORDS[spec["kind"]](spec)


def describe_way(way: Mapping[str, Any]) -> str:
    """Say in words what one constraint asks while its stage lasts."""
    who = way.get("obj", "the tool")
    match way["kind"]:
        case "clearance":
            return f"{who} stays at least {_mm(way['min'])} mm away from {way['against']}"
        case "keepout":
            return f"{who} never passes over {way['region']['over']}"
        case "upright":
            return f"{who} stays upright within {way.get('max_deg', 10):g} degrees"
        case "height":
            bounds = [f"{word} {_mm(way[key])} mm" for key, word in _BOUNDS.items() if key in way]
            return f"the lowest point of {who} stays at {' and '.join(bounds)} over the table"
    return f"{who} moves at most at {way['max']:g} m/s"


_BOUNDS = {"min": "least", "max": "most"}


def _object(model: ObjectModel, start: StartRange) -> str:
    size = " x ".join(_mm(length) for length in model.size_m)
    what = model.mesh or model.shape.replace("_", " ")
    made = "soft" if model.soft is not None else "rigid"
    weight = "fixed" if model.fixed else f"{made}, {model.mass_kg * 1e3:g} g"
    low, high = (math.degrees(limit) for limit in start.yaw_rad)
    return (
        f"{model.id}: {what}, {size} mm, {weight}; starts at x {_range(start.x_m)}, "
        f"y {_range(start.y_m)} m, turned by {low:.0f} to {high:.0f} degrees"
    )


def _range(limits: tuple[float, float]) -> str:
    return f"{limits[0]:g} to {limits[1]:g}"


def _mm(length_m: float) -> str:
    return f"{length_m * 1e3:.4g}"


def _handled(stage: Mapping[str, Any]) -> str:
    done = [f"{verb}s {stage[verb]}" for verb in VERBS if verb in stage]
    said = " and ".join(done).replace("carrys", "carries").replace("pushs", "pushes")
    if "part" in stage:
        said += f" by its {stage['part']}"
    if "speed_m_s" in stage:
        said += f" at {stage['speed_m_s']:g} m/s"
    if "clearance_m" in stage:
        said += f" {_mm(stage['clearance_m'])} mm over the top of where it goes"
    return said or "handles nothing"


def _pairs(stage: Mapping[str, Any]) -> str:
    pairs = [" and ".join(pair) for pair in stage.get("allowed_contacts", [])]
    return ", ".join(pairs) or "nothing"


def _inside(spec: Mapping[str, Any]) -> str:
    margin = spec.get("margin_m", 0.0)
    near = f", {_mm(margin)} mm away from its faces" if margin else ""
    return f"the middle of {spec['object']} is inside {spec['container']}{near}"


def _on(spec: Mapping[str, Any]) -> str:
    tolerance, margin = spec.get("tolerance_m", ON_TOLERANCE_M), spec.get("margin_m", 0.0)
    if spec["support"] == TABLE:
        return f"{spec['object']} stands on the table, within {_mm(tolerance)} mm"
    return (
        f"{spec['object']} rests on {spec['support']}: its underside within {_mm(tolerance)} mm of "
        f"the top, its middle at least {_mm(margin)} mm within the edges"
    )


def _outside(spec: Mapping[str, Any]) -> str:
    margin = spec.get("margin_m", 0.0)
    far = f" by at least {_mm(margin)} mm" if margin else ""
    return f"{spec['object']} is outside {spec['container']}{far}, seen from above"


def _beside(spec: Mapping[str, Any]) -> str:
    where = f"next to {spec['reference']}"
    if "direction" in spec:
        direction = spec["direction"]
        where = (
            f"{_SIDE_WORDS[direction]} {spec['reference']}, as the robot sees it,"
            if isinstance(direction, str)
            else f"{where} along {_vector(direction)}"
        )
    low, high = spec.get("gap_m", BESIDE_GAP_M)
    return f"{spec['object']} is {where} with a gap of {_mm(low)} to {_mm(high)} mm"


_SIDE_WORDS = {
    "left": "left of",
    "right": "right of",
    "in_front": "in front of",
    "behind": "behind",
}


def _between(spec: Mapping[str, Any]) -> str:
    off = spec.get("tolerance_m", BETWEEN_TOLERANCE_M)
    return (
        f"{spec['object']} is between {spec['first']} and {spec['second']}, at most {_mm(off)} mm "
        "off the line between them"
    )


def _upright(spec: Mapping[str, Any]) -> str:
    tilt = math.degrees(spec.get("tolerance_rad", TILT_TOLERANCE_RAD))
    return f"{spec['object']} is upright within {tilt:.0f} degrees"


def _aligned(spec: Mapping[str, Any]) -> str:
    off = math.degrees(spec.get("tolerance_rad", TILT_TOLERANCE_RAD))
    return (
        f"the {spec.get('axis', 'x')} axis of {spec['object']} is parallel to the "
        f"{spec.get('reference_axis', 'x')} axis of {spec['reference']} within {off:.0f} degrees"
    )


def _moved(spec: Mapping[str, Any]) -> str:
    said = []
    if "at_least_m" in spec:
        said.append(f"by at least {_mm(spec['at_least_m'])} mm")
    if "at_most_m" in spec:
        said.append(f"by at most {_mm(spec['at_most_m'])} mm")
    if "by_m" in spec:
        off = spec.get("tolerance_m", MOVED_TOLERANCE_M)
        said.append(f"by {_mm(spec['by_m'])} mm, give or take {_mm(off)} mm,")
    if "direction" in spec:
        word = spec["direction"]
        to = "to the " if word in ("left", "right") else ""
        said.append(
            f"{to}{word}, as the robot sees it"
            if isinstance(word, str)
            else f"along {_vector(word)}"
        )
    if "target_m" in spec:
        target = _vector(spec["target_m"])
        said.append(f"to within {_mm(spec['tolerance_m'])} mm of {target} m")
    return f"{spec['object']} has moved from its start {' and '.join(said)}"


def _vector(values: Sequence[int | float]) -> str:
    return f"({', '.join(f'{part:g}' for part in values)})"


def _allowed(spec: Mapping[str, Any]) -> str:
    whose = f"{spec['object']} touches" if "object" in spec else "anything touches"
    deep = spec.get("tolerance_m", 0.0)
    than = f" deeper than {_mm(deep)} mm" if deep else ""
    return f"at no time {whose} what its stage does not allow{than}"


_WORDS: dict[str, Callable[[Mapping[str, Any]], str]] = {
    "inside": _inside,
    "on": _on,
    "outside": _outside,
    "beside": _beside,
    "between": _between,
    "upright": _upright,
    "aligned": _aligned,
    "moved": _moved,
    "settled": lambda spec: (
        f"{spec['object']} lies still: below {_mm(spec['max_speed_m_s'])} mm/s in the last "
        f"{spec['for_s']:g} s"
    ),
    "no_finger_contact": lambda spec: f"no finger touches {spec['object']}",
    "shape": lambda spec: (
        f"{spec['object']} has its shape: no extent differs by more than "
        f"{spec['tolerance_fraction']:.0%}"
    ),
    "allowed_contacts": _allowed,
}
