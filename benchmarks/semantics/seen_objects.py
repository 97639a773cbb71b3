"""What a person sees in a scene, and which instances of a rebuild are that.

An object is given by masks (made by whoever recorded the scene) or by boxes (drawn by eye) in some
frames. An instance is drawn into the same frames, hidden parts left out, and compared:

- masks: intersection over union of all frames together;
- boxes: intersection over union of the drawn box and the box around the instance's pixels, without
  the outermost 2 % on each side; the mean over the object's frames, 0 where it does not show.

Pairs are taken best first, each object and each instance once, as long as the agreement is at
least ``MIN_IOU``. Objects left over are missed. Instances left over are false, unless they agree
that well with something on the list that is neither asked for nor wrong (``ignored``).
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Int

MIN_IOU = 0.5
STRAY = 0.02
"""Share of an instance's pixels on each side that its box leaves out."""


@dataclass(frozen=True, kw_only=True)
class SeenObject:
    """One object as a person marked it."""

    name: str
    group: str
    """``asked`` counts; other groups are ``ignored`` or reported beside it."""
    boxes: Mapping[int, tuple[float, float, float, float]] = field(default_factory=dict)
    """By frame: left, top, right, bottom in px of the colour image."""
    masks: Mapping[int, Bool[np.ndarray, "height width"]] = field(default_factory=dict)
    """By frame, instead of boxes."""

    def agreement(self, drawn: Mapping[int, Bool[np.ndarray, "height width"]]) -> float:
        """How well the pixels of an instance in each frame agree with this object, 0..1."""
        if self.masks:
            both = sum(int((mask & drawn[key]).sum()) for key, mask in self.masks.items())
            either = sum(int((mask | drawn[key]).sum()) for key, mask in self.masks.items())
            return both / max(either, 1)
        return float(np.mean([_box_iou(box, _box_of(drawn[k])) for k, box in self.boxes.items()]))


def read_list(path: Path) -> list[SeenObject]:
    """Objects of a committed list, by boxes."""
    return [
        SeenObject(
            name=item["name"],
            group=item["group"],
            boxes={int(frame): tuple(box) for frame, box in item["boxes"].items()},
        )
        for item in json.loads(path.read_text())["objects"]
    ]


@dataclass(frozen=True, kw_only=True)
class Judged:
    """Which objects were found, and what was found besides."""

    found: Mapping[str, tuple[int, float]]
    """By object: the instance, and how well it agrees."""
    best: Mapping[str, float]
    """By object: the best agreement of any instance."""
    false: tuple[int, ...]
    """Instances that are no object on the list."""


def judge(
    objects: Sequence[SeenObject],
    labels: Mapping[int, Int[np.ndarray, "height width"]],
    instances: Sequence[int],
) -> Judged:
    """Match instances with objects.

    Args:
        labels: By frame, the instance each pixel shows; 0 is none.
    """
    scores = np.zeros((len(objects), len(instances)))
    for column, number in enumerate(instances):
        drawn = {frame: image == number for frame, image in labels.items()}
        scores[:, column] = [item.agreement(drawn) for item in objects]
    found: dict[str, tuple[int, float]] = {}
    taken: dict[int, str] = {}
    for flat in np.argsort(-scores, axis=None, kind="stable"):
        row, column = divmod(int(flat), max(len(instances), 1))
        name, number = objects[row].name, instances[column]
        if scores[row, column] >= MIN_IOU and name not in found and number not in taken:
            found[name], taken[number] = (number, float(scores[row, column])), name
    groups = {item.name: item.group for item in objects}
    best = scores.max(axis=1, initial=0.0)
    return Judged(
        found={name: pair for name, pair in found.items() if groups[name] != "ignored"},
        best={item.name: float(value) for item, value in zip(objects, best, strict=True)},
        false=tuple(number for number in instances if number not in taken),
    )


def _box_of(mask: np.ndarray) -> tuple[float, float, float, float] | None:
    row, column = np.nonzero(mask)
    if not len(row):
        return None
    (left, right), (top, bottom) = (np.quantile(each, [STRAY, 1 - STRAY]) for each in (column, row))
    return float(left), float(top), float(right) + 1, float(bottom) + 1


def _box_iou(a: Sequence[float], b: Sequence[float] | None) -> float:
    if b is None:
        return 0.0
    wide = min(a[2], b[2]) - max(a[0], b[0])
    high = min(a[3], b[3]) - max(a[1], b[1])
    both = max(wide, 0.0) * max(high, 0.0)
    areas = [(box[2] - box[0]) * (box[3] - box[1]) for box in (a, b)]
    return both / (areas[0] + areas[1] - both)
