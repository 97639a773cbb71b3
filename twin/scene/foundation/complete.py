"""Let a shape generator complete the objects of a scene; what was measured has the last word."""

import shlex
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.errors import UsageError
from bridge.geometry import se3
from bridge.task.task_file import ObjectModel
from bridge.terminal import Output
from twin.errors import TwinError
from twin.scene.foundation.sam3d import (
    GeneratedObject,
    GeneratorConfig,
    GeneratorInput,
    generate_object,
)
from twin.scene.frames.rgbd import TrainingView
from twin.scene.settings import ModelConfig
from twin.scene.shape.carve import MaskedView, VoxelBox, gather
from twin.scene.shape.from_training import Poses, masked_view, support_z_m
from twin.scene.shape.reconstruct import ObjectShape, ShapeConfig, shape_of_mesh

MAX_POINTS = 20_000
"""Measured points that both shapes are compared with."""
WORSE_M = 0.0005
"""A generated shape may lie this much farther from the measured points than the carved one."""
MAX_FREE_SHARE = 0.05
"""Share of a generated shape that may lie where views looked through."""

Shapes = Mapping[str, ObjectShape | str]


def generator_command(text: str) -> tuple[str, ...]:
    """Split a command line as a shell would, without running a shell.

    Raises:
        UsageError: When it names no program that can be run.
    """
    try:
        words = tuple(shlex.split(text))
    except ValueError as error:
        message = f"--generator {text!r} cannot be read as a command: {error}."
        raise UsageError(message) from error
    if not words or shutil.which(words[0]) is None:
        message = (
            f"--generator {text!r}: there is no program {words[0] if words else ''!r} that can be "
            "run. Name one on the PATH, or give its whole path."
        )
        raise UsageError(message)
    return words


@dataclass(frozen=True, kw_only=True)
class Completed:
    """The shapes to use from now on, and what came of asking."""

    shapes: dict[str, ObjectShape | str]
    record: dict[str, Any]
    """By object: whether the generated shape is used, how well it fits, or why there is none."""


def complete_shapes(
    views: Sequence[TrainingView],
    models: Mapping[str, ObjectModel],
    Ts_base_object: Poses,
    shapes: Shapes,
    config: ModelConfig,
    folder: Path,
    output: Output,
) -> Completed:
    """Ask the generator about each object, from the view that shows most of it.

    Its shape replaces the carved one when it explains the measured points as well, and does not
    fill what views looked through; where carving gave none, the second is enough. Nothing is
    asked without a generator. What fails is a remark.

    Args:
        views: What the scene was fitted to, in ``base_link`` whose z = 0 is the table.
        models: Known shapes: they say which pixels are the object's.
        Ts_base_object: Where the objects were.
        shapes: Carved, in the frame of each object, or why there is none.
        config: Names the generator.
        folder: Where its files may lie for as long as it works.
        output: How to talk.
    """
    found, record = dict(shapes), {}
    if not config.generator or not shapes:
        return Completed(shapes=found, record={})
    command = generator_command(config.generator)
    limits = GeneratorConfig(command=command, timeout_s=config.generator_timeout_s)
    folder.mkdir(parents=True, exist_ok=True)
    with output.progress("generate shapes", len(shapes)) as advance:
        for done, (key, carved) in enumerate(shapes.items(), start=1):
            asked = _Asked(
                model=models[key],
                T_base_object=Ts_base_object[key],
                masked=[masked_view(view, key, models, Ts_base_object) for view in views],
            )
            try:
                with tempfile.TemporaryDirectory(prefix="generator_", dir=folder) as place:
                    made = _generate(asked, views, Path(place) / "work", limits)
                shape, about = _judge(made, carved, asked)
            except (TwinError, UsageError) as error:
                shape, about = carved, {"used": False, "remark": str(error)}
            found[key], record[key] = shape, about
            advance(done, f"{key} {'generated' if about['used'] else 'as carved'}")
    return Completed(shapes=found, record=record)


@dataclass(frozen=True, kw_only=True)
class _Asked:
    """One object and what was measured of it, in its own frame."""

    model: ObjectModel
    T_base_object: Float[np.ndarray, "4 4"]
    masked: list[MaskedView]

    def points_m(self) -> Float[np.ndarray, "num_points 3"]:
        """Measured points in the object's frame, thinned out evenly."""
        points = np.concatenate([view.points_m() for view in self.masked])
        return np.asarray(points[:: max(1, len(points) // MAX_POINTS)])


def _generate(
    asked: _Asked, views: Sequence[TrainingView], work: Path, limits: GeneratorConfig
) -> GeneratedObject:
    """Ask about the view that shows most of the object."""
    if not views:
        message = "no view shows the object."
        raise UsageError(message)
    best = int(np.argmax([int(view.mask.sum()) for view in asked.masked]))
    target = views[best].full
    wanted = GeneratorInput(
        image_u8=np.ascontiguousarray(np.moveaxis(target.planes_u8, 0, -1)),
        mask=asked.masked[best].mask,
        depth_m=asked.masked[best].known_depth_m(),
        camera=target.camera,
    )
    stands = support_z_m(asked.model, asked.T_base_object) is not None
    return generate_object(wanted, views[best].T_base_color, 0.0 if stands else None, work, limits)


def _judge(
    made: GeneratedObject, carved: ObjectShape | str, asked: _Asked
) -> tuple[ObjectShape | str, dict[str, Any]]:
    """The shape that explains better what was measured, and the numbers it was chosen by."""
    points = asked.points_m()
    vertices = se3.apply(se3.invert(asked.T_base_object), made.vertices_m)
    shape = shape_of_mesh(vertices, made.faces, points)
    away = float(np.abs(shape.sdf.distance(points)).mean())
    free = _free_share(shape, asked.masked)
    about: dict[str, Any] = {
        "used": False,
        "source": made.source,
        "scale": made.fit.scale,
        "iou": made.iou,
        "residual_m": away,
        "free_share": round(free, 4),
    }
    if free > MAX_FREE_SHARE:
        remark = f"{free:.0%} of the generated shape lies where views looked through"
        return carved, about | {"remark": remark}
    if isinstance(carved, ObjectShape):
        about["carved_residual_m"] = float(np.abs(carved.sdf.distance(points)).mean())
        if away > about["carved_residual_m"] + WORSE_M:
            remark = "the carved shape lies nearer to what was measured"
            return carved, about | {"remark": remark}
    num_views = sum(bool(view.mask.any()) for view in asked.masked)
    shape = replace(shape, num_views=num_views, source=made.source)
    return shape, about | {"used": True}


def _free_share(shape: ObjectShape, masked: Sequence[MaskedView]) -> float:
    """Share of a shape's voxels that views looked through."""
    grid = shape.sdf
    num_x, num_y, num_z = grid.values_m.shape
    box = VoxelBox(origin_m=grid.origin_m, voxel_m=grid.voxel_m, counts=(num_x, num_y, num_z))
    seen = gather(box, masked, shape.truncation_m, ShapeConfig().min_free_views)
    inside = grid.values_m < 0
    return float((inside & seen.free).sum() / max(int(inside.sum()), 1))
