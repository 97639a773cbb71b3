"""Say in words what a task asks for: objects, stages, what counts as success."""

from collections.abc import Mapping
from typing import Any

from bridge.task.check import VERBS
from bridge.task.task_file import ObjectModel, StartRange, Task


def describe_task(task: Task) -> str:
    """Return some lines for a person who wants to know whether the file says what they mean."""
    stages = [
        f"  {number}. {stage['id']}: {_handled(stage)}; may touch: {_pairs(stage)}"
        + "".join(f"; meanwhile {describe_predicate(way)}" for way in stage.get("path", []))
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
    """Say in words when one predicate holds, its limits with their names in the file."""
    words = _WORDS[spec["kind"]]
    others = [f"{key} {spec[key]}" for key in spec if f"{{{key}" not in words and key != "kind"]
    return words.format_map(spec) + (f" ({', '.join(others)})" if others else "")


_WORDS = {
    "inside": "the middle of {object} is inside {container}",
    "on": "{object} rests on {support}",
    "outside": "{object} is outside {container}, seen from above",
    "beside": "{object} is next to {reference}",
    "between": "{object} is between {first} and {second}",
    "upright": "{object} is upright",
    "aligned": "an axis of {object} is parallel to one of {reference}",
    "moved": "{object} has moved from its start",
    "settled": "{object} lies still",
    "no_finger_contact": "no finger touches {object}",
    "shape": "{object} has its shape",
    "allowed_contacts": "nothing touched what its stage does not allow",
    "clearance": "{object} is away from {against}",
    "keepout": "{object} is not over {over}",
    "height": "{object} is at such a height over the table",
    "speed": "the tool moves no faster",
}


def _object(model: ObjectModel, start: StartRange) -> str:
    size = " x ".join(_mm(length) for length in model.size_m)
    what = model.mesh or model.shape.replace("_", " ")
    made = "fixed" if model.fixed else "rigid" if model.soft is None else "soft"
    return (
        f"{model.id}: {what}, {size} mm, {made}, {model.mass_kg * 1e3:g} g; starts at "
        f"x {start.x_m} m, y {start.y_m} m, yaw {start.yaw_rad} rad"
    )


def _mm(length_m: float) -> str:
    return f"{length_m * 1e3:.4g}"


def _handled(stage: Mapping[str, Any]) -> str:
    done = [f"{verb}s {stage[verb]}" for verb in VERBS if verb in stage]
    said = " and ".join(done).replace("carrys", "carries").replace("pushs", "pushes")
    if "speed_m_s" in stage:
        said += f" at {stage['speed_m_s']:g} m/s"
    if "clearance_m" in stage:
        said += f" {_mm(stage['clearance_m'])} mm over the top of where it goes"
    return said or "handles nothing"


def _pairs(stage: Mapping[str, Any]) -> str:
    pairs = [" and ".join(pair) for pair in stage.get("allowed_contacts", [])]
    return ", ".join(pairs) or "nothing"
