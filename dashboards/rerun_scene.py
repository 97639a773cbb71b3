"""The rebuilt place as Gaussian splats, and task objects as boxes."""

from pathlib import Path

import numpy as np
import rerun as rr
from jaxtyping import Float

from bridge.geometry.trajectory import PoseTrajectory
from bridge.task.task_file import ObjectModel, Task
from dashboards.errors import DashboardError
from dashboards.rerun_file import RerunFile

BACKGROUND = "background.ply"
MAX_SPLATS = 300_000
"""More than this is slow in the web viewer (measured); the largest and most opaque are kept."""
SH_DC = 0.28209479177387814
"""The constant spherical harmonic, 1 / (2 sqrt(pi))."""
_COLUMNS = (
    *("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)


def read_splats(path: Path) -> Float[np.ndarray, "num_splats 14"]:
    """Read a 3D Gaussian splatting PLY; higher harmonics are left out.

    Returns:
        Position [m], colour harmonic, opacity logit, log scales [m], rotation wxyz.

    Raises:
        DashboardError: When the file is another kind of PLY, or cut short.
    """
    data = path.read_bytes()
    head, marker, body = data.partition(b"end_header\n")
    lines = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    names = [words[-1] for words in lines if words[:2] == ["property", "float"]]
    counts = [int(words[2]) for words in lines if words[:2] == ["element", "vertex"]]
    properties = sum(words[:1] == ["property"] for words in lines)
    plain = marker and ["format", "binary_little_endian", "1.0"] in lines
    if not plain or len(counts) != 1 or properties != len(names) or not set(_COLUMNS) <= set(names):
        message = f"{path} is not a Gaussian splat PLY. Make it again: robot-gst rebuild RUN."
        raise DashboardError(message)
    if len(body) != counts[0] * len(names) * 4:
        message = f"{path} is cut short. Make it again: robot-gst rebuild RUN --force."
        raise DashboardError(message)
    table = np.frombuffer(body, dtype="<f4").reshape(counts[0], len(names))
    return table[:, [names.index(name) for name in _COLUMNS]]


def log_splats(file: RerunFile, scene_dir: Path) -> bool:
    """Log the rebuilt place under ``scene/background``; return whether there is one."""
    path = scene_dir / BACKGROUND
    if not path.is_file():
        file.note("no rebuilt place: the run has no scene (robot-gst rebuild RUN)")
        return False
    try:
        table = read_splats(path)
    except DashboardError as error:
        file.note(f"the rebuilt place is not shown: {error}")
        return False
    opacity = 1 / (1 + np.exp(-table[:, 6].astype(np.float64)))
    scales = np.exp(table[:, 7:10])
    if len(table) > MAX_SPLATS:
        weight = opacity * np.prod(scales, axis=1) ** (2 / 3)
        kept = np.sort(np.argsort(weight)[-MAX_SPLATS:])
        file.note(f"{len(table) - MAX_SPLATS} of {len(table)} splats are left out, the faintest")
        table, opacity, scales = table[kept], opacity[kept], scales[kept]
    rgba = np.concatenate([table[:, 3:6] * SH_DC + 0.5, opacity[:, None]], axis=1)
    file.always(
        "scene/background",
        rr.GaussianSplats3D(
            centers=table[:, 0:3],
            scales=scales,
            quaternions=np.roll(table[:, 10:14], -1, axis=1),
            colors=(np.clip(rgba, 0, 1) * 255 + 0.5).astype(np.uint8),
            spherical_harmonics_degree=0,
        ),
    )
    return True


def log_object(
    file: RerunFile,
    entity: str,
    track: PoseTrajectory,
    model: ObjectModel | None,
    *,
    solid: bool,
) -> None:
    """Log an object's poses and, where the task knows its shape, its boxes.

    It appears with its first pose: before, nobody said where it is.
    """
    file.poses(entity, track)
    first = track.stamps_ns[:1]
    if model is None:
        file.rows(entity, first, rr.TransformAxes3D.columns(axis_length=[0.05]))
        return
    panels = model.panels()
    columns = rr.Boxes3D.columns(
        centers=np.array([centre for centre, _ in panels]),
        half_sizes=np.array([size / 2 for _, size in panels]),
        colors=[model.color_srgb] * len(panels),
    ).partition([len(panels)])
    file.rows(entity, first, columns)
    mode = rr.components.FillMode.Solid if solid else rr.components.FillMode.MajorWireframe
    file.always(entity, rr.Boxes3D.from_fields(fill_mode=mode))


def model_of(task: Task | None, object_id: str) -> ObjectModel | None:
    """Return an object's shape if the task is known and has it."""
    return None if task is None else task.objects.get(object_id)
